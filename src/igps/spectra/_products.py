"""Products of small or long matrices, which take most of the time of the eigensolver.

A BLAS is made for matrices with many rows and columns: it first copies its operands into its own layout. For fronts of
some tens of unknowns, and solves with few right-hand sides, `product` keeps a tile of the result, ROWS by COLUMNS, in
the processor's registers until it is complete. This takes a third of the time of a BLAS. Numba does not find it by
itself: with loops that it arranges over rows of four, all of `eigenpairs` takes 1.9 times as long at 10,000 vertices.
The tile is therefore written in LLVM instructions (`_tile`); everything around it is plain Numba.
"""

from functools import partial
from typing import Any, cast

import numpy as np
import torch

from igps._compiled import Lazy, compiled

# Size of a tile: AVX2 has registers for this number of sums, and for the factors.
ROWS, COLUMNS = 6, 8
# Arguments of `product`. A plain 0, 1, True or False would be part of the argument's type, and Numba compile for each.
ZERO = cast(int, np.int64(0))
ONE = cast(int, np.int64(1))

Rows = tuple[np.ndarray, int, int]
"""A matrix in a flat array: the array, the start of the matrix, and the step between rows."""
Strided = tuple[np.ndarray, int, int, int]
"""As `Rows`, and the step between columns."""


def overlaps(rows: torch.Tensor, others: torch.Tensor, piece: slice) -> torch.Tensor:
    """Return the products (n, m) of rows (n, V) with other rows (m, V), over a piece of the columns.

    For a few long rows NumPy's BLAS takes two thirds of the time of PyTorch's on an AMD processor.
    """
    return torch.from_numpy(rows.numpy()[:, piece] @ others.numpy()[:, piece].T)


def subtract(rows: torch.Tensor, factors: torch.Tensor, others: torch.Tensor, piece: slice) -> None:
    """Subtract factors (n, m) times others from rows, over a piece of the columns, in the precision of the others.

    The product is NumPy's: its single precision does not depend on PyTorch's setting for matrix products.
    """
    rows.numpy()[:, piece] -= factors.numpy() @ others.numpy()[:, piece]


def _tile(n_columns: int) -> Any:
    """Make a function for one tile of `product`: ROWS rows of n_columns numbers, each row an LLVM vector.

    If fewer rows are left, the last one is computed and written several times.
    """
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

    real = ir.DoubleType()
    integer = ir.IntType(64)
    vector = ir.VectorType(real, n_columns) if n_columns > 1 else real
    fused = ("contract",)

    def tile(
        context: Any, a: Any, x: Any, add: Any, source: Any, out: Any, size: Any, scale: Any
    ) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            operands = []
            for numba_type, value in zip(signature.args, values, strict=True):
                is_tuple = isinstance(numba_type, types.BaseTuple)
                items = cgutils.unpack_tuple(builder, value) if is_tuple else [value]
                if is_tuple and numba_type is not size:
                    array = context.make_array(numba_type[0])(context, builder, items[0])
                    items[0] = builder.gep(array.data, [items[1]])
                operands.append(items)
            (a_start, _, a_step, a_stride), x_rows, [is_added], source_rows, out_rows, *rest = (
                operands
            )
            (n_rows, n_terms), [factor] = rest

            def broadcast(value: Any) -> Any:
                """Fill a vector with a number."""
                if n_columns == 1:
                    return value
                first = builder.insert_element(
                    ir.Constant(vector, ir.Undefined), value, ir.IntType(32)(0)
                )
                return builder.shuffle_vector(
                    first, first, ir.Constant(ir.VectorType(ir.IntType(32), n_columns), None)
                )

            def row(operand: Any, index: Any) -> Any:
                start, _, step = operand
                place = builder.gep(start, [builder.mul(index, step)])
                return builder.bitcast(place, vector.as_pointer())

            last = builder.sub(n_rows, integer(1))
            rows = [
                builder.select(builder.icmp_signed("<", integer(i), last), integer(i), last)
                for i in range(ROWS)
            ]
            columns_of_a = [builder.gep(a_start, [builder.mul(i, a_stride)]) for i in rows]
            sums = [cgutils.alloca_once_value(builder, ir.Constant(vector, None)) for _ in rows]
            with cgutils.for_range(builder, n_terms) as loop:
                x_row = builder.load(row(x_rows, loop.index), align=8)
                offset = builder.mul(loop.index, a_step)
                for column, total in zip(columns_of_a, sums, strict=True):
                    number = broadcast(builder.load(builder.gep(column, [offset])))
                    term = builder.fmul(number, x_row, flags=fused)
                    builder.store(builder.fadd(builder.load(total), term, flags=fused), total)
            factors = broadcast(factor)
            products = [builder.fmul(builder.load(total), factors, flags=fused) for total in sums]
            with builder.if_else(is_added) as (added, alone):
                with added:
                    addends = [builder.load(row(source_rows, i), align=8) for i in rows]
                    for i, addend, result in zip(rows, addends, products, strict=True):
                        total = builder.fadd(addend, result, flags=fused)
                        builder.store(total, row(out_rows, i), align=8)
                with alone:
                    for i, result in zip(rows, products, strict=True):
                        builder.store(result, row(out_rows, i), align=8)
            return context.get_dummy_value()

        return types.void(a, x, types.boolean, source, out, size, types.float64), generate

    return intrinsic(tile)


tile: Any = Lazy(partial(_tile, COLUMNS))
narrow_tile: Any = Lazy(partial(_tile, 1))


@compiled()
def product(
    shape: tuple[int, int, int],
    scale: float,
    a: Strided,
    x: Rows,
    add: int,
    source: Rows,
    out: Rows,
) -> None:
    """Compute out ← scale · Aᵀ X, plus the source if `add` is ONE.

    The shape is (m, n, k) for out (m, n), A (k, m) and X (k, n).

    Rows of n numbers are written once or twice: ``out`` may not be the source, unless n is a multiple of COLUMNS.
    """
    m, n, k = shape
    is_added = add != 0
    for i in range(0, m, ROWS):
        size = (min(ROWS, m - i), k)
        columns = (a[0], a[1] + i * a[3], a[2], a[3])
        if n < COLUMNS:
            for j in range(n):
                source_rows = (source[0], source[1] + i * source[2] + j, source[2])
                out_rows = (out[0], out[1] + i * out[2] + j, out[2])
                x_rows = (x[0], x[1] + j, x[2])
                narrow_tile(columns, x_rows, is_added, source_rows, out_rows, size, scale)
        for begin in range(0, n if n >= COLUMNS else 0, COLUMNS):
            j = min(begin, n - COLUMNS)
            source_rows = (source[0], source[1] + i * source[2] + j, source[2])
            out_rows = (out[0], out[1] + i * out[2] + j, out[2])
            x_rows = (x[0], x[1] + j, x[2])
            tile(columns, x_rows, is_added, source_rows, out_rows, size, scale)

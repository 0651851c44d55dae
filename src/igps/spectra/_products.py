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
    columns = rows.numpy()[:, piece]
    other_columns = others.numpy()[:, piece]
    return torch.from_numpy(columns @ other_columns.T)


def subtract(rows: torch.Tensor, factors: torch.Tensor, others: torch.Tensor, piece: slice) -> None:
    """Subtract factors (n, m) times others from rows, over a piece of the columns, in the precision of the others.

    The product is NumPy's: its single precision does not depend on PyTorch's setting for matrix products.
    """
    rows.numpy()[:, piece] -= factors.numpy() @ others.numpy()[:, piece]


def identity(size: int) -> torch.Tensor:
    """Return the identity matrix, in double precision on the processor whatever the defaults of PyTorch."""
    return torch.eye(size, dtype=torch.float64, device="cpu")


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

    def tile(
        context: Any, a: Any, x: Any, is_added: Any, source: Any, out: Any, size: Any, scale: Any
    ) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            def matrix(number: int) -> list[Any]:
                """Return the address of the first number of a matrix, and its steps."""
                array, start, *steps = cgutils.unpack_tuple(builder, values[number])
                array_type = signature.args[number][0]
                data = context.make_array(array_type)(context, builder, array).data
                return [builder.gep(data, [start]), *steps]

            a_start, a_step, a_stride = matrix(0)
            x_rows = matrix(1)
            is_added = values[2]
            source_rows = matrix(3)
            out_rows = matrix(4)
            n_rows, n_terms = cgutils.unpack_tuple(builder, values[5])
            factor = values[6]

            def broadcast(value: Any) -> Any:
                """Fill a vector with a number."""
                if n_columns == 1:
                    return value
                first_lane = ir.IntType(32)(0)
                nothing = ir.Constant(vector, ir.Undefined)
                first = builder.insert_element(nothing, value, first_lane)
                lanes = ir.Constant(ir.VectorType(ir.IntType(32), n_columns), None)
                return builder.shuffle_vector(first, first, lanes)

            def row(rows: list[Any], index: Any) -> Any:
                start, step = rows
                place = builder.gep(start, [builder.mul(index, step)])
                return builder.bitcast(place, vector.as_pointer())

            multiply = partial(builder.fmul, flags=("contract",))
            add = partial(builder.fadd, flags=("contract",))
            last = builder.sub(n_rows, integer(1))
            rows = []
            columns_of_a = []
            sums = []
            for number in range(ROWS):
                is_left = builder.icmp_signed("<", integer(number), last)
                i = builder.select(is_left, integer(number), last)
                rows.append(i)
                columns_of_a.append(builder.gep(a_start, [builder.mul(i, a_stride)]))
                sums.append(cgutils.alloca_once_value(builder, ir.Constant(vector, None)))
            with cgutils.for_range(builder, n_terms) as loop:
                x_row = builder.load(row(x_rows, loop.index), align=8)
                offset = builder.mul(loop.index, a_step)
                for column, total in zip(columns_of_a, sums, strict=True):
                    entry = builder.load(builder.gep(column, [offset]))
                    term = multiply(broadcast(entry), x_row)
                    builder.store(add(builder.load(total), term), total)
            factors = broadcast(factor)
            products = [multiply(builder.load(total), factors) for total in sums]
            with builder.if_else(is_added) as (added, alone):
                with added:
                    addends = [builder.load(row(source_rows, i), align=8) for i in rows]
                    for i, addend, result in zip(rows, addends, products, strict=True):
                        builder.store(add(addend, result), row(out_rows, i), align=8)
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
    is_wide = n >= COLUMNS
    for i in range(0, m, ROWS):
        size = (min(ROWS, m - i), k)
        columns = (a[0], a[1] + i * a[3], a[2], a[3])
        for begin in range(0, n, COLUMNS if is_wide else 1):
            j = min(begin, n - COLUMNS) if is_wide else begin
            source_rows = (source[0], source[1] + i * source[2] + j, source[2])
            out_rows = (out[0], out[1] + i * out[2] + j, out[2])
            x_rows = (x[0], x[1] + j, x[2])
            if is_wide:
                tile(columns, x_rows, is_added, source_rows, out_rows, size, scale)
            else:
                narrow_tile(columns, x_rows, is_added, source_rows, out_rows, size, scale)

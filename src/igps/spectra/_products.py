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

    def tile(  # noqa: PLR0913 (the operands of a hand-made tile)
        context: Any,
        a: Any,
        a_at: Any,
        a_step: Any,
        a_stride: Any,
        x: Any,
        x_at: Any,
        x_step: Any,
        add: Any,
        source: Any,
        source_at: Any,
        source_step: Any,
        out: Any,
        out_at: Any,
        out_step: Any,
        n_rows: Any,
        n_terms: Any,
        scale: Any,
    ) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            names = (
                "a",
                "a_at",
                "a_step",
                "a_stride",
                "x",
                "x_at",
                "x_step",
                "add",
                "source",
                "source_at",
                "source_step",
                "out",
                "out_at",
                "out_step",
                "n_rows",
                "n_terms",
                "scale",
            )
            arguments = dict(zip(names, values, strict=True))
            for numba_type, name in zip(signature.args, names, strict=True):
                if isinstance(numba_type, types.Array):
                    arguments[name] = context.make_array(numba_type)(
                        context, builder, arguments[name]
                    ).data

            def pointer(name: str, offset: Any) -> Any:
                return builder.gep(arguments[name], [builder.add(arguments[name + "_at"], offset)])

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

            def row(name: str, index: Any) -> Any:
                start = pointer(name, builder.mul(index, arguments[name + "_step"]))
                return builder.bitcast(start, vector.as_pointer())

            last = builder.sub(arguments["n_rows"], integer(1))
            rows = [
                builder.select(builder.icmp_signed("<", integer(i), last), integer(i), last)
                for i in range(ROWS)
            ]
            columns_of_a = [pointer("a", builder.mul(i, arguments["a_stride"])) for i in rows]
            sums = [cgutils.alloca_once_value(builder, ir.Constant(vector, None)) for _ in rows]
            with cgutils.for_range(builder, arguments["n_terms"]) as loop:
                x_row = builder.load(row("x", loop.index), align=8)
                offset = builder.mul(loop.index, arguments["a_step"])
                for column, total in zip(columns_of_a, sums, strict=True):
                    term = builder.fmul(
                        broadcast(builder.load(builder.gep(column, [offset]))), x_row, flags=fused
                    )
                    builder.store(builder.fadd(builder.load(total), term, flags=fused), total)
            scale = broadcast(arguments["scale"])
            products = [builder.fmul(builder.load(total), scale, flags=fused) for total in sums]
            with builder.if_else(arguments["add"]) as (added, alone):
                with added:
                    source_rows = [builder.load(row("source", i), align=8) for i in rows]
                    for i, source_row, result in zip(rows, source_rows, products, strict=True):
                        builder.store(
                            builder.fadd(source_row, result, flags=fused), row("out", i), align=8
                        )
                with alone:
                    for i, result in zip(rows, products, strict=True):
                        builder.store(result, row("out", i), align=8)
            return context.get_dummy_value()

        i64 = types.int64
        argument_types = (
            a,
            i64,
            i64,
            i64,
            x,
            i64,
            i64,
            types.boolean,
            source,
            i64,
            i64,
            out,
            i64,
            i64,
            i64,
            i64,
            types.float64,
        )
        return types.void(*argument_types), generate

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
        n_rows = min(ROWS, m - i)
        if n < COLUMNS:
            for j in range(n):
                narrow_tile(
                    a[0],
                    a[1] + i * a[3],
                    a[2],
                    a[3],
                    x[0],
                    x[1] + j,
                    x[2],
                    is_added,
                    source[0],
                    source[1] + i * source[2] + j,
                    source[2],
                    out[0],
                    out[1] + i * out[2] + j,
                    out[2],
                    n_rows,
                    k,
                    scale,
                )
        for begin in range(0, n if n >= COLUMNS else 0, COLUMNS):
            j = min(begin, n - COLUMNS)
            tile(
                a[0],
                a[1] + i * a[3],
                a[2],
                a[3],
                x[0],
                x[1] + j,
                x[2],
                is_added,
                source[0],
                source[1] + i * source[2] + j,
                source[2],
                out[0],
                out[1] + i * out[2] + j,
                out[2],
                n_rows,
                k,
                scale,
            )

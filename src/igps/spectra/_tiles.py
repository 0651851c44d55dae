"""Products of small matrices, a tile of which at a time stays in the processor's registers; compiled as `loops` is.

A BLAS is made for large matrices: it first copies its operands into an order of its own. With fronts of some tens of
unknowns, or few right-hand sides, that takes longer than the product, for which a tile needs a third of the time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from igps._compiled import compiled

# Of a tile: as many sums as the registers of AVX2 hold, beside what they are made of
ROWS, COLUMNS = 6, 8

Rows = tuple[np.ndarray, int, int]
"""A matrix in a flat array: where it begins, and how far its rows lie apart."""
Strided = tuple[np.ndarray, int, int, int]
"""The same, and how far its columns lie apart."""


def _tile(n_columns: int) -> Any:
    """A function for one tile of `_product`, ROWS rows of so many numbers, each row one of LLVM's vectors.

    Of fewer rows the last stands in for the others: it is computed and written several times.
    """
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

    number, whole = ir.DoubleType(), ir.IntType(64)
    vector = ir.VectorType(number, n_columns) if n_columns > 1 else number
    fused = ("contract",)

    def tile(
        context: Any,
        a: Any, a_at: Any, a_step: Any, a_stride: Any,
        x: Any, x_at: Any, x_step: Any,
        keep: Any, source: Any, source_at: Any, source_step: Any,
        out: Any, out_at: Any, out_step: Any,
        n_rows: Any, n_terms: Any, factor: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            names = ("a", "a_at", "a_step", "a_stride", "x", "x_at", "x_step", "keep", "source", "source_at",
                     "source_step", "out", "out_at", "out_step", "n_rows", "n_terms", "factor")  # fmt: skip
            given = dict(zip(names, values, strict=True))
            for kind, name in zip(signature.args, names, strict=True):
                if isinstance(kind, types.Array):
                    given[name] = context.make_array(kind)(context, builder, given[name]).data

            def place(name: str, offset: Any) -> Any:
                return builder.gep(given[name], [builder.add(given[name + "_at"], offset)])

            def spread(value: Any) -> Any:
                """The number in all places of a vector."""
                if n_columns == 1:
                    return value
                one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.IntType(32)(0))
                return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), n_columns), None))

            def row(name: str, number_of_row: Any) -> Any:
                at = place(name, builder.mul(number_of_row, given[name + "_step"]))
                return builder.bitcast(at, vector.as_pointer())

            last = builder.sub(given["n_rows"], whole(1))
            rows = [builder.select(builder.icmp_signed("<", whole(i), last), whole(i), last) for i in range(ROWS)]
            columns_of_a = [place("a", builder.mul(i, given["a_stride"])) for i in rows]
            sums = [cgutils.alloca_once_value(builder, ir.Constant(vector, None)) for _ in rows]
            with cgutils.for_range(builder, given["n_terms"]) as loop:
                of_x = builder.load(row("x", loop.index), align=8)
                offset = builder.mul(loop.index, given["a_step"])
                for column, total in zip(columns_of_a, sums, strict=True):
                    term = builder.fmul(spread(builder.load(builder.gep(column, [offset]))), of_x, flags=fused)
                    builder.store(builder.fadd(builder.load(total), term, flags=fused), total)
            factor = spread(given["factor"])
            products = [builder.fmul(builder.load(total), factor, flags=fused) for total in sums]
            with builder.if_else(given["keep"]) as (added, alone):
                with added:
                    kept = [builder.load(row("source", i), align=8) for i in rows]
                    for i, of_source, found in zip(rows, kept, products, strict=True):
                        builder.store(builder.fadd(of_source, found, flags=fused), row("out", i), align=8)
                with alone:
                    for i, found in zip(rows, products, strict=True):
                        builder.store(found, row("out", i), align=8)
            return context.get_dummy_value()

        i64 = types.int64
        arguments = (
            a, i64, i64, i64, x, i64, i64, types.boolean, source, i64, i64, out, i64, i64, i64, i64, types.float64,
        )  # fmt: skip
        return types.void(*arguments), generate

    return intrinsic(tile)


tile, narrow_tile = _tile(COLUMNS), _tile(1)


@compiled()
def _product(
    shape: tuple[int, int, int],
    factor: float,
    a: Strided,
    x: Rows,
    keep: bool,
    source: Rows,
    out: Rows,
) -> None:
    """out ← factor · Aᵀ X, plus the source if it is to be kept; shape (m, n, k) of out (m, n) and of A and X, k rows.

    Rows of n numbers are written once or twice: ``out`` may not be the source, unless n is a multiple of COLUMNS.
    """
    m, n, k = shape
    for i in range(0, m, ROWS):
        n_rows = min(ROWS, m - i)
        if n < COLUMNS:
            for j in range(n):
                narrow_tile(
                    a[0], a[1] + i * a[3], a[2], a[3], x[0], x[1] + j, x[2], keep, source[0],
                    source[1] + i * source[2] + j, source[2], out[0], out[1] + i * out[2] + j, out[2], n_rows, k,
                    factor,
                )  # fmt: skip
        for begin in range(0, n if n >= COLUMNS else 0, COLUMNS):
            j = min(begin, n - COLUMNS)
            tile(
                a[0], a[1] + i * a[3], a[2], a[3], x[0], x[1] + j, x[2], keep, source[0],
                source[1] + i * source[2] + j, source[2], out[0], out[1] + i * out[2] + j, out[2], n_rows, k, factor,
            )  # fmt: skip


product = _product.dispatcher

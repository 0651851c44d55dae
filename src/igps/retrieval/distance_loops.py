"""Loops that Numba compiles for `distances`: sums over the cells, and no temporary of all pairs and cells."""

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Real
from igps._compiled import SUMS, compiled

# Rows of the gallery that the processor's second cache keeps while the queries go by, if they have some hundred cells
TILE = 64


@compiled()
def fill(queries: NDArray[Real], gallery: NDArray[Real], is_chi_square: bool, distances: NDArray[Real]) -> None:
    """Write sums over the cells, of (a−b)² / (a+b) or else of (a−b)², of rows (Q, cells) and (G, cells), to (Q, G)."""
    for begin in range(0, len(gallery), TILE):
        for q in range(len(queries)):
            for g in range(begin, min(begin + TILE, len(gallery))):
                if is_chi_square:
                    distances[q, g] = chi_square(queries[q], gallery[g])
                else:
                    distances[q, g] = square(queries[q], gallery[g])


@compiled(fastmath=SUMS)
def chi_square(a: NDArray[Real], b: NDArray[Real]) -> Real:
    """The sum of (a−b)² / (a+b) over the cells."""
    total, one = a.dtype.type(0), a.dtype.type(1)
    for cell in range(np.uint64(len(a))):
        total += term(a[cell], b[cell], one)
    return total


# Explicitly without fastmath, which Numba would take over from the caller: the square of a small number may be 0.
@compiled(fastmath=False)
def term(a: Real, b: Real, one: Real) -> Real:
    """(a−b)² / (a+b), divided before it is multiplied; 0 where both are 0."""
    apart, both = a - b, a + b
    return apart / (both if both > 0 else one) * apart


@compiled(fastmath=SUMS)
def square(a: NDArray[Real], b: NDArray[Real]) -> Real:
    """The sum of (a−b)² over the cells."""
    total = a.dtype.type(0)
    for cell in range(np.uint64(len(a))):
        apart = a[cell] - b[cell]
        total += apart * apart
    return total

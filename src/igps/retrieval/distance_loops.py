"""Compiled loops for `distances`. They need no temporary array of all pairs and cells."""

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Real
from igps._compiled import REASSOCIATE, compiled

# Rows of the gallery in a tile: with some hundred cells per row, it stays in the second-level cache for all queries.
TILE = 64


@compiled()
def fill(
    queries: NDArray[Real], gallery: NDArray[Real], is_chi_square: bool, distances: NDArray[Real]
) -> None:
    """Write the sums of (a−b)² / (a+b), or of (a−b)², over the cells of rows (Q, cells) and (G, cells) to (Q, G)."""
    for begin in range(0, len(gallery), TILE):
        for q in range(len(queries)):
            for g in range(begin, min(begin + TILE, len(gallery))):
                a = queries[q]
                b = gallery[g]
                distances[q, g] = chi_square(a, b) if is_chi_square else square(a, b)


@compiled(fastmath=REASSOCIATE)
def chi_square(a: NDArray[Real], b: NDArray[Real]) -> Real:
    """Return the sum of (a−b)² / (a+b) over the cells."""
    total = a.dtype.type(0)
    one = a.dtype.type(1)
    for cell in range(np.uint64(len(a))):
        total += term(a[cell], b[cell], one)
    return total


# Numba would inherit fastmath from the caller, which may reorder the operations: the square of a small number may be 0.
@compiled(fastmath=False)
def term(a: Real, b: Real, one: Real) -> Real:
    """Return (a−b)² / (a+b), with the division before the multiplication; 0 if both are 0."""
    difference = a - b
    total = a + b
    divisor = total if total > 0 else one
    return difference / divisor * difference


@compiled(fastmath=REASSOCIATE)
def square(a: NDArray[Real], b: NDArray[Real]) -> Real:
    """Return the sum of (a−b)² over the cells."""
    total = a.dtype.type(0)
    for cell in range(np.uint64(len(a))):
        difference = a[cell] - b[cell]
        total += difference * difference
    return total

"""A loop that Numba compiles for `balls`: a row of pairs at a time, and no matrix of all of them."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from igps._compiled import compiled

Real = TypeVar("Real", np.float32, np.float64)

_SMALLEST = 2.0**-126  # the smallest normal number of single precision


@compiled()
def bends(points: NDArray[Real], directions: NDArray[Real], tangential: float, found: NDArray[Real]) -> None:
    """Write one over the third smallest radius of each point's balls, inside and outside, to (P, 2); 0 for none.

    Args:
        points: (3, P), and their directions (3, P).
        tangential: sine of the angle to the tangent plane up to which points do not count.
        found: (P, 2), zeros.
    """
    n = points.shape[1]
    one = points.dtype.type(1)
    least = one * tangential * tangential
    smallest = one * _SMALLEST
    of_row = np.empty(n, points.dtype)
    for i in range(n):
        x, y, z = points[0, i], points[1, i], points[2, i]
        a, b, c = directions[0, i], directions[1, i], directions[2, i]
        for j in range(n):
            u, v, w = x - points[0, j], y - points[1, j], z - points[2, j]
            square = u * u + v * v + w * w
            depth = a * u + b * v + c * w
            counts = depth * depth > least * square
            of_row[j] = (depth + depth) / max(square, smallest) if counts else 0 * one
        for side in range(2):
            first = second = third = 0 * one
            for j in range(n):
                bend = of_row[j] if side == 0 else -of_row[j]
                if bend > third:
                    if bend > first:
                        first, second, third = bend, first, second
                    elif bend > second:
                        second, third = bend, second
                    else:
                        third = bend
            found[i, side] = third

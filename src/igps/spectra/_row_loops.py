"""Loops that Numba compiles for `krylov`: products of a few long rows with many.

A BLAS is made for matrices that are large both ways: with so few rows most need up to twice the time of these loops,
which keep the sums of a few rows with a few others in registers while the columns go by. `igps._compiled.beats_blas`
says where not.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from igps._compiled import SUMS, compiled

Real = TypeVar("Real", np.float32, np.float64)
Four = tuple[float, float, float, float]

# Columns of a few rows that the processor's second cache holds, and sums of as many rows that the first one holds
CHUNK, STRIP = 4096, 512


@compiled()
def overlaps(a: NDArray[np.float64], b: NDArray[np.float64], begin: int, end: int) -> NDArray[np.float64]:
    """The products (n, m) of rows (n, V) with rows (m, V), over the columns from ``begin`` to ``end``."""
    found = np.zeros((len(a), len(b)))
    for start in range(begin, end, CHUNK):
        stop = min(start + CHUNK, end)
        for j in range(0, len(b), 6):
            for i in range(0, len(a), 4):
                sums = four_by_six(a, i, b, j, start, stop)
                for column in range(min(6, len(b) - j)):
                    for row in range(min(4, len(a) - i)):
                        found[i + row, j + column] += sums[column][row]
    return found


@compiled(fastmath=SUMS)
def four_by_six(
    a: NDArray[np.float64], i: int, b: NDArray[np.float64], j: int, begin: int, end: int
) -> tuple[Four, Four, Four, Four, Four, Four]:
    """The products of four rows of one array, from ``i`` on, with each of six of another; the last stands in for more.

    By hand, as only sums that have names are kept in registers.
    """
    last, last_b = len(a) - 1, len(b) - 1
    a0, a1, a2, a3 = a[i], a[min(i + 1, last)], a[min(i + 2, last)], a[min(i + 3, last)]
    b0, b1, b2 = b[j], b[min(j + 1, last_b)], b[min(j + 2, last_b)]
    b3, b4, b5 = b[min(j + 3, last_b)], b[min(j + 4, last_b)], b[min(j + 5, last_b)]
    s0 = s1 = s2 = s3 = s4 = s5 = (0.0, 0.0, 0.0, 0.0)
    # An unsigned index is one that need not be counted from the end.
    for v in range(np.uint64(begin), np.uint64(end)):
        x = a0[v], a1[v], a2[v], a3[v]
        s0, s1, s2 = added(s0, x, b0[v]), added(s1, x, b1[v]), added(s2, x, b2[v])
        s3, s4, s5 = added(s3, x, b3[v]), added(s4, x, b4[v]), added(s5, x, b5[v])
    return s0, s1, s2, s3, s4, s5


@compiled(fastmath=SUMS)
def added(sums: Four, x: Four, y: float) -> Four:
    """Sums with y times x added."""
    return sums[0] + x[0] * y, sums[1] + x[1] * y, sums[2] + x[2] * y, sums[3] + x[3] * y


@compiled()
def subtract(rows: NDArray[np.float64], factors: NDArray[Real], others: NDArray[Real], begin: int, end: int) -> None:
    """Take (n, m) times (m, V) from rows (n, V), in the columns from ``begin`` to ``end``.

    The product is computed in the precision of the others, the difference in that of the rows.
    """
    n, m = factors.shape
    padded = np.zeros((-(-n // 4) * 4, -(-m // 4) * 4), others.dtype)
    padded[:n, :m] = factors
    sums = np.empty((len(padded), STRIP), others.dtype)
    for start in range(begin, end, STRIP):
        width = min(STRIP, end - start)
        sums[:] = 0
        for j in range(0, m, 4):
            for i in range(0, n, 4):
                add_four(sums[i : i + 4], padded[i : i + 4, j : j + 4], others, j, start, width)
        for i in range(n):
            for v in range(width):
                rows[i, start + v] -= sums[i, v]


@compiled(fastmath=SUMS)
def add_four(
    sums: NDArray[Real], factors: NDArray[Real], others: NDArray[Real], j: int, begin: int, width: int
) -> None:
    """Add to four rows of sums four of the others, from ``j`` on, times factors (4, 4); beyond the last, by 0."""
    last = len(others) - 1
    y0, y1 = others[j, begin:], others[min(j + 1, last), begin:]
    y2, y3 = others[min(j + 2, last), begin:], others[min(j + 3, last), begin:]
    f0 = factors[0, 0], factors[0, 1], factors[0, 2], factors[0, 3]
    f1 = factors[1, 0], factors[1, 1], factors[1, 2], factors[1, 3]
    f2 = factors[2, 0], factors[2, 1], factors[2, 2], factors[2, 3]
    f3 = factors[3, 0], factors[3, 1], factors[3, 2], factors[3, 3]
    s0, s1, s2, s3 = sums[0], sums[1], sums[2], sums[3]
    for v in range(np.uint64(width)):
        y = y0[v], y1[v], y2[v], y3[v]
        s0[v] += dot(f0, y)
        s1[v] += dot(f1, y)
        s2[v] += dot(f2, y)
        s3[v] += dot(f3, y)


@compiled(fastmath=SUMS)
def dot(x: Four, y: Four) -> float:
    """Inner product."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]

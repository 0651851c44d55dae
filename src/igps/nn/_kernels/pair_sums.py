"""Compiled loops that add pairs to the sums of the cells they fall into, and these to the counts.

Of a weight w and a share s one corner gets w·s and the other w − w·s, which rounding makes no less than 0.
"""

from typing import Any

import numpy as np

from igps._arrays import Floats, Integers
from igps._compiled import CONTRACTED, compiled
from igps.nn._kernels.pair_cells import Numbers, Places

# A whole pair and its share in one integer: the shares of 2¹⁸ pairs, the most of a block, do not reach the count, nor
# is a digit lost of a share of single precision, but in the first interval.
_SHARE, _PAIR = 2**24, 2**44
# Pairs that follow each other often fall into the same cell. In turn into so many copies of it, none waits for another.
LANES = 4


@compiled()
def pack_pairs(cell: Places, home: Places, share: Numbers, parts: Places) -> None:
    """Add its home to the cell of each pair (n,), and fill in its share (n,) as an integer."""
    for j in range(len(cell)):
        cell[j] = (cell[j] + home[j]) * np.int32(LANES) + np.int32(j % LANES)
        parts[j] = np.int32(share[j] * share.dtype.type(_SHARE))


@compiled()
def add_whole_pairs(cell: Places, parts: Places, packed: Integers) -> None:
    """`add_one_axis` of pairs that weigh 1, into integers (cells·LANES,): one store for both corners, no rounding."""
    for j in range(len(cell)):
        packed[np.uint32(cell[j])] += _PAIR + np.int64(parts[j])


@compiled()
def unpack(packed: Integers, sums: Floats) -> None:
    """Move what was packed to the sums (cells, 2)."""
    for c in range(len(packed) // LANES):
        pairs = packed[LANES * c : LANES * (c + 1)]
        both = 0
        for lane in range(LANES):
            both += pairs[lane]
        beyond = (both % _PAIR) / _SHARE
        sums[c, 0] = both // _PAIR - beyond
        sums[c, 1] = beyond
        pairs[:] = 0


@compiled(fastmath=CONTRACTED)
def add_one_axis(cell: Places, home: Places, share: Numbers, weights: Floats, sums: Floats) -> None:
    """Add pairs (n,) of one row to the sums (cells, 2), by the cell below the value and the first of the class.

    Weights and classes are those of the other ends.
    """
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        beyond = weights[j] * share[j]
        sums[into, 0] += weights[j] - beyond
        sums[into, 1] += beyond


@compiled(fastmath=CONTRACTED)
def add_two_axes(
    cell: Places, home: Places, first: Numbers, second: Numbers, weights: Floats, sums: Floats, at: Any
) -> None:
    """The same by the shares along two axes, into four corners from one on."""
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        a, b, c, d = quarters(weights[j], first[j], second[j])
        sums[into, at] += a
        sums[into, at + 1] += b
        sums[into, at + 2] += c
        sums[into, at + 3] += d


@compiled(fastmath=CONTRACTED)
def quarters(weight: float, first: float, second: float) -> tuple[float, float, float, float]:
    """A weight shared out between the four corners of two axes, none of them less than 0."""
    beyond = weight * first
    before = weight - beyond
    corner, side = beyond * second, before * second
    return before - side, side, beyond - corner, corner


@compiled(fastmath=CONTRACTED)
def add_four_axes(cell: Places, home: Places, shares: Numbers, first: int, weights: Floats, sums: Floats) -> None:
    """`add_axes` along four, a distance and three cosines, which takes half of the time in one pass."""
    one, two, three, four = shares[0, first:], shares[1, first:], shares[2, first:], shares[3, first:]
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        inner = quarters(1.0, np.float64(three[j]), np.float64(four[j]))
        outer = quarters(weights[j], np.float64(one[j]), np.float64(two[j]))
        # A plain number would make a function of its own of each.
        add_corners(sums, into, np.int64(0), outer[0], inner)
        add_corners(sums, into, np.int64(4), outer[1], inner)
        add_corners(sums, into, np.int64(8), outer[2], inner)
        add_corners(sums, into, np.int64(12), outer[3], inner)


@compiled(fastmath=CONTRACTED)
def add_corners(sums: Floats, cell: Any, at: Any, weight: float, parts: tuple[float, float, float, float]) -> None:
    """Add a weight to a cell's four corners from one on, in parts."""
    sums[cell, at] += weight * parts[0]
    sums[cell, at + 1] += weight * parts[1]
    sums[cell, at + 2] += weight * parts[2]
    sums[cell, at + 3] += weight * parts[3]


@compiled()
def add_axes(cell: Places, home: Places, shares: Numbers, first: int, weights: Floats, sums: Floats) -> None:
    """`add_one_axis` of the shares along any number of axes from two on, (K, n) from the first on."""
    n_outer = len(shares) - 2
    rest = np.empty(len(cell))
    for corner in range(1 << n_outer):
        for j in range(len(cell)):
            rest[j] = weights[j]
        for k in range(n_outer):
            if corner >> (n_outer - 1 - k) & 1:
                for j in range(len(cell)):
                    rest[j] *= shares[k, first + j]
            else:
                for j in range(len(cell)):
                    rest[j] -= rest[j] * shares[k, first + j]
        add_two_axes(cell, home, shares[n_outer, first:], shares[n_outer + 1, first:], rest, sums, np.int64(4 * corner))


@compiled(inline="always")
def pair_row(one: int, other: int, n_classes: int) -> int:
    """The row of a histogram in which pairs of two classes count, see `class_pairs`."""
    a, b = min(one, other), max(one, other)
    return a * n_classes - a * (a - 1) // 2 + b - a


@compiled()
def flush(sums: Floats, lowest: int, highest: int, classes: Places, weights: Floats, point: int, total: Floats) -> None:
    """Add the sums (C, cells·corners) of rows like a point, by its weights (M, P) in its classes, and clear them.

    All that was counted is from the lowest place to before the highest.
    """
    n_classes = len(sums)
    for other in range(n_classes):
        for m in range(len(classes)):
            pair = pair_row(classes[m, point], other, n_classes)
            for c in range(lowest, highest):
                total[pair, c] += weights[m, point] * sums[other, c]
        for c in range(lowest, highest):
            sums[other, c] = 0

"""Compiled loops that add pairs to the sums of their cells, and the sums to the counts.

A weight w with share s is split into w·s and w − w·s, which rounding cannot make negative.
"""

from typing import Any

import numpy as np

from igps._arrays import Floats, Integers
from igps._compiled import FUSE, compiled
from igps.nn._kernels.pair_cells import Indices, Numbers

# Scales of shares and of the number of pairs, which are packed in one integer. The shares of 2¹⁸ pairs, the maximum of
# a block, do not overflow into the number. Shares in single precision lose no digit, except in the first interval.
_SHARE_SCALE = 2**24
_PAIR_SCALE = 2**44
# Copies of each cell. Consecutive pairs often fall into the same cell, but into different copies, so that no addition
# waits for the previous one.
LANES = 4


@compiled()
def pack_pairs(cell: Indices, home: Indices, share: Numbers, integer_shares: Indices) -> None:
    """Replace the cells of pairs (n,) by indices of `add_whole_pairs`, and fill in their shares (n,) as integers."""
    for j in range(len(cell)):
        cell[j] = (cell[j] + home[j]) * np.int32(LANES) + np.int32(j % LANES)
        integer_shares[j] = np.int32(share[j] * share.dtype.type(_SHARE_SCALE))


@compiled()
def add_whole_pairs(cell: Indices, integer_shares: Indices, packed: Integers) -> None:
    """`add_one_axis` for weights of 1, to integers (cells·LANES,): one store for both corners, without rounding."""
    for j in range(len(cell)):
        packed[np.uint32(cell[j])] += _PAIR_SCALE + np.int64(integer_shares[j])


@compiled()
def unpack(packed: Integers, sums: Floats) -> None:
    """Write the packed counts to the sums (cells, 2), and clear them."""
    for c in range(len(packed) // LANES):
        packed_sum = 0
        for lane in range(LANES * c, LANES * (c + 1)):
            packed_sum += packed[lane]
            packed[lane] = 0
        upper = (packed_sum % _PAIR_SCALE) / _SHARE_SCALE
        sums[c, 0] = packed_sum // _PAIR_SCALE - upper
        sums[c, 1] = upper


@compiled(fastmath=FUSE)
def add_one_axis(
    cell: Indices, home: Indices, share: Numbers, weights: Floats, sums: Floats
) -> None:
    """Add pairs (n,) of one row to the sums (cells, 2).

    The class of a pair's second point determines its first cell (``home``); the weights are those of the second point.
    """
    for j in range(len(cell)):
        i = np.uint32(cell[j] + home[j])
        upper = weights[j] * share[j]
        sums[i, 0] += weights[j] - upper
        sums[i, 1] += upper


@compiled(fastmath=FUSE)
def add_two_axes(
    cell: Indices,
    home: Indices,
    first: Numbers,
    second: Numbers,
    weights: Floats,
    sums: Floats,
    corner: Any,
) -> None:
    """`add_one_axis` for the shares along two axes, to the four corners from ``corner`` on."""
    for j in range(len(cell)):
        i = np.uint32(cell[j] + home[j])
        a, b, c, d = quarters(weights[j], first[j], second[j])
        sums[i, corner] += a
        sums[i, corner + 1] += b
        sums[i, corner + 2] += c
        sums[i, corner + 3] += d


@compiled(fastmath=FUSE)
def quarters(weight: float, first: float, second: float) -> tuple[float, float, float, float]:
    """Share a weight between the four corners of two axes; no part is negative."""
    upper = weight * first
    lower = weight - upper
    upper_second = upper * second
    lower_second = lower * second
    return lower - lower_second, lower_second, upper - upper_second, upper_second


@compiled(fastmath=FUSE)
def add_four_axes(
    cell: Indices, home: Indices, shares: Numbers, first: int, weights: Floats, sums: Floats
) -> None:
    """`add_axes` for four axes, as of a distance and three cosines; a single pass takes half of the time."""
    one = shares[0, first:]
    two = shares[1, first:]
    three = shares[2, first:]
    four = shares[3, first:]
    for j in range(len(cell)):
        i = np.uint32(cell[j] + home[j])
        inner = quarters(1.0, np.float64(three[j]), np.float64(four[j]))
        outer = quarters(weights[j], np.float64(one[j]), np.float64(two[j]))
        # Literal numbers would compile `add_corners` four times.
        add_corners(sums, i, np.int64(0), outer[0], inner)
        add_corners(sums, i, np.int64(4), outer[1], inner)
        add_corners(sums, i, np.int64(8), outer[2], inner)
        add_corners(sums, i, np.int64(12), outer[3], inner)


@compiled(fastmath=FUSE)
def add_corners(
    sums: Floats, cell: Any, corner: Any, weight: float, parts: tuple[float, float, float, float]
) -> None:
    """Add the parts of a weight to the four corners of a cell from ``corner`` on."""
    sums[cell, corner] += weight * parts[0]
    sums[cell, corner + 1] += weight * parts[1]
    sums[cell, corner + 2] += weight * parts[2]
    sums[cell, corner + 3] += weight * parts[3]


@compiled()
def add_axes(
    cell: Indices,
    home: Indices,
    shares: Numbers,
    first: int,
    weights: Floats,
    part: Floats,
    sums: Floats,
) -> None:
    """`add_one_axis` for two or more axes, whose shares (K, J) are used from column ``first`` on.

    The parts (n,) of the weights are scratch space.
    """
    n_outer = len(shares) - 2
    for corner in range(1 << n_outer):
        for j in range(len(cell)):
            part[j] = weights[j]
        for k in range(n_outer):
            if corner >> (n_outer - 1 - k) & 1:
                for j in range(len(cell)):
                    part[j] *= shares[k, first + j]
            else:
                for j in range(len(cell)):
                    part[j] -= part[j] * shares[k, first + j]
        add_two_axes(
            cell,
            home,
            shares[n_outer, first:],
            shares[n_outer + 1, first:],
            part,
            sums,
            np.int64(4 * corner),
        )


@compiled(inline="always")
def pair_row(first: int, second: int, n_classes: int) -> int:
    """Return the row of a histogram in which pairs of two classes count, see `class_pairs`."""
    a = min(first, second)
    b = max(first, second)
    return a * n_classes - a * (a - 1) // 2 + b - a


@compiled()
def flush(
    sums: Floats, start: int, end: int, classes: Indices, weights: Floats, point: int, total: Floats
) -> None:
    """Add columns [start, end) of the sums (C, cells·corners) to the total, by a point's weights (M, P); clear them."""
    n_classes = len(sums)
    for other in range(n_classes):
        for m in range(len(classes)):
            pair = pair_row(classes[m, point], other, n_classes)
            for c in range(start, end):
                total[pair, c] += weights[m, point] * sums[other, c]
        for c in range(start, end):
            sums[other, c] = 0

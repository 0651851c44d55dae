"""Loops over pairs of points that Numba compiles: the counts of `igps.nn._kernels.pairs`, and their gradient.

A block of pairs has rows and columns: row i is point ``row + i``, column j point ``column + j`` with row ≤ column, and
the pairs whose second point comes after the first are counted, each unordered pair once. A pair falls into the cell
below its values, and is shared out between the 2^K corners of that cell: what belongs to the next bins is kept beside
the cell's own count, where one store reaches both.

Of a row, the cells of all its pairs and their shares along each axis are found first, axis by axis, in loops that the
compiler turns into vectors (`pair_cells`). Then each pair is added to its corners (`pair_sums`), or, for the gradient,
reads them.
"""

from typing import Any

import numpy as np

from igps._arrays import Floats
from igps._compiled import compiled
from igps.nn._kernels.pair_cells import COSINES, DISTANCES, Axes, Numbers, Places, locate_row, new_row, whole_vectors
from igps.nn._kernels.pair_sums import (
    LANES,
    add_axes,
    add_four_axes,
    add_one_axis,
    add_whole_pairs,
    flush,
    pack_pairs,
    pair_row,
    unpack,
)  # fmt: skip


@compiled()
def count_block(
    values: Numbers, axes: Axes, row: int, column: int, classes: Places, weights: Floats, packs: bool, total: Floats
) -> None:
    """Count a block of pairs.

    Args:
        values: (R, I, J) of the axes that are not cosines, in order; of distances the inner products, overwritten.
        axes: see there.
        row, column: see above.
        classes: (M, P) that each point belongs to, and its weights (M, P) in them.
        packs: whether there is one axis, in single precision, and M and all weights are 1.
        total: (C(C+1)/2, cells·2^K) to add to; of the corners the last axis alternates fastest.
    """
    n_rows, n_columns = values.shape[1:]
    n_axes, n_members = len(axes.n_centres), len(classes)
    n_corners = 1 << n_axes
    n_cells = total.shape[1] // n_corners
    n_classes = int(np.sqrt(2.0 * len(total)))
    # Of the row, or of rows in the same classes: by the class of the other end, whose first cell is its home.
    sums = np.zeros((n_classes * n_cells, n_corners))
    by_class = sums.reshape((n_classes, n_cells * n_corners))
    home = (classes[:, column : column + n_columns] * n_cells).astype(np.int32)
    found = new_row(axes, n_columns, values)
    packed = np.zeros((n_classes * n_cells if packs else 0) * LANES, np.int64)
    lowest, highest = no_cells(n_cells, n_members)
    for i in range(n_rows):
        point = row + i
        first = max(point + 1 - column, 0)
        start = whole_vectors(first, n_columns)
        if i > 0:
            same = True
            for m in range(n_members):
                same &= classes[m, point] == classes[m, point - 1] and weights[m, point] == weights[m, point - 1]
            if not same:
                unpack(packed, sums)
                flush(by_class, lowest * n_corners, (highest + 1) * n_corners, classes, weights, point - 1, total)
                lowest, highest = no_cells(n_cells, n_members)
        locate_row(values, i, axes, point, column, start, found)
        cell, shares = found.cells[first:], found.shares
        if n_members > 1:
            for j in range(len(cell)):
                lowest, highest = min(lowest, cell[j]), max(highest, cell[j])
        for m in range(n_members):
            begin, weight = home[m, first:], weights[m, column + first :]
            if packs:
                pack_pairs(found.cells[start:], home[0, start:], shares[0, start:], found.interval[start:])
                add_whole_pairs(cell, found.interval[first:], packed)
            elif n_axes == 1:
                add_one_axis(cell, begin, shares[0, first:], weight, sums)
            elif n_axes == 4:
                add_four_axes(cell, begin, shares, first, weight, sums)
            else:
                add_axes(cell, begin, shares, first, weight, sums)
    unpack(packed, sums)
    flush(by_class, lowest * n_corners, (highest + 1) * n_corners, classes, weights, row + n_rows - 1, total)


@compiled()
def gradient_block(
    values: Numbers, axes: Axes, row: int, column: int, classes: Places, weights: Floats, upstream: Numbers,
    turns: Numbers, by_weights: Floats, by_centres: Floats,
) -> None:  # fmt: skip
    """The gradient of `count_block`, whose first arguments are the same.

    Args:
        values: overwritten with the derivatives by them, of distances by their squares; 0 where there is no pair.
        upstream: (C(C+1)/2, cells·2^K) derivatives by the counts.
        turns: (S, 4, I, J) to fill, for each three axes of cosines, with the derivatives by u·(y − x), v·(x − y), u·v
            and |y − x|², of points x and y with directions u and v, x being that of the row.
        by_weights, by_centres: (M, P) and (K, B) to add to.
    """
    n_rows, n_columns = values.shape[1:]
    n_axes, n_members = len(axes.n_centres), len(classes)
    n_corners = 1 << n_axes
    n_classes = int(np.sqrt(2.0 * len(upstream)))
    found = new_row(axes, n_columns, values)
    cells, shares, features = found.cells, found.shares, found.features
    slopes = np.empty(n_axes)
    none = values.dtype.type(0)
    for i in range(n_rows):
        point = row + i
        first = max(point + 1 - column, 0)
        start = whole_vectors(first, n_columns)
        locate_row(values, i, axes, point, column, start, found)
        values[:, i, : min(first, n_columns)] = none
        turns[:, :, i, : min(first, n_columns)] = none
        for j in range(first, n_columns):
            other = column + j
            slopes[:] = 0
            begin = np.uint32(cells[j] * n_corners)
            for m in range(n_members):
                of_row = weights[m, point]
                for n in range(n_members):
                    of_column = weights[n, other]
                    if of_row == 0 and of_column == 0:
                        continue
                    pair = np.uint32(pair_row(classes[m, point], classes[n, other], n_classes))
                    mean = interpolate(upstream[pair], begin, shares, j, of_row * of_column, slopes)
                    by_weights[m, point] += of_column * mean
                    by_weights[n, other] += of_row * mean
            within: Any = cells[j]
            for k in range(n_axes - 1, -1, -1):
                share, width = np.float64(shares[k, j]), np.uint32(axes.n_centres[k])
                q, within = np.uint32(within % width), np.uint32(within // width)
                inside = share < 1 and (share > 0 or q > 0)  # on a centre, the slope is that beyond it
                slope = slopes[k] * axes.inverse[k, np.uint32(0) if axes.equal[k] else q] if inside else 0.0
                by_centres[k, q] -= slope * (1 - share)
                by_centres[k, q + np.uint32(1)] -= slope * share
                slopes[k] = slope
            k = r = s = 0
            for kind in axes.kinds:
                if kind == COSINES:
                    to_line, length = features[s, 4, j], features[s, 3, j]
                    own, others = slopes[k] * length, slopes[k + 1] * length
                    along = -(slopes[k] * features[s, 0, j] + slopes[k + 1] * features[s, 1, j]) * length * length / 2
                    if to_line != features[s, 0, j]:
                        own, others = others, own
                    turns[s, 0, i, j], turns[s, 1, i, j], turns[s, 2, i, j] = own, others, slopes[k + 2]
                    turns[s, 3, i, j] = along
                    k += 3
                    s += 1
                    continue
                if kind == DISTANCES:  # points that coincide have no direction to move apart in
                    values[r, i, j] = slopes[k] / (2 * values[r, i, j]) if values[r, i, j] > 0 else 0.0
                else:
                    values[r, i, j] = slopes[k]
                k += 1
                r += 1


@compiled(inline="always")
def interpolate(upstream: Numbers, begin: Any, shares: Numbers, j: int, weight: float, slopes: Floats) -> float:
    """What is upstream (cells·2^K,) of a pair, by its shares (K, J) between the corners of a cell, from one on.

    Adds its derivatives by the shares, times a weight, to the slopes (K,). Of the last two axes it takes the four
    corners at once, which stay in registers; over the corners of the others it sums.
    """
    n_outer = len(shares) - 2
    if n_outer < 0:
        low, high = np.float64(upstream[begin]), np.float64(upstream[begin + np.uint32(1)])
        slopes[0] += weight * (high - low)
        return low + shares[0, j] * (high - low)
    mean, one, two = 0.0, np.float64(shares[n_outer, j]), np.float64(shares[n_outer + 1, j])
    for corner in range(1 << n_outer):
        at = begin + np.uint32(4 * corner)
        p, q = np.float64(upstream[at]), np.float64(upstream[at + np.uint32(1)])
        r, s = np.float64(upstream[at + np.uint32(2)]), np.float64(upstream[at + np.uint32(3)])
        below, above = p + two * (q - p), r + two * (s - r)
        here, outside = below + one * (above - below), 1.0
        for k in range(n_outer):
            of_others = 1.0
            for other in range(n_outer):
                if other != k:
                    of_others *= side(shares[other, j], corner >> (n_outer - 1 - other) & 1)
            slopes[k] += weight * of_others * (here if corner >> (n_outer - 1 - k) & 1 else -here)
            outside *= side(shares[k, j], corner >> (n_outer - 1 - k) & 1)
        slopes[n_outer] += weight * outside * (above - below)
        slopes[n_outer + 1] += weight * outside * (q - p + one * (s - r - q + p))
        mean += outside * here
    return mean


@compiled(inline="always")
def side(share: Any, beyond: int) -> float:
    """What a corner has along an axis: the share if it lies beyond, or the rest of it."""
    return np.float64(share) if beyond else 1.0 - np.float64(share)


@compiled()
def no_cells(n_cells: int, n_members: int) -> tuple[int, int]:
    """The lowest and the highest cell counted in, before any is.

    Of points in one class each so many rows are counted together that to look for these two would take longer than to
    add up cells that have nothing.
    """
    return (n_cells, -1) if n_members > 1 else (0, n_cells - 1)

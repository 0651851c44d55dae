"""Loops over pairs of points that Numba compiles: the counts of `igps.nn._kernels.pairs`, and their gradient.

A block of pairs has rows and columns: row i is point ``row + i``, column j point ``column + j`` with row ≤ column, and
the pairs whose second point comes after the first are counted, each unordered pair once. A pair falls into the cell
below its values, and is shared out between the 2^K corners of that cell: what belongs to the next bins is kept beside
the cell's own count, where one store reaches both.

Of a row, the cells of all its pairs and their shares along each axis are found first, axis by axis, in loops that the
compiler turns into vectors (`locate_row`). Then each pair is added to its corners, or, for the gradient, reads them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Floats, Integers
from igps._compiled import compiled

# How the loops get the values of axes: as they are; distances from inner products; three cosines at once from points.
VALUES, DISTANCES, COSINES = 0, 1, 2
# Rows of the room for cosines: the larger and the smaller to the line, that between the directions, one over the
# length of the line, and the first point's own cosine to the line.
N_FEATURES = 5
# Numbers that a compiled loop takes at once, at most.
_VECTOR = 32
# A whole pair and its share in one integer: the shares of so many pairs do not reach the count, nor is a digit lost of
# a share of single precision, but in the first interval.
_SHARE, _PAIR, _MOST_PACKED = 2**24, 2**44, 2**18
# Pairs that follow each other often fall into the same cell. In turn into so many copies of it, none waits for another.
_LANES = 4
# Where a product and its sum may be rounded once, not twice.
_CONTRACTED: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}


class Axes(NamedTuple):
    """K axes, of which R have values and 3 S are cosines.

    Args:
        kinds: in order, `VALUES`, `DISTANCES`, or `COSINES`, which are three axes.
        norms: (R, P) squared lengths of the points of axes of distances.
        oriented: (S, 2, D, P) for each three axes of cosines the points, and their directions of length 1.
        n_dimensions: (S,) how many of the D they have.
        centres: (K, B) ascending, of each axis its own number of them.
        n_centres: (K,).
    """

    kinds: Integers
    norms: NDArray[Any]
    oriented: NDArray[Any]
    n_dimensions: Integers
    centres: NDArray[Any]
    n_centres: Integers


@compiled(error_model="numpy")
def count_block(
    values: NDArray[Any], axes: Axes, row: int, column: int, classes: NDArray[np.int32], weights: Floats, total: Floats
) -> None:
    """Count a block of pairs.

    Args:
        values: (R, I, J) of the axes that are not cosines, in order; of distances the inner products, overwritten.
        axes: see above.
        row, column: see above.
        classes: (M, P) that each point belongs to.
        weights: (M, P) in them.
        total: (C(C+1)/2, cells·2^K) to add to; of the corners the last axis alternates fastest.
    """
    n_rows, n_columns = values.shape[1:]
    n_axes, n_members = len(axes.n_centres), len(classes)
    n_corners = 1 << n_axes
    n_cells = total.shape[1] // n_corners
    n_classes = int(np.sqrt(2.0 * len(total)))
    inverse, equal = gaps(axes.centres, axes.n_centres)
    # Of the row, or of rows in the same classes: by the class of the other end, whose first cell is its home.
    sums = np.zeros((n_classes * n_cells, n_corners))
    by_class = sums.reshape((n_classes, n_cells * n_corners))
    home = (classes[:, column : column + n_columns] * n_cells).astype(np.int32)
    features = np.empty((len(axes.oriented), N_FEATURES, n_columns), values.dtype)
    shares = np.empty((n_axes, n_columns), values.dtype)
    cells, interval = np.empty(n_columns, np.int32), np.empty(n_columns, np.int32)
    packs = n_axes == 1 and values.itemsize == 4 and n_rows * n_columns <= _MOST_PACKED
    packs = packs and n_members == 1
    for j in range(weights.shape[1]):
        packs &= weights[0, j] == 1
    packed = np.zeros((n_classes * n_cells if packs else 0) * _LANES, np.int64)
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
        locate_row(values, i, axes, inverse, equal, point, column, start, features, interval, cells, shares)
        cell = cells[first:]
        if n_members > 1:
            for j in range(len(cell)):
                lowest, highest = min(lowest, cell[j]), max(highest, cell[j])
        for m in range(n_members):
            begin, weight = home[m, first:], weights[m, column + first :]
            if packs:
                pack_pairs(cells[start:], home[0, start:], shares[0, start:], interval[start:])
                add_whole_pairs(cell, interval[first:], packed)
            elif n_axes == 1:
                add_one_axis(cell, begin, shares[0, first:], weight, sums)
            elif n_axes == 2:
                add_two_axes(cell, begin, shares[0, first:], shares[1, first:], weight, sums, np.int64(0))
            elif n_axes == 4:
                add_four_axes(cell, begin, shares, first, weight, sums)
            else:
                add_axes(cell, begin, shares, first, weight, sums)
    unpack(packed, sums)
    flush(by_class, lowest * n_corners, (highest + 1) * n_corners, classes, weights, row + n_rows - 1, total)


@compiled(error_model="numpy")
def gradient_block(
    values: NDArray[Any],
    axes: Axes,
    row: int,
    column: int,
    classes: NDArray[np.int32],
    weights: Floats,
    upstream: NDArray[Any],
    turns: NDArray[Any],
    by_weights: Floats,
    by_centres: Floats,
) -> None:
    """The gradient of `count_block`, whose first arguments are the same.

    Args:
        values: overwritten with the derivatives by them, of distances by their squares; 0 where there is no pair.
        upstream: (C(C+1)/2, cells·2^K) derivatives by the counts.
        turns: (S, 4, I, J) to fill, for each three axes of cosines, with the derivatives by u·(y − x), v·(x − y), u·v
            and |y − x|², of points x and y with directions u and v, x being that of the row.
        by_weights: (M, P) to add to.
        by_centres: (K, B) to add to.
    """
    n_rows, n_columns = values.shape[1:]
    n_axes, n_members = len(axes.n_centres), len(classes)
    n_corners = 1 << n_axes
    n_classes = int(np.sqrt(2.0 * len(upstream)))
    inverse, equal = gaps(axes.centres, axes.n_centres)
    features = np.empty((len(axes.oriented), N_FEATURES, n_columns), values.dtype)
    shares = np.empty((n_axes, n_columns), values.dtype)
    cells, interval = np.empty(n_columns, np.int32), np.empty(n_columns, np.int32)
    # Numbered as the nodes of a binary tree, whose level k splits along axis k, and whose leaves are the corners: the
    # share that a node has of the pair, and the mean of what is upstream of its leaves.
    axis_of = np.empty(n_corners, np.int64)
    for node in range(1, n_corners):
        axis_of[node] = 0 if node == 1 else axis_of[node >> 1] + 1
    share_of, mean_of = np.ones(2 * n_corners), np.empty(2 * n_corners)
    slopes = np.empty(n_axes)
    none = values.dtype.type(0)
    for i in range(n_rows):
        point = row + i
        first = max(point + 1 - column, 0)
        start = whole_vectors(first, n_columns)
        locate_row(values, i, axes, inverse, equal, point, column, start, features, interval, cells, shares)
        values[:, i, : min(first, n_columns)] = none
        turns[:, :, i, : min(first, n_columns)] = none
        for j in range(first, n_columns):
            other = column + j
            for node in range(1, n_corners):
                beyond = share_of[node] * shares[axis_of[node], j]
                share_of[2 * node], share_of[2 * node + 1] = share_of[node] - beyond, beyond
            mean_of[n_corners:] = 0
            begin = cells[j] * n_corners
            for m in range(n_members):
                of_row = weights[m, point]
                for n in range(n_members):
                    of_column = weights[n, other]
                    if of_row == 0 and of_column == 0:
                        continue
                    a, b = min(classes[m, point], classes[n, other]), max(classes[m, point], classes[n, other])
                    pair = np.uint32(a * n_classes - a * (a - 1) // 2 + b - a)
                    both, mean = of_row * of_column, 0.0
                    for corner in range(n_corners):
                        above = np.float64(upstream[pair, np.uint32(begin + corner)])
                        mean_of[n_corners + corner] += both * above
                        mean += share_of[n_corners + corner] * above
                    by_weights[m, point] += of_column * mean
                    by_weights[n, other] += of_row * mean
            slopes[:] = 0
            for node in range(n_corners - 1, 0, -1):
                k = axis_of[node]
                difference = mean_of[2 * node + 1] - mean_of[2 * node]
                slopes[k] += share_of[node] * difference
                mean_of[node] = mean_of[2 * node] + shares[k, j] * difference
            within: Any = cells[j]
            for k in range(n_axes - 1, -1, -1):
                share, width = np.float64(shares[k, j]), np.uint32(axes.n_centres[k])
                q, within = np.uint32(within % width), np.uint32(within // width)
                inside = share < 1 and (share > 0 or q > 0)  # on a centre, the slope is that beyond it
                slope = slopes[k] * inverse[k, np.uint32(0) if equal[k] else q] if inside else 0.0
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


@compiled(error_model="numpy")
def no_cells(n_cells: int, n_members: int) -> tuple[int, int]:
    """The lowest and the highest cell counted in, before any is.

    Of points in one class each so many rows are counted together that to look for these two would take longer than to
    add up cells that have nothing.
    """
    return (n_cells, -1) if n_members > 1 else (0, n_cells - 1)


@compiled(error_model="numpy")
def whole_vectors(first: int, n_columns: int) -> int:
    """The column from which to work, so that it is by whole vectors: what is left over takes longer than one."""
    return max(0, n_columns - (n_columns - first + _VECTOR - 1) // _VECTOR * _VECTOR)


@compiled(error_model="numpy")
def gaps(centres: NDArray[Any], n_centres: Integers) -> tuple[NDArray[Any], Booleans]:
    """(K, B − 1) one over the gaps between centres (K, B), and (K,) whether those of an axis are all equal.

    Where they are, the first is one over their mean.
    """
    n_axes, most_centres = centres.shape
    inverse = np.empty((n_axes, most_centres - 1), centres.dtype)
    equal = np.empty(n_axes, np.bool_)
    epsilon = 2.0**-23 if centres.itemsize == 4 else 2.0**-52
    for k in range(n_axes):
        n = n_centres[k]
        first, last = centres[k, 0], centres[k, n - 1]
        mean = (last - first) / (n - 1)
        rounding = 8 * epsilon * max(abs(first), abs(last))
        equal[k] = True
        for q in range(n - 1):
            gap = centres[k, q + 1] - centres[k, q]
            inverse[k, q] = 1 / gap
            equal[k] &= abs(gap - mean) <= rounding
        if equal[k]:
            inverse[k, 0] = 1 / mean
    return inverse, equal


@compiled(error_model="numpy", inline="always")
def locate_row(
    values: NDArray[Any],
    i: int,
    axes: Axes,
    inverse: NDArray[Any],
    equal: Booleans,
    point: int,
    column: int,
    start: int,
    features: NDArray[Any],
    interval: NDArray[np.int32],
    cells: NDArray[np.int32],
    shares: NDArray[Any],
) -> None:
    """Find the cells (J,) of the pairs of one row, and their shares (K, J) along each axis.

    Args:
        values, axes, column: see `count_block`.
        i: the row, and `point` its point.
        inverse, equal: see `gaps`.
        start: the first column.
        features: (S, N_FEATURES, J) to fill, see `cosines`.
        interval: (J,) room.
        cells, shares: to fill.
    """
    cells[start:] = 0
    k = r = s = 0
    for kind in axes.kinds:
        if kind == COSINES:
            cosines(axes.oriented[s, 0], axes.oriented[s, 1], axes.n_dimensions[s], point, column, start, features[s])
            for f in range(3):
                locate(features[s, f, start:], axes.centres[k, : axes.n_centres[k]], inverse[k], equal[k],
                       interval[start:], cells[start:], shares[k, start:])  # fmt: skip
                k += 1
            s += 1
            continue
        value = values[r, i, start:]
        if kind == DISTANCES:
            distances(value, axes.norms[r, point], axes.norms[r, column + start :])
        locate(value, axes.centres[k, : axes.n_centres[k]], inverse[k], equal[k], interval[start:], cells[start:],
               shares[k, start:])  # fmt: skip
        k += 1
        r += 1


@compiled(error_model="numpy")
def distances(products: NDArray[Any], norm: Any, norms: NDArray[Any]) -> None:
    """Turn inner products (n,) of a point with others into distances; from the squared lengths of it and of them."""
    two, none = products.dtype.type(2), products.dtype.type(0)
    for j in range(len(products)):
        products[j] = np.sqrt(max(norm + norms[j] - two * products[j], none))


@compiled(error_model="numpy")
def cosines(
    points: NDArray[Any],
    directions: NDArray[Any],
    n_dimensions: int,
    point: int,
    column: int,
    start: int,
    features: NDArray[Any],
) -> None:
    """The `point_pair_features` of a point with those of the columns from a start on.

    Args:
        points: (D, P), and their directions (D, P) of length 1, of which the first `n_dimensions` count.
        point: number of the point.
        column, start: number of the point of the first column, and the first column.
        features: (N_FEATURES, J) to fill.
    """
    least, none, most = features.dtype.type(-1), features.dtype.type(0), features.dtype.type(1)
    # Slices of rows, one by one: of a slice of them all it would not be known that they have no gaps.
    here, there, between = features[0, start:], features[1, start:], features[2, start:]
    length, own = features[3, start:], features[4, start:]
    n = len(length)
    length[:] = none
    here[:] = none
    there[:] = none
    between[:] = none
    for d in range(n_dimensions):
        x, u = points[d, point], directions[d, point]
        xs, us = points[d, column + start :], directions[d, column + start :]
        for j in range(n):  # few arrays in a loop: of many the compiler makes no vectors
            line = xs[j] - x
            length[j] += line * line
            here[j] += u * line
        for j in range(n):
            there[j] += us[j] * (x - xs[j])
        for j in range(n):
            between[j] += u * us[j]
    for j in range(n):
        inverse = most / np.sqrt(length[j]) if length[j] > none else none
        own[j], length[j] = min(max(here[j] * inverse, least), most), inverse
    for j in range(n):
        other = min(max(there[j] * length[j], least), most)
        here[j], there[j] = max(own[j], other), min(own[j], other)


@compiled(error_model="numpy")
def locate(
    values: NDArray[Any],
    centres: NDArray[Any],
    inverse: NDArray[Any],
    equal: bool,
    interval: NDArray[np.int32],
    cell: NDArray[np.int32],
    share: NDArray[Any],
) -> None:
    """Sort values (n,) of an axis into the intervals between its centres.

    Args:
        values: of one row.
        centres: (B,) ascending.
        inverse, equal: of the axis, see `gaps`.
        interval: (n,) room.
        cell: (n,) by the axes before, to be refined.
        share: (n,) to fill: how far each value is on the way from the centre below to that above.
    """
    none, one, end = values.dtype.type(0), values.dtype.type(1), values.dtype.type(len(centres) - 1)
    width, last = np.int32(len(centres)), np.int32(len(centres) - 2)
    if equal:
        origin, scale = centres[0], inverse[0]
        for j in range(len(values)):
            along = (values[j] - origin) * scale
            along = along if along > none else none
            along = along if along < end else end
            q = min(np.int32(along), last)
            share[j] = along - values.dtype.type(q)
            cell[j] = cell[j] * width + q
        return
    half = 1
    while 2 * half <= last:
        half *= 2
    interval[:] = 0
    while half > 0:  # a search by halves, of all values at once
        step = np.int32(half)
        for j in range(len(values)):
            # An unsigned index is one that need not be counted from the end.
            q = min(np.int32(interval[j] + step), last)
            interval[j] = q if values[j] >= centres[np.uint32(q)] else interval[j]
        half //= 2
    for j in range(len(values)):
        below = np.uint32(interval[j])
        share[j] = min(max((values[j] - centres[below]) * inverse[below], none), one)
        cell[j] = cell[j] * width + interval[j]


@compiled(error_model="numpy")
def pack_pairs(cell: NDArray[np.int32], home: NDArray[np.int32], share: NDArray[Any], parts: NDArray[np.int32]) -> None:
    """Add its home to the cell of each pair (n,), and fill in its share (n,) as an integer."""
    for j in range(len(cell)):
        cell[j] = (cell[j] + home[j]) * np.int32(_LANES) + np.int32(j % _LANES)
        parts[j] = np.int32(share[j] * share.dtype.type(_SHARE))


@compiled(error_model="numpy")
def add_whole_pairs(cell: NDArray[np.int32], parts: NDArray[np.int32], packed: Integers) -> None:
    """`add_one_axis` of pairs that weigh 1, into integers (cells·_LANES,): one store for both corners, no rounding."""
    for j in range(len(cell)):
        packed[np.uint32(cell[j])] += _PAIR + np.int64(parts[j])


@compiled(error_model="numpy")
def unpack(packed: Integers, sums: Floats) -> None:
    """Move what was packed to the sums (cells, 2)."""
    for c in range(len(packed) // _LANES):
        pairs = packed[_LANES * c : _LANES * (c + 1)]
        both = 0
        for lane in range(_LANES):
            both += pairs[lane]
        beyond = (both % _PAIR) / _SHARE
        sums[c, 0] = both // _PAIR - beyond
        sums[c, 1] = beyond
        pairs[:] = 0


@compiled(**_CONTRACTED)
def add_one_axis(
    cell: NDArray[np.int32], home: NDArray[np.int32], share: NDArray[Any], weights: Floats, sums: Floats
) -> None:
    """Add pairs of one row to the sums (cells, 2).

    Of a weight w and a share s one corner gets w·s and the other w − w·s, which rounding makes no less than 0.

    Args:
        cell: (n,) of the centres below the values.
        home: (n,) first of the cells of the class of the other end.
        share: (n,) along the axis.
        weights: (n,) of the other ends.
        sums: see above.
    """
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        beyond = weights[j] * share[j]
        sums[into, 0] += weights[j] - beyond
        sums[into, 1] += beyond


@compiled(**_CONTRACTED)
def add_two_axes(
    cell: NDArray[np.int32],
    home: NDArray[np.int32],
    first: NDArray[Any],
    second: NDArray[Any],
    weights: Floats,
    sums: Floats,
    at: Any,
) -> None:
    """`add_one_axis` of the shares along two axes, into four corners from one on."""
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        a, b, c, d = quarters(weights[j], first[j], second[j])
        sums[into, at] += a
        sums[into, at + 1] += b
        sums[into, at + 2] += c
        sums[into, at + 3] += d


@compiled(**_CONTRACTED)
def quarters(weight: float, first: float, second: float) -> tuple[float, float, float, float]:
    """A weight shared out between the four corners of two axes, none of them less than 0."""
    beyond = weight * first
    before = weight - beyond
    corner, side = beyond * second, before * second
    return before - side, side, beyond - corner, corner


@compiled(**_CONTRACTED)
def add_four_axes(
    cell: NDArray[np.int32], home: NDArray[np.int32], shares: NDArray[Any], first: int, weights: Floats, sums: Floats
) -> None:
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


@compiled(**_CONTRACTED)
def add_corners(sums: Floats, cell: Any, at: Any, weight: float, parts: tuple[float, float, float, float]) -> None:
    """Add a weight to a cell's four corners from one on, in parts."""
    sums[cell, at] += weight * parts[0]
    sums[cell, at + 1] += weight * parts[1]
    sums[cell, at + 2] += weight * parts[2]
    sums[cell, at + 3] += weight * parts[3]


@compiled(error_model="numpy")
def add_axes(
    cell: NDArray[np.int32], home: NDArray[np.int32], shares: NDArray[Any], first: int, weights: Floats, sums: Floats
) -> None:
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


@compiled(error_model="numpy")
def flush(
    sums: Floats, lowest: int, highest: int, classes: NDArray[np.int32], weights: Floats, point: int, total: Floats
) -> None:
    """Add the sums (C, cells·corners) of rows like a point, by its weights (M, P) in its classes, and clear them.

    All that was counted is from the lowest place to before the highest.
    """
    n_classes = len(sums)
    for other in range(n_classes):
        for m in range(len(classes)):
            a, b = min(classes[m, point], other), max(classes[m, point], other)
            pair = a * n_classes - a * (a - 1) // 2 + b - a
            for c in range(lowest, highest):
                total[pair, c] += weights[m, point] * sums[other, c]
        for c in range(lowest, highest):
            sums[other, c] = 0

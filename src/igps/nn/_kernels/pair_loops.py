"""Loops over pairs of points that Numba compiles: what `igps.nn._kernels.counted_pairs` counts with.

A block of pairs has rows and columns: row i is point ``row + i``, column j point ``column + j`` with row ≤ column, and
counted are the pairs whose second point comes after the first, each unordered pair once. A pair is sorted into the cell
of the centres below its values, and shared out between the corners of that cell, two an axis: what belongs to the next
cell is kept beside the cell's own, where one store reaches both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._compiled import compiled

# Entries for each centre in the table from a value to its interval.
_TABLE_PER_CENTRE = 16
_FEW_CENTRES = 12
# Numbers that a compiled loop takes at once, at most.
_VECTOR = 32
# A whole pair and its share in one integer: the shares of so many pairs do not reach the count, nor is a digit lost of
# a share of single precision, but in the first interval.
_SHARE, _PAIR, _MOST_PACKED = 2**24, 2**44, 2**18
# Pairs that follow each other often fall into the same cell. In turn into so many copies of it, none waits for another.
_LANES = 4
# Where a product and its sum may be rounded once, not twice.
_CONTRACTED: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}


@compiled(error_model="numpy")
def add_pairs(
    values: NDArray[Any],
    norms: NDArray[Any],
    oriented: NDArray[Any],
    n_dimensions: NDArray[np.int64],
    centres: NDArray[Any],
    n_centres: NDArray[np.int64],
    row: int,
    column: int,
    classes: NDArray[np.int32],
    weights: NDArray[np.float64],
    total: NDArray[np.float64],
) -> None:
    """Count a block of pairs.

    Args:
        values: (K', I, J) inner products of the points of each axis of distances, which come first; overwritten.
        norms: (K', P) squared lengths of these points.
        oriented: (S, 2, D, P) points, and their directions, whose `line_features` are three axes each.
        n_dimensions: (S,) how many of the D they have.
        centres: (K, B) ascending, of each axis its own number of them.
        n_centres: (K,).
        row, column: see above.
        classes: (M, P) that each point belongs to.
        weights: (M, P) of them, descending; 0 where a point belongs to fewer.
        total: (C(C+1)/2, cells·2^K) to add to; of the corners the last axis alternates fastest.
    """
    n_distances, n_rows, n_columns = values.shape
    n_axes = len(n_centres)
    n_corners = 1 << n_axes
    n_cells = total.shape[1] // n_corners
    n_classes = int(np.sqrt(2.0 * len(total)))
    n_members = len(classes)
    inverse, below, per_length, most = tables(centres, n_centres)
    # Of the row, or of rows in the same classes: by the class of the other end, whose first cell is its home.
    sums = np.zeros((n_classes * n_cells, n_corners))
    by_class = sums.reshape((n_classes, n_cells * n_corners))
    home = (classes[:, column : column + n_columns] * n_cells).astype(np.int32)
    shares = np.empty((n_axes, n_columns), values.dtype)
    features = np.empty((4, n_columns), values.dtype)
    cells, interval = np.empty(n_columns, np.int32), np.empty(n_columns, np.int32)
    packs = n_axes == 1 and values.itemsize == 4 and n_rows * n_columns <= _MOST_PACKED and are_whole(weights)
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
                flush(
                    by_class,
                    lowest * n_corners,
                    (highest + 1) * n_corners,
                    classes[:, point - 1],
                    weights[:, point - 1],
                    total,
                )
                lowest, highest = no_cells(n_cells, n_members)
        cells[start:] = 0
        for k in range(n_axes):
            n, cell, share = n_centres[k], cells[start:], shares[k, start:]
            if k < n_distances:
                value = values[k, i, start:]
                distances(value, norms[k, point], norms[k, column + start :])
            else:
                s, feature = divmod(k - n_distances, 3)
                if feature == 0:
                    # Slices of rows, one by one: of a slice of them all it would not be known that they have no gaps.
                    line_features(
                        oriented[s, 0],
                        oriented[s, 1],
                        n_dimensions[s],
                        point,
                        column + start,
                        features[0, start:],
                        features[1, start:],
                        features[2, start:],
                        features[3, start:],
                    )
                value = features[1 + feature, start:]
            if most[k] == 0:
                locate_equal(value, centres[k, 0], inverse[k, 0], n, cell, share)
            else:
                locate(value, centres[k, :n], inverse[k], below[k], per_length[k], most[k], interval, cell, share)
        cell = cells[first:]
        if n_members > 1:
            for j in range(len(cell)):
                lowest, highest = min(lowest, cell[j]), max(highest, cell[j])
        for m in range(n_members):
            begin, weight = home[m, first:], weights[m, column + first :]
            if packs:
                place_whole_pairs(cells[start:], home[m, start:], shares[0, start:], interval[start:])
                share_whole_pairs(cell, interval[first:], packed)
            elif n_axes == 1:
                share_one_axis(cell, begin, shares[0, first:], weight, sums)
            elif n_axes == 2:
                share_two_axes(cell, begin, shares[0, first:], shares[1, first:], weight, sums, 0)
            elif n_axes == 4:
                share_four_axes(cell, begin, shares, first, weight, sums)
            else:
                share_axes(cell, begin, shares, first, weight, sums)
    unpack(packed, sums)
    flush(
        by_class,
        lowest * n_corners,
        (highest + 1) * n_corners,
        classes[:, row + n_rows - 1],
        weights[:, row + n_rows - 1],
        total,
    )


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
def line_features(
    points: NDArray[Any],
    directions: NDArray[Any],
    n_dimensions: int,
    at: int,
    others: int,
    length: NDArray[Any],
    here: NDArray[Any],
    there: NDArray[Any],
    between: NDArray[Any],
) -> None:
    """The `point_pair_features` of a point with n others that follow each other.

    Args:
        points: (D, P).
        directions: (D, P) of length 1.
        n_dimensions: how many of the D they have.
        at: number of the point.
        others: of the first of the others.
        length: (n,) room, for the squared lengths of the lines from it to them.
        here, there: (n,) to fill: the larger and the smaller cosine to the line.
        between: (n,) to fill: the cosine between the directions.
    """
    least, none, most = here.dtype.type(-1), here.dtype.type(0), here.dtype.type(1)
    n = len(length)
    if n_dimensions == 3:  # all three coordinates at once, but few arrays in a loop: of many it makes no vectors
        x, y, z = points[0, at], points[1, at], points[2, at]
        u, v, w = directions[0, at], directions[1, at], directions[2, at]
        xs, ys, zs = points[0, others:], points[1, others:], points[2, others:]
        us, vs, ws = directions[0, others:], directions[1, others:], directions[2, others:]
        for j in range(n):
            a, b, c = xs[j] - x, ys[j] - y, zs[j] - z
            length[j] = a * a + b * b + c * c
            here[j] = u * a + v * b + w * c
        for j in range(n):
            there[j] = us[j] * (x - xs[j]) + vs[j] * (y - ys[j]) + ws[j] * (z - zs[j])
        for j in range(n):
            between[j] = u * us[j] + v * vs[j] + w * ws[j]
    else:
        length[:] = 0
        here[:] = 0
        there[:] = 0
        between[:] = 0
        for d in range(n_dimensions):
            x, u = points[d, at], directions[d, at]
            xs, us = points[d, others:], directions[d, others:]
            for j in range(n):
                line = xs[j] - x
                length[j] += line * line
                here[j] += u * line
                there[j] -= us[j] * line
                between[j] += u * us[j]
    for j in range(n):
        inverse = most / np.sqrt(length[j]) if length[j] > none else none
        a, b = min(max(here[j] * inverse, least), most), min(max(there[j] * inverse, least), most)
        here[j], there[j] = max(a, b), min(a, b)


@compiled(error_model="numpy")
def distances(products: NDArray[Any], norm: Any, norms: NDArray[Any]) -> None:
    """Turn inner products (n,) of a point with others into distances; from the squared lengths of it and of them."""
    two, none = products.dtype.type(2), products.dtype.type(0)
    for j in range(len(products)):
        products[j] = np.sqrt(max(norm + norms[j] - two * products[j], none))


@compiled(error_model="numpy")
def tables(
    centres: NDArray[Any], n_centres: NDArray[np.int64]
) -> tuple[NDArray[Any], NDArray[np.int32], NDArray[Any], NDArray[np.int64]]:
    """What finds the interval of a value, for each axis.

    Returns:
        (K, B − 1) one over the gaps between centres (K, B); (K, T) how many of the centres that are neither first nor
        last lie in the steps below each of T equal steps; (K,) steps per length; (K,) most of them in one step, 0 where
        all gaps are equal and no table is needed.
    """
    n_axes, most_centres = centres.shape
    n_steps = _TABLE_PER_CENTRE * most_centres
    inverse = np.ones((n_axes, most_centres - 1), centres.dtype)
    below = np.zeros((n_axes, n_steps + 1), np.int32)
    per_length = np.empty(n_axes, centres.dtype)
    most = np.zeros(n_axes, np.int64)
    for k in range(n_axes):
        n = n_centres[k]
        first, last = centres[k, 0], centres[k, n - 1]
        gap = (last - first) / (n - 1)
        rounding = 8 * np.finfo(centres.dtype).eps * max(abs(first), abs(last))
        equal = True
        for q in range(n - 1):
            inverse[k, q] = 1 / (centres[k, q + 1] - centres[k, q])
            equal &= abs(centres[k, q + 1] - centres[k, q] - gap) <= rounding
        per_length[k] = n_steps / (last - first)
        if equal:
            inverse[k, 0] = 1 / gap
            continue
        for q in range(1, n - 1):
            below[k, np.int64((centres[k, q] - first) * per_length[k]) + 1] += 1
        for step in range(n_steps):
            most[k] = max(most[k], below[k, step + 1])
            below[k, step + 1] += below[k, step]
    return inverse, below, per_length, most


@compiled(error_model="numpy")
def locate_equal(
    values: NDArray[Any], origin: Any, inverse: Any, n: int, cell: NDArray[np.int32], share: NDArray[Any]
) -> None:
    """`locate` where the centres are n ones at equal distances from an origin on."""
    none, end = values.dtype.type(0), values.dtype.type(n - 1)
    width, last = np.int32(n), np.int32(n - 2)
    for j in range(len(values)):
        along = (values[j] - origin) * inverse
        along = along if along > none else none
        along = along if along < end else end
        interval = min(np.int32(along), last)
        share[j] = along - values.dtype.type(interval)
        cell[j] = cell[j] * width + interval


@compiled(error_model="numpy")
def locate(
    values: NDArray[Any],
    centres: NDArray[Any],
    inverse: NDArray[Any],
    below: NDArray[np.int32],
    per_length: Any,
    most: int,
    interval: NDArray[np.int32],
    cell: NDArray[np.int32],
    share: NDArray[Any],
) -> None:
    """Sort values (n,) of an axis into the intervals between its centres.

    Args:
        values: of one row.
        centres, inverse, below, per_length, most: of the axis, see `tables`.
        interval: room for n numbers.
        cell: (n,) by the axes before, to be refined.
        share: (n,) to fill: how far each value is on the way from the centre below to that above.
    """
    none, one, end = values.dtype.type(0), values.dtype.type(1), values.dtype.type(len(below) - 1)
    width, last = np.int32(len(centres)), np.int32(len(centres) - 2)
    if width <= _FEW_CENTRES:
        # How far past each centre on the way to the next, 0 to 1, in sum: a search takes longer.
        share[: len(values)] = none
        for q in range(width - 1):
            for j in range(len(values)):
                share[j] += min(max((values[j] - centres[q]) * inverse[q], none), one)
        for j in range(len(values)):
            k = min(np.int32(share[j]), last)
            share[j] = min(share[j] - values.dtype.type(k), one)
            cell[j] = cell[j] * width + k
        return
    # An unsigned index is one that need not be counted from the end.
    for j in range(len(values)):
        interval[j] = below[np.uint32(min(max((values[j] - centres[0]) * per_length, none), end))]
    for _ in range(most):
        for j in range(len(values)):
            q = min(interval[j], last)
            interval[j] += values[j] >= centres[np.uint32(q + 1)]
    for j in range(len(values)):
        k = min(interval[j], last)
        share[j] = (values[j] - centres[np.uint32(k)]) * inverse[np.uint32(k)]
        cell[j] = cell[j] * width + k
    for j in range(len(values)):
        share[j] = min(max(share[j], none), one)


@compiled(error_model="numpy")
def are_whole(weights: NDArray[np.float64]) -> bool:
    """Whether all points belong to one class each."""
    return len(weights) == 1 and weights.min() == 1


@compiled(error_model="numpy")
def place_whole_pairs(
    cell: NDArray[np.int32], home: NDArray[np.int32], share: NDArray[Any], parts: NDArray[np.int32]
) -> None:
    """Add its home to the cell of each pair (n,), and fill in its share (n,) as an integer."""
    for j in range(len(cell)):
        cell[j] = (cell[j] + home[j]) * np.int32(_LANES) + np.int32(j % _LANES)
        parts[j] = np.int32(share[j] * share.dtype.type(_SHARE))


@compiled(error_model="numpy")
def share_whole_pairs(cell: NDArray[np.int32], parts: NDArray[np.int32], packed: NDArray[np.int64]) -> None:
    """`share_one_axis` of pairs that weigh 1, into integers (cells,): one store for both corners, and no rounding."""
    for j in range(len(cell)):
        packed[np.uint32(cell[j])] += _PAIR + np.int64(parts[j])


@compiled(error_model="numpy")
def unpack(packed: NDArray[np.int64], sums: NDArray[np.float64]) -> None:
    """Move what was packed to the sums (cells, 2)."""
    for c in range(len(packed) // _LANES):
        pairs = packed[_LANES * c : _LANES * (c + 1)]
        both = pairs.sum()
        beyond = (both % _PAIR) / _SHARE
        sums[c, 0] = both // _PAIR - beyond
        sums[c, 1] = beyond
        pairs[:] = 0


@compiled(**_CONTRACTED)
def share_one_axis(
    cell: NDArray[np.int32],
    home: NDArray[np.int32],
    share: NDArray[Any],
    weights: NDArray[np.float64],
    sums: NDArray[np.float64],
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
        # An unsigned index is one that need not be counted from the end.
        into = np.uint32(cell[j] + home[j])
        beyond = weights[j] * share[j]
        sums[into, 0] += weights[j] - beyond
        sums[into, 1] += beyond


@compiled(**_CONTRACTED)
def share_two_axes(
    cell: NDArray[np.int32],
    home: NDArray[np.int32],
    first: NDArray[Any],
    second: NDArray[Any],
    weights: NDArray[np.float64],
    sums: NDArray[np.float64],
    at: int,
) -> None:
    """`share_one_axis` of the shares along two axes, into four corners from one on."""
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        before, side, beyond, corner = quarters(weights[j], np.float64(first[j]), np.float64(second[j]))
        sums[into, at] += before
        sums[into, at + 1] += side
        sums[into, at + 2] += beyond
        sums[into, at + 3] += corner


@compiled(**_CONTRACTED)
def share_four_axes(
    cell: NDArray[np.int32],
    home: NDArray[np.int32],
    shares: NDArray[Any],
    first: int,
    weights: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """`share_one_axis` of the shares along four axes, (4, n) from the first on: a distance and three cosines."""
    one, two, three, four = shares[0, first:], shares[1, first:], shares[2, first:], shares[3, first:]
    for j in range(len(cell)):
        into = np.uint32(cell[j] + home[j])
        inner = quarters(1.0, np.float64(three[j]), np.float64(four[j]))
        a, b, c, d = quarters(weights[j], np.float64(one[j]), np.float64(two[j]))
        add_corners(sums, into, 0, a, inner)
        add_corners(sums, into, 4, b, inner)
        add_corners(sums, into, 8, c, inner)
        add_corners(sums, into, 12, d, inner)


@compiled(error_model="numpy")
def share_axes(
    cell: NDArray[np.int32],
    home: NDArray[np.int32],
    shares: NDArray[Any],
    first: int,
    weights: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """`share_one_axis` of the shares along any number of axes from two on, (K, n) from the first on."""
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
        share_two_axes(cell, home, shares[n_outer, first:], shares[n_outer + 1, first:], rest, sums, 4 * corner)


@compiled(**_CONTRACTED)
def quarters(weight: float, first: float, second: float) -> tuple[float, float, float, float]:
    """A weight shared out between the four corners of two axes, none of them less than 0."""
    beyond = weight * first
    before = weight - beyond
    corner = beyond * second
    side = before * second
    return before - side, side, beyond - corner, corner


@compiled(**_CONTRACTED)
def add_corners(
    sums: NDArray[np.float64], cell: Any, at: int, weight: float, parts: tuple[float, float, float, float]
) -> None:
    """Add a weight to a cell's four corners from one on, in parts."""
    sums[cell, at] += weight * parts[0]
    sums[cell, at + 1] += weight * parts[1]
    sums[cell, at + 2] += weight * parts[2]
    sums[cell, at + 3] += weight * parts[3]


@compiled(error_model="numpy")
def flush(
    sums: NDArray[np.float64],
    lowest: int,
    highest: int,
    classes: NDArray[np.int32],
    weights: NDArray[np.float64],
    total: NDArray[np.float64],
) -> None:
    """Add the sums (C, cells·corners) of rows in the classes (M,) by weights (M,) to the total, and clear them.

    All that was counted is from the lowest place to before the highest.
    """
    n_classes = len(sums)
    for other in range(n_classes):
        for m in range(len(classes)):
            a, b = min(classes[m], other), max(classes[m], other)
            row = a * n_classes - a * (a - 1) // 2 + b - a
            for c in range(lowest, highest):
                total[row, c] += weights[m] * sums[other, c]
        for c in range(lowest, highest):
            sums[other, c] = 0

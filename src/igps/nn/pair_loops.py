"""Loops over pairs of points that Numba compiles: what `igps.nn.counted_pairs` counts with.

A block of pairs has rows and columns: row i is point ``row + i``, column j point ``column + j`` with row ≤ column, and
counted are the pairs whose second point comes after the first, each unordered pair once. Every axis of the histogram
has a plane of values of the block. A pair is sorted into the cell of the centres below its values, and shared out
between the corners of that cell, two an axis: what belongs to the next cell is kept beside the cell's own, where one
store reaches both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps.compiled import compiled

# Entries for each centre in the table from a value to its interval.
_TABLE_PER_CENTRE = 16
_FEW_CENTRES = 12


@compiled(error_model="numpy")
def add_features(points: NDArray[Any], directions: NDArray[Any], row: int, column: int, features: NDArray[Any]) -> None:
    """Fill the planes (3, I, J) of a block with the `point_pair_features` of its pairs.

    Args:
        points: (D, P).
        directions: (D, P) of length 1.
        row, column: see above.
        features: the larger and the smaller cosine to the line, and that between the directions.
    """
    _, n_rows, n_columns = features.shape
    squared = np.empty(n_columns, features.dtype)
    least, most = features.dtype.type(-1), features.dtype.type(1)
    for i in range(n_rows):
        start = max(row + i + 1 - column, 0)
        n_pairs = n_columns - start
        length = squared[:n_pairs]
        here, there, between = features[0, i, start:], features[1, i, start:], features[2, i, start:]
        length[:] = 0
        here[:] = 0
        there[:] = 0
        between[:] = 0
        for d in range(len(points)):
            x, n = points[d, row + i], directions[d, row + i]
            others, their_directions = points[d, column + start :], directions[d, column + start :]
            for j in range(n_pairs):
                line = others[j] - x
                length[j] += line * line
                here[j] += n * line
                there[j] -= their_directions[j] * line
                between[j] += n * their_directions[j]
        for j in range(n_pairs):
            inverse = most / np.sqrt(length[j]) if length[j] > 0 else features.dtype.type(0)
            a, b = min(max(here[j] * inverse, least), most), min(max(there[j] * inverse, least), most)
            here[j], there[j] = max(a, b), min(a, b)


@compiled(error_model="numpy")
def add_pairs(
    values: NDArray[Any],
    norms: NDArray[Any],
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
        values: (K, I, J) of each axis; of an axis of distances the inner products of the points.
        norms: (K', P) squared lengths of the points, of the axes of distances, which are the first.
        centres: (K, B) ascending, of each axis its own number of them.
        n_centres: (K,).
        row, column: see above.
        classes: (M, P) that each point belongs to.
        weights: (M, P) of them, descending; 0 where a point belongs to fewer.
        total: (C(C+1)/2, cells·2^K) to add to; of the corners the last axis alternates fastest.
    """
    n_axes, n_rows, n_columns = values.shape
    n_corners = 1 << n_axes
    n_cells = total.shape[1] // n_corners
    n_classes = int(np.sqrt(2.0 * len(total)))
    n_members = len(classes)
    inverse, below, per_length, most = tables(centres, n_centres)
    # Of the row, or of rows in the same classes: by the class of the other end.
    sums = np.zeros((n_classes * n_cells, n_corners))
    by_class = sums.reshape((n_classes, n_cells * n_corners))
    shares = np.empty((n_axes, n_columns), values.dtype)
    cells, interval, member = np.empty((3, n_columns), np.int32)
    lowest, highest = n_cells, -1
    for i in range(n_rows):
        point = row + i
        other = max(point + 1, column)
        n_pairs = column + n_columns - other
        if i > 0:
            same = True
            for m in range(n_members):
                same &= classes[m, point] == classes[m, point - 1] and weights[m, point] == weights[m, point - 1]
            if not same:
                flush(
                    by_class,
                    lowest * n_corners,
                    (highest + 1) * n_corners,
                    classes[:, point - 1],
                    weights[:, point - 1],
                    total,
                )
                lowest, highest = n_cells, -1
        cell = cells[:n_pairs]
        cell[:] = 0
        for k in range(n_axes):
            value, n = values[k, i, other - column :], n_centres[k]
            if k < len(norms):
                distances(value, norms[k, point], norms[k, other:])
            if most[k] == 0:
                locate_equal(value, centres[k, 0], inverse[k, 0], n, cell, shares[k])
            else:
                locate(value, centres[k, :n], inverse[k], below[k], per_length[k], most[k], interval, cell, shares[k])
        for j in range(n_pairs):
            lowest, highest = min(lowest, cell[j]), max(highest, cell[j])
        for m in range(n_members):
            for j in range(n_pairs):
                member[j] = cell[j] + classes[m, other + j] * n_cells
            if n_axes == 1:
                share_one_axis(member[:n_pairs], shares[0], weights[m, other:], sums)
            elif n_axes == 2:
                share_two_axes(member[:n_pairs], shares[0], shares[1], weights[m, other:], sums, 0)
            elif n_axes == 4:
                share_four_axes(member[:n_pairs], shares, weights[m, other:], sums)
            else:
                share_axes(member[:n_pairs], shares, weights[m, other:], sums)
    flush(
        by_class,
        lowest * n_corners,
        (highest + 1) * n_corners,
        classes[:, row + n_rows - 1],
        weights[:, row + n_rows - 1],
        total,
    )


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
def share_one_axis(
    cell: NDArray[np.int32], share: NDArray[Any], weights: NDArray[np.float64], sums: NDArray[np.float64]
) -> None:
    """Add pairs (n,) of one row, of weights (n,), to the sums (cells, 2).

    Of a weight w and a share s one corner gets w·s and the other w − w·s, which rounding makes no less than 0.
    """
    for j in range(len(cell)):
        into = sums[cell[j]]
        beyond = weights[j] * share[j]
        into[0] += weights[j] - beyond
        into[1] += beyond


@compiled(error_model="numpy")
def share_two_axes(
    cell: NDArray[np.int32],
    first: NDArray[Any],
    second: NDArray[Any],
    weights: NDArray[np.float64],
    sums: NDArray[np.float64],
    at: int,
) -> None:
    """`share_one_axis` of the shares along two axes, into four corners from one on."""
    for j in range(len(cell)):
        add_quarters(weights[j], np.float64(first[j]), np.float64(second[j]), sums[cell[j]], at)


@compiled(error_model="numpy")
def share_four_axes(
    cell: NDArray[np.int32], shares: NDArray[Any], weights: NDArray[np.float64], sums: NDArray[np.float64]
) -> None:
    """`share_one_axis` of the shares (4, n) along four axes: a distance and three cosines."""
    for j in range(len(cell)):
        into = sums[cell[j]]
        c, d = np.float64(shares[2, j]), np.float64(shares[3, j])
        beyond = weights[j] * shares[0, j]
        before = weights[j] - beyond
        corner = beyond * shares[1, j]
        side = before * shares[1, j]
        add_quarters(before - side, c, d, into, 0)
        add_quarters(side, c, d, into, 4)
        add_quarters(beyond - corner, c, d, into, 8)
        add_quarters(corner, c, d, into, 12)


@compiled(error_model="numpy")
def share_axes(
    cell: NDArray[np.int32], shares: NDArray[Any], weights: NDArray[np.float64], sums: NDArray[np.float64]
) -> None:
    """`share_one_axis` of the shares (K, n) along any number of axes from two on."""
    n_outer = len(shares) - 2
    rest = np.empty(len(cell))
    for corner in range(1 << n_outer):
        for j in range(len(cell)):
            rest[j] = weights[j]
        for k in range(n_outer):
            if corner >> (n_outer - 1 - k) & 1:
                for j in range(len(cell)):
                    rest[j] *= shares[k, j]
            else:
                for j in range(len(cell)):
                    rest[j] -= rest[j] * shares[k, j]
        share_two_axes(cell, shares[n_outer], shares[n_outer + 1], rest, sums, 4 * corner)


@compiled(error_model="numpy")
def add_quarters(weight: float, first: float, second: float, into: NDArray[np.float64], at: int) -> None:
    """Share a weight between the four corners of two axes."""
    beyond = weight * first
    before = weight - beyond
    corner = beyond * second
    side = before * second
    into[at] += before - side
    into[at + 1] += side
    into[at + 2] += beyond - corner
    into[at + 3] += corner


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

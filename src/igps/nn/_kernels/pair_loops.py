"""Loops over pairs of points that Numba compiles: the counts of `igps.nn._kernels.pairs`, and their gradient.

In a block of pairs, row i is point ``row + i`` and column j is point ``column + j``, with row ≤ column. A pair is
counted if its second point comes after the first, so that each unordered pair counts once.

Along each of K axes, a pair lies between the centres of two bins; these intervals form its cell. The pair is shared
between the 2^K corners of the cell, whose counts are stored side by side and added to their bins only at the end. For
each row, vectorised loops first compute the cells of all pairs and their shares along each axis (`locate_row`). Each
pair is then added to the corners of its cell (`add_axes` and others); for the gradient, it reads the values at the
corners. A weight w with share s is split into w·s and w − w·s, which rounding cannot make negative.

Work arrays are made by the caller, as functions that make arrays take longer to compile.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Floats, Integers
from igps._compiled import FUSE, compiled

Numbers = NDArray[Any]
Indices = NDArray[np.int32]

# Kinds of axes: values given as numbers; distances, from inner products; three cosines at once, from oriented points.
VALUES, DISTANCES, COSINES = 0, 1, 2
_MAX_VECTOR = 32  # upper bound of the number of entries that a compiled loop processes at once


class Members(NamedTuple):
    """The classes of each point."""

    classes: Indices  # (M, P)
    weights: Floats  # (M, P) of the point in them
    differs: Booleans  # (P,) whether its classes or weights differ from those of the point before


class Axes(NamedTuple):
    """K axes: R axes of values or distances, and S triples of cosines."""

    kinds: Integers  # `VALUES`, `DISTANCES`, or `COSINES` (three axes), in the order of the axes
    norms: Numbers  # (R, P) squared lengths of the points; 0 for axes of values
    oriented: Numbers  # (S, 2, D, P) points and directions of length 1, for each triple of cosines
    centres: Numbers  # (K, B) ascending; the number of centres differs between axes
    n_centres: Integers  # (K,) number of centres of each axis
    inverse_gaps: Numbers  # (K, B − 1) 1 / gap between centres; for equal gaps, the first entry is 1 / mean gap
    has_equal_gaps: Booleans  # (K,) whether all gaps are equal


class Row(NamedTuple):
    """Results for the pairs of one row of a block, with an entry for each of J columns."""

    cells: Indices  # (J,) index of the cell of each pair, over all axes
    # (K, J) position of the value between the centres below and above it, from 0 to 1
    shares: Numbers
    features: Numbers  # (S, 5, J) see `cosines`
    interval: Indices  # (J,) scratch space


def new_row(axes: Axes, n_columns: int) -> Row:
    """Return a row for the pairs of n columns."""
    dtype = axes.centres.dtype
    return Row(
        np.empty(n_columns, np.int32),
        np.empty((len(axes.n_centres), n_columns), dtype),
        np.empty((len(axes.oriented), 5, n_columns), dtype),
        np.empty(n_columns, np.int32),
    )


@compiled(inline="always")
def whole_vectors(first: int, n_columns: int) -> int:
    """Return the column to start at, ``first`` or less, so that loops process whole vectors: a remainder is slower."""
    return max(0, n_columns - (n_columns - first + _MAX_VECTOR - 1) // _MAX_VECTOR * _MAX_VECTOR)


@compiled(inline="always")
def locate_row(
    values: Numbers, i: int, axes: Axes, point: int, column: int, start: int, result: Row
) -> None:
    """Fill in the result for row i of a block, the row of a point, from column ``start`` on; see `count_block`."""
    result.cells[start:] = 0
    k = r = s = np.int64(0)  # with a literal 0, `locate` would be compiled a second time
    for kind in axes.kinds:
        if kind == COSINES:
            cosines(
                axes.oriented[s, 0], axes.oriented[s, 1], point, column, start, result.features[s]
            )
            for f in range(3):
                locate(result.features[s, f, start:], axes, k, start, result)
                k += 1
            s += 1
            continue
        value = values[r, i, start:]
        if kind == DISTANCES:
            distances(value, axes.norms[r, point], axes.norms[r, column + start :])
        locate(value, axes, k, start, result)
        k += 1
        r += 1


@compiled()
def distances(products: Numbers, norm: Any, norms: Numbers) -> None:
    """Replace inner products (n,) of a point and other points by distances, from the squared lengths of all."""
    two = products.dtype.type(2)
    zero = products.dtype.type(0)
    for j in range(len(products)):
        products[j] = np.sqrt(max(norm + norms[j] - two * products[j], zero))


@compiled()
def cosines(
    points: Numbers, directions: Numbers, point: int, column: int, start: int, features: Numbers
) -> None:
    """Fill in the features (5, J) of a point and the points of the columns from ``start`` on.

    The features are the larger and the smaller cosine of the directions with the connecting line, the cosine between
    the directions (see `oriented_pairs`), 1 / length of the line, and the cosine of the point's own direction with
    the line. Points and directions are (D, P).
    """
    minus_one = features.dtype.type(-1)
    zero = features.dtype.type(0)
    one = features.dtype.type(1)
    # Slices of single rows: in a slice of the matrix, the compiler would not know that rows are contiguous.
    larger = features[0, start:]
    smaller = features[1, start:]
    between = features[2, start:]
    length = features[3, start:]
    own = features[4, start:]
    n = len(length)
    length[:] = zero
    larger[:] = zero
    smaller[:] = zero
    between[:] = zero
    for d in range(len(points)):
        x = points[d, point]
        u = directions[d, point]
        xs = points[d, column + start :]
        us = directions[d, column + start :]
        # Separate loops, as the compiler does not vectorise loops over many arrays
        for j in range(n):
            line = xs[j] - x
            length[j] += line * line
            larger[j] += u * line
        for j in range(n):
            smaller[j] += us[j] * (x - xs[j])
        for j in range(n):
            between[j] += u * us[j]
    for j in range(n):
        inverse = one / np.sqrt(length[j]) if length[j] > zero else zero
        own[j] = min(max(larger[j] * inverse, minus_one), one)
        length[j] = inverse
    for j in range(n):
        other = min(max(smaller[j] * length[j], minus_one), one)
        larger[j], smaller[j] = max(own[j], other), min(own[j], other)


@compiled()
def locate(values: Numbers, axes: Axes, k: Any, start: int, result: Row) -> None:
    """Find the intervals of values (n,) along axis k, from column ``start`` on, and subdivide the cells by them."""
    centres = axes.centres[k, : axes.n_centres[k]]
    inverse_gaps = axes.inverse_gaps[k]
    cell = result.cells[start:]
    share = result.shares[k, start:]
    interval = result.interval[start:]
    zero = values.dtype.type(0)
    one = values.dtype.type(1)
    end = values.dtype.type(len(centres) - 1)
    width = np.int32(len(centres))
    last = np.int32(len(centres) - 2)
    if axes.has_equal_gaps[k]:
        origin = centres[0]
        scale = inverse_gaps[0]
        for j in range(len(values)):
            position = (values[j] - origin) * scale
            position = position if position > zero else zero
            position = position if position < end else end
            q = min(np.int32(position), last)
            share[j] = position - values.dtype.type(q)
            cell[j] = cell[j] * width + q
        return
    half = 1
    while 2 * half <= last:
        half *= 2
    interval[:] = 0
    while half > 0:  # binary search for all values at once
        step = np.int32(half)
        for j in range(len(values)):
            # Unsigned indices, as for signed ones Numba adds a check for negative indices.
            q = min(np.int32(interval[j] + step), last)
            interval[j] = q if values[j] >= centres[np.uint32(q)] else interval[j]
        half //= 2
    for j in range(len(values)):
        below = np.uint32(interval[j])
        share[j] = min(max((values[j] - centres[below]) * inverse_gaps[below], zero), one)
        cell[j] = cell[j] * width + interval[j]


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
def flush(sums: Floats, start: int, end: int, members: Members, point: int, total: Floats) -> None:
    """Add columns [start, end) of the sums (C, cells·corners) to the total, by a point's weights (M, P); clear them."""
    classes, weights, _ = members
    n_classes = len(sums)
    for other in range(n_classes):
        for m in range(len(classes)):
            pair = pair_row(classes[m, point], other, n_classes)
            for c in range(start, end):
                total[pair, c] += weights[m, point] * sums[other, c]
        for c in range(start, end):
            sums[other, c] = 0


class Sums(NamedTuple):
    """Sums of consecutive rows in the same classes, by the class of the column's point, and work arrays."""

    cells: Floats  # (C·cells, 2^K)
    by_class: Floats  # (C, cells·2^K) the same memory
    home: Indices  # (M, J) first cell of the class of each column's point
    part: Floats  # (J,)


def new_sums(members: Members, column: int, n_columns: int, shape: tuple[int, int, int]) -> Sums:
    """Return empty sums for n columns of a block, of a shape (C, cells, 2^K)."""
    n_classes, n_cells, n_corners = shape
    cells = np.zeros((n_classes * n_cells, n_corners))
    return Sums(
        cells,
        cells.reshape(n_classes, -1),
        (members.classes[:, column : column + n_columns] * n_cells).astype(np.int32),
        np.empty(n_columns),
    )


@compiled()
def count_block(
    values: Numbers,
    axes: Axes,
    place: tuple[int, int],
    members: Members,
    total: Floats,
    sums: Sums,
    result: Row,
) -> None:
    """Count a block of pairs.

    Args:
        values: (R, I, J) of the axes other than cosines, in order; inner products for distances. Overwritten.
        axes: see `Axes`.
        place: first point of the rows and of the columns.
        members: see `Members`.
        total: (C(C+1)/2, cells·2^K) to add to; among the corners, the last axis varies fastest.
        sums, result: of `new_sums` and `new_row`.
    """
    row, column = place
    classes, weights, differs = members
    n_columns = values.shape[2]
    n_axes = len(axes.n_centres)
    n_members = len(classes)
    n_corners = 1 << n_axes
    n_cells = total.shape[1] // n_corners
    home = sums.home
    # Range of cells with counts. With one class for each point, it is all cells: many rows are then flushed together,
    # and adding empty cells takes less time than tracking the range.
    empty_range = (n_cells, -1) if n_members > 1 else (0, n_cells - 1)
    lowest, highest = empty_range
    for i in range(values.shape[1]):
        point = row + i
        first = max(point + 1 - column, 0)
        start = whole_vectors(first, n_columns)
        if i > 0 and differs[point]:
            begin = lowest * n_corners
            flush(sums.by_class, begin, (highest + 1) * n_corners, members, point - 1, total)
            lowest, highest = empty_range
        locate_row(values, i, axes, point, column, start, result)
        cell = result.cells[first:]
        shares = result.shares
        if n_members > 1:
            for j in range(len(cell)):
                if cell[j] < lowest:
                    lowest = cell[j]
                if cell[j] > highest:
                    highest = cell[j]
        for m in range(n_members):
            home_m = home[m, first:]
            weight = weights[m, column + first :]
            if n_axes == 1:
                add_one_axis(cell, home_m, shares[0, first:], weight, sums.cells)
            elif n_axes == 4:
                add_four_axes(cell, home_m, shares, first, weight, sums.cells)
            else:
                add_axes(cell, home_m, shares, first, weight, sums.part[first:], sums.cells)
    last = row + values.shape[1] - 1
    flush(sums.by_class, lowest * n_corners, (highest + 1) * n_corners, members, last, total)


class Derivatives(NamedTuple):
    """What `gradient_block` fills or adds to."""

    # (S, 4, I, J) for each triple of cosines, by u·(y − x), v·(x − y), u·v and |y − x|², where x and u are the point
    # and direction of the row, y and v those of the column
    by_cosines: Numbers
    by_weights: Floats  # (M, P) to add to
    by_centres: Floats  # (K, B) to add to
    slopes: Floats  # (K,) scratch space


@compiled()
def gradient_block(
    values: Numbers,
    axes: Axes,
    place: tuple[int, int],
    members: Members,
    upstream: Numbers,
    derivatives: Derivatives,
    result: Row,
) -> None:
    """Compute the gradient of `count_block`, which has the same first arguments.

    Args:
        values: overwritten with derivatives by the values, or by squared distances; 0 where no pair is counted.
        upstream: (C(C+1)/2, cells·2^K) derivatives by the counts.
        derivatives: filled or added to.
        result: of `new_row`.
    """
    row, column = place
    classes, weights, _ = members
    by_cosines, by_weights, by_centres, slopes = derivatives
    n_rows, n_columns = values.shape[1:]
    n_axes = len(axes.n_centres)
    n_members = len(classes)
    n_corners = 1 << n_axes
    n_classes = int(np.sqrt(2.0 * len(upstream)))
    cells = result.cells
    shares = result.shares
    features = result.features
    zero = values.dtype.type(0)
    for i in range(n_rows):
        point = row + i
        first = max(point + 1 - column, 0)
        start = whole_vectors(first, n_columns)
        locate_row(values, i, axes, point, column, start, result)
        values[:, i, : min(first, n_columns)] = zero
        by_cosines[:, :, i, : min(first, n_columns)] = zero
        if axes.kinds[0] == DISTANCES and n_axes == 1:
            distance_gradient(
                (values[0, i], cells, shares[0]),
                (first, point, column),
                axes,
                members,
                upstream,
                by_weights,
                by_centres[0],
            )
            continue
        for j in range(first, n_columns):
            other = column + j
            slopes[:] = 0
            corner = np.uint32(cells[j] * n_corners)
            for m in range(n_members):
                row_weight = weights[m, point]
                for n in range(n_members):
                    column_weight = weights[n, other]
                    if row_weight == 0 and column_weight == 0:
                        continue
                    pair = np.uint32(pair_row(classes[m, point], classes[n, other], n_classes))
                    mean = interpolate(
                        upstream[pair], corner, shares, j, row_weight * column_weight, slopes
                    )
                    by_weights[m, point] += column_weight * mean
                    by_weights[n, other] += row_weight * mean
            cell: Any = cells[j]
            for k in range(n_axes - 1, -1, -1):
                share = np.float64(shares[k, j])
                width = np.uint32(axes.n_centres[k])
                q = np.uint32(cell % width)
                cell = np.uint32(cell // width)
                # On a centre, the slope of the interval above is taken
                is_inside = share < 1 and (share > 0 or q > 0)
                gap = np.uint32(0) if axes.has_equal_gaps[k] else q
                slope = slopes[k] * axes.inverse_gaps[k, gap] if is_inside else 0.0
                by_centres[k, q] -= slope * (1 - share)
                by_centres[k, q + np.uint32(1)] -= slope * share
                slopes[k] = slope
            k = r = s = 0
            for kind in axes.kinds:
                if kind == COSINES:
                    own_cosine = features[s, 4, j]
                    inverse = features[s, 3, j]
                    by_row = slopes[k] * inverse
                    by_column = slopes[k + 1] * inverse
                    by_square = slopes[k] * features[s, 0, j] + slopes[k + 1] * features[s, 1, j]
                    if own_cosine != features[s, 0, j]:  # the larger cosine is that of the column
                        by_row, by_column = by_column, by_row
                    by_cosines[s, 0, i, j] = by_row
                    by_cosines[s, 1, i, j] = by_column
                    by_cosines[s, 2, i, j] = slopes[k + 2]
                    by_cosines[s, 3, i, j] = -by_square * inverse * inverse / 2
                    k += 3
                    s += 1
                    continue
                if kind == DISTANCES:  # the derivative for coinciding points is set to 0
                    values[r, i, j] = (
                        slopes[k] / (2 * values[r, i, j]) if values[r, i, j] > 0 else 0.0
                    )
                else:
                    values[r, i, j] = slopes[k]
                k += 1
                r += 1


@compiled(fastmath=FUSE)
def distance_gradient(
    row: tuple[Numbers, Indices, Numbers],
    place: tuple[int, int, int],
    axes: Axes,
    members: Members,
    upstream: Numbers,
    by_weights: Floats,
    by_centres: Floats,
) -> None:
    """`gradient_block` for one row of distances and no other axis.

    Args:
        row: the distances (J,) to overwrite with the derivatives by their squares; their cells and shares.
        place: the first column, the number of the row's point, and that of the first column's point.
    """
    values, cells, shares = row
    first, point, column = place
    classes, weights, _ = members
    n_members = len(classes)
    n_classes = int(np.sqrt(2.0 * len(upstream)))
    for j in range(first, len(cells)):
        other = column + j
        cell = np.uint32(2 * cells[j])
        share = np.float64(shares[j])
        slope = 0.0
        for n in range(n_members):
            column_weight = weights[n, other]
            for m in range(n_members):
                row_weight = weights[m, point]
                if row_weight == 0 and column_weight == 0:
                    continue
                pair = np.uint32(pair_row(classes[m, point], classes[n, other], n_classes))
                low = np.float64(upstream[pair, cell])
                rise = np.float64(upstream[pair, cell + np.uint32(1)]) - low
                mean = low + share * rise
                slope += row_weight * column_weight * rise
                by_weights[m, point] += column_weight * mean
                by_weights[n, other] += row_weight * mean
        q = np.uint32(cells[j])
        is_inside = share < 1 and (share > 0 or q > 0)
        gap = np.uint32(0) if axes.has_equal_gaps[0] else q
        slope = slope * axes.inverse_gaps[0, gap] if is_inside else 0.0
        by_centres[q] -= slope * (1 - share)
        by_centres[q + np.uint32(1)] -= slope * share
        values[j] = slope / (2 * values[j]) if values[j] > 0 else 0.0


@compiled(inline="always")
def interpolate(
    upstream: Numbers, start: Any, shares: Numbers, j: int, weight: float, slopes: Floats
) -> float:
    """Return the mean of upstream derivatives (cells·2^K,) at the corners of the cell of pair j, by its shares (K, J).

    The corners begin at index ``start``. The derivatives of the mean by the shares, times the weight, are added to the
    slopes (K,). The loop is over the corners of the outer axes; the four corners along the last two axes are read
    together and stay in registers.
    """
    n_outer = len(shares) - 2
    if n_outer < 0:
        low = np.float64(upstream[start])
        high = np.float64(upstream[start + np.uint32(1)])
        slopes[0] += weight * (high - low)
        return low + shares[0, j] * (high - low)
    mean = 0.0
    one = np.float64(shares[n_outer, j])
    two = np.float64(shares[n_outer + 1, j])
    for corner in range(1 << n_outer):
        i = start + np.uint32(4 * corner)
        p = np.float64(upstream[i])
        q = np.float64(upstream[i + np.uint32(1)])
        r = np.float64(upstream[i + np.uint32(2)])
        s = np.float64(upstream[i + np.uint32(3)])
        below = p + two * (q - p)
        above = r + two * (s - r)
        inner_mean = below + one * (above - below)
        outer_share = 1.0
        for k in range(n_outer):
            other_shares = 1.0
            for other in range(n_outer):
                if other != k:
                    other_shares *= corner_share(
                        shares[other, j], corner >> (n_outer - 1 - other) & 1
                    )
            slopes[k] += (
                weight
                * other_shares
                * (inner_mean if corner >> (n_outer - 1 - k) & 1 else -inner_mean)
            )
            outer_share *= corner_share(shares[k, j], corner >> (n_outer - 1 - k) & 1)
        slopes[n_outer] += weight * outer_share * (above - below)
        slopes[n_outer + 1] += weight * outer_share * (q - p + one * (s - r - q + p))
        mean += outer_share * inner_mean
    return mean


@compiled(inline="always")
def corner_share(share: Any, is_upper: int) -> float:
    """Return the share of a pair that counts at an upper or lower corner along an axis."""
    return np.float64(share) if is_upper else 1.0 - np.float64(share)

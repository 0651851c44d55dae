"""Loops over pairs of points that Numba compiles: the counts of `igps.nn._kernels.pairs`, and their gradient.

In a block of pairs, row i is point ``row + i`` and column j is point ``column + j``, with row ≤ column. A pair is
counted if its second point comes after the first, so that each unordered pair counts once.

Along each of K axes, a pair lies between the centres of two bins; these intervals form its cell. The pair is shared
between the 2^K corners of the cell, whose counts are stored side by side and added to their bins only at the end. For
each row, vectorised loops first compute the cells of all pairs and their shares along each axis (`pair_cells`). Each
pair is then added to the corners of its cell (`pair_sums`); for the gradient, it reads the values at the corners.
"""

from typing import Any

import numpy as np

from igps._arrays import Floats
from igps._compiled import ALLOCATES, FUSE, compiled
from igps.nn._kernels.pair_cells import (
    COSINES,
    DISTANCES,
    Axes,
    Indices,
    Numbers,
    locate_row,
    new_row,
    whole_vectors,
)
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
)


@compiled(**ALLOCATES)
def count_block(
    values: Numbers,
    axes: Axes,
    row: int,
    column: int,
    classes: Indices,
    weights: Floats,
    packs: bool,
    total: Floats,
) -> None:
    """Count a block of pairs.

    Args:
        values: (R, I, J) of the axes other than cosines, in order; inner products for distances. Overwritten.
        axes: see `Axes`.
        row, column: first point of the rows and of the columns.
        classes, weights: (M, P) classes of each point, and its weights in them.
        packs: whether there is one axis, in single precision, and M and all weights are 1.
        total: (C(C+1)/2, cells·2^K) to add to; among the corners, the last axis varies fastest.
    """
    n_rows, n_columns = values.shape[1:]
    n_axes = len(axes.n_centres)
    n_members = len(classes)
    n_corners = 1 << n_axes
    n_cells = total.shape[1] // n_corners
    n_classes = int(np.sqrt(2.0 * len(total)))
    # Sums of consecutive rows in the same classes, by the class of the column's point; its cells start at `home`.
    sums = np.zeros((n_classes * n_cells, n_corners))
    by_class = sums.reshape((n_classes, n_cells * n_corners))
    home = (classes[:, column : column + n_columns] * n_cells).astype(np.int32)
    result = new_row(axes, n_columns, values)
    part = np.empty(n_columns)
    packed = np.zeros((n_classes * n_cells if packs else 0) * LANES, np.int64)
    # Range of cells with counts. With one class for each point, it is all cells: many rows are then flushed together,
    # and adding empty cells takes less time than tracking the range.
    empty_range = (n_cells, -1) if n_members > 1 else (0, n_cells - 1)
    lowest, highest = empty_range
    for i in range(n_rows):
        point = row + i
        first = max(point + 1 - column, 0)
        start = whole_vectors(first, n_columns)
        if i > 0:
            is_same = True
            for m in range(n_members):
                is_same &= (
                    classes[m, point] == classes[m, point - 1]
                    and weights[m, point] == weights[m, point - 1]
                )
            if not is_same:
                unpack(packed, sums)
                flush(
                    by_class,
                    lowest * n_corners,
                    (highest + 1) * n_corners,
                    classes,
                    weights,
                    point - 1,
                    total,
                )
                lowest, highest = empty_range
        locate_row(values, i, axes, point, column, start, result)
        cell = result.cells[first:]
        shares = result.shares
        if n_members > 1:
            for j in range(len(cell)):
                lowest = min(lowest, cell[j])
                highest = max(highest, cell[j])
        for m in range(n_members):
            home_m = home[m, first:]
            weight = weights[m, column + first :]
            if packs:
                pack_pairs(
                    result.cells[start:],
                    home[0, start:],
                    shares[0, start:],
                    result.interval[start:],
                )
                add_whole_pairs(cell, result.interval[first:], packed)
            elif n_axes == 1:
                add_one_axis(cell, home_m, shares[0, first:], weight, sums)
            elif n_axes == 4:
                add_four_axes(cell, home_m, shares, first, weight, sums)
            else:
                add_axes(cell, home_m, shares, first, weight, part[first:], sums)
    unpack(packed, sums)
    flush(
        by_class,
        lowest * n_corners,
        (highest + 1) * n_corners,
        classes,
        weights,
        row + n_rows - 1,
        total,
    )


@compiled(**ALLOCATES)
def gradient_block(  # noqa: PLR0913 (the arguments of count_block, and the arrays to fill)
    values: Numbers,
    axes: Axes,
    row: int,
    column: int,
    classes: Indices,
    weights: Floats,
    upstream: Numbers,
    by_cosines: Numbers,
    by_weights: Floats,
    by_centres: Floats,
) -> None:
    """Compute the gradient of `count_block`, which has the same first arguments.

    Args:
        values: overwritten with derivatives by the values, or by squared distances; 0 where no pair is counted.
        upstream: (C(C+1)/2, cells·2^K) derivatives by the counts.
        by_cosines: (S, 4, I, J) to fill, for each triple of cosines, with the derivatives by u·(y − x), v·(x − y), u·v
            and |y − x|², where x and u are the point and direction of the row, y and v those of the column.
        by_weights, by_centres: (M, P) and (K, B) to add to.
    """
    n_rows, n_columns = values.shape[1:]
    n_axes = len(axes.n_centres)
    n_members = len(classes)
    n_corners = 1 << n_axes
    n_classes = int(np.sqrt(2.0 * len(upstream)))
    result = new_row(axes, n_columns, values)
    cells = result.cells
    shares = result.shares
    features = result.features
    slopes = np.empty(n_axes)
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
                classes,
                weights,
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
    classes: Indices,
    weights: Floats,
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

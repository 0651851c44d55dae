"""Compiled loops that compute the cells of a row of pairs, and the shares of the pairs along each axis."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Integers
from igps._compiled import ALLOCATES, compiled

Numbers = NDArray[Any]
Indices = NDArray[np.int32]

# Kinds of axes: values given as numbers; distances, from inner products; three cosines at once, from oriented points.
VALUES, DISTANCES, COSINES = 0, 1, 2
_MAX_VECTOR = 32  # upper bound of the number of entries that a compiled loop processes at once


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
    shares: (
        Numbers  # (K, J) position of the value between the centres below and above it, from 0 to 1
    )
    features: Numbers  # (S, 5, J) see `cosines`
    interval: Indices  # (J,) scratch space


@compiled(**ALLOCATES)
def new_row(axes: Axes, n_columns: int, values: Numbers) -> Row:
    """Allocate a row, in the type of the values."""
    return Row(
        np.empty(n_columns, np.int32),
        np.empty((len(axes.n_centres), n_columns), values.dtype),
        np.empty((len(axes.oriented), 5, n_columns), values.dtype),
        np.empty(n_columns, np.int32),
    )


@compiled()
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
    the directions (see `point_pair_features`), 1 / length of the line, and the cosine of the point's own direction with
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
        for j in range(
            n
        ):  # separate loops, as the compiler does not vectorise loops over many arrays
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

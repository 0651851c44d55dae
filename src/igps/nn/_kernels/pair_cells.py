"""Compiled loops that find, of a row of pairs, the cells that they fall into and their shares along each axis."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Integers
from igps._compiled import compiled

Numbers = NDArray[Any]
Places = NDArray[np.int32]

# How the loops get the values of axes: as they are; distances from inner products; three cosines at once from points.
VALUES, DISTANCES, COSINES = 0, 1, 2
# Numbers that a compiled loop takes at once, at most.
_VECTOR = 32


class Axes(NamedTuple):
    """K axes, of which R have values and 3 S are cosines."""

    kinds: Integers  # in order, `VALUES`, `DISTANCES`, or `COSINES`, which are three axes
    norms: Numbers  # (R, P) squared lengths of the points of axes of distances
    oriented: Numbers  # (S, 2, D, P) for each three axes of cosines the points, and their directions of length 1
    centres: Numbers  # (K, B) ascending, of each axis its own number of them
    n_centres: Integers  # (K,) how many these are
    inverse: Numbers  # (K, B − 1) one over the gaps between centres; where they are equal, the first is over the mean
    equal: Booleans  # (K,) whether these gaps are equal


class Row(NamedTuple):
    """What is found of the pairs of a row, a number for each of J columns."""

    cells: Places  # (J,) below their values
    shares: Numbers  # (K, J) how far each value is on the way from the centre below to that above
    features: Numbers  # (S, 5, J) see `cosines`
    interval: Places  # (J,) room


@compiled()
def new_row(axes: Axes, n_columns: int, values: Numbers) -> Row:
    """Room for a row, in the type of the values."""
    return Row(
        np.empty(n_columns, np.int32),
        np.empty((len(axes.n_centres), n_columns), values.dtype),
        np.empty((len(axes.oriented), 5, n_columns), values.dtype),
        np.empty(n_columns, np.int32),
    )


@compiled()
def whole_vectors(first: int, n_columns: int) -> int:
    """The column from which to work, so that it is by whole vectors: what is left over takes longer than one."""
    return max(0, n_columns - (n_columns - first + _VECTOR - 1) // _VECTOR * _VECTOR)


@compiled(inline="always")
def locate_row(values: Numbers, i: int, axes: Axes, point: int, column: int, start: int, found: Row) -> None:
    """Fill in what is found of row i, that of a point, from the column ``start`` on; else see `count_block`."""
    found.cells[start:] = 0
    k = r = s = np.int64(0)  # a plain 0 would make a function of its own of `locate`
    for kind in axes.kinds:
        if kind == COSINES:
            cosines(axes.oriented[s, 0], axes.oriented[s, 1], point, column, start, found.features[s])
            for f in range(3):
                locate(found.features[s, f, start:], axes, k, start, found)
                k += 1
            s += 1
            continue
        value = values[r, i, start:]
        if kind == DISTANCES:
            distances(value, axes.norms[r, point], axes.norms[r, column + start :])
        locate(value, axes, k, start, found)
        k += 1
        r += 1


@compiled()
def distances(products: Numbers, norm: Any, norms: Numbers) -> None:
    """Turn inner products (n,) of a point with others into distances; from the squared lengths of it and of them."""
    two, none = products.dtype.type(2), products.dtype.type(0)
    for j in range(len(products)):
        products[j] = np.sqrt(max(norm + norms[j] - two * products[j], none))


@compiled()
def cosines(points: Numbers, directions: Numbers, point: int, column: int, start: int, features: Numbers) -> None:
    """Fill the features (5, J) of a point with those of the columns from a start on.

    These are the larger and the smaller cosine to the line, that between the directions, one over the length of the
    line, and the first point's own cosine to it, see `point_pair_features`; of points (D, P) and directions (D, P).
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
    for d in range(len(points)):
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


@compiled()
def locate(values: Numbers, axes: Axes, k: Any, start: int, found: Row) -> None:
    """Sort values (n,) from a start on into the intervals between the centres of axis k, and refine the cells."""
    centres, inverse = axes.centres[k, : axes.n_centres[k]], axes.inverse[k]
    cell, share, interval = found.cells[start:], found.shares[k, start:], found.interval[start:]
    none, one, end = values.dtype.type(0), values.dtype.type(1), values.dtype.type(len(centres) - 1)
    width, last = np.int32(len(centres)), np.int32(len(centres) - 2)
    if axes.equal[k]:
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

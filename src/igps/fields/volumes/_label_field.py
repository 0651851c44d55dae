"""Compute a smooth function on a grid of voxels that is negative at the voxels of a body.

A voxel belongs to the body if the body covers its centre or, for shares, at least half of it. Among all functions with
the right sign at every voxel, the one with small second derivatives is computed. It has no stairs, because its zero
level is free between the last voxel inside and the first outside. It loses nothing thin, because no voxel changes
sides. (Whitaker 2000 and Gibson 1998 use the same constraint; Lempitsky 2010 replaces area by second derivatives, which
do not shrink the surface.) Where the solution bends more than its surroundings, at edges, the function is solved again
with less weight on bending (creases: Blake and Zisserman 1987).
The zero level is later shifted as a whole to match the volume of the voxels: local shifts would restore the stairs.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles
from igps._compiled import REASSOCIATE, compiled

# Minimal absolute value of the function at voxels wholly inside or outside, in shortest sides (0.5 is the largest that
# all bodies allow), and weight of the second derivatives; each in smooth places and at edges. The values for smooth
# places keep round bodies smooth, those for edges let faces run on to their edges.
_MIN_ABS_VALUES = (0.05, 0.3)
_STIFFNESS = (1.0, 0.1)
# Excess of the first solution's Laplacian over its surroundings: up to the first value a place is smooth, from the
# second on it is an edge. An edge bends more than the faces beside it; a thin round body bends everywhere.
_BEND_LIMITS = (0.05, 0.2)
# Standard deviations of the means of the Laplacian and of its surroundings, voxels
_WINDOW, _WIDE_WINDOW = (
    0.7,
    3.0,
)
# Weight of the deviation from a signed distance to the voxels of the other side; the second derivatives have weight 1.
_DISTANCE_WEIGHT = 0.01
_RELAXATION = 1.4
_N_SWEEPS = 20  # of either solution; with 15 and 10, a ball keeps bumps that affect descriptors
_BAND = 2  # voxels from the border within which the function is free

PAD = _BAND + 2
"""Empty voxels that the grid must have on every side."""

# Larger grids, such as those of thin vessels, are solved in blocks of this side, each with an overlap, in voxels.
_MAX_VOXELS_AT_ONCE = 1 << 22
_BLOCK = 48
_OVERLAP = 12


def smooth_field(share: Singles, sides: Floats) -> Floats | Singles:
    """Return the function at the centres of the voxels, near the surface about the signed distance, in shortest sides.

    The shares (X, Y, Z) of the voxels that lie in the body, 0 to 1, have `PAD` empty layers around. For a mask they are
    0 or 1, depending on the centre of the voxel. The sides (3,) of a voxel are in units of the shortest side.
    """
    if share.size <= _MAX_VOXELS_AT_ONCE:
        return _solve(share, sides)
    far = (PAD - 0.5) * float(sides.max())
    margin = np.ceil(PAD * sides.max() / sides).astype(np.int64)
    overlap = np.maximum(margin, _OVERLAP)
    field = np.full(share.shape, far, dtype=np.float32)
    for corner in np.ndindex(*(math.ceil(n / _BLOCK) for n in share.shape)):
        low = _BLOCK * np.array(corner)
        high = np.minimum(low + _BLOCK, share.shape)
        start = np.maximum(low - overlap, 0)
        inside = share[tuple(map(slice, start, high + overlap))] >= 0.5
        if not inside.any():
            continue
        if inside.all():
            field[tuple(map(slice, low, high))] = -far
            continue
        (box,) = ndimage.find_objects(inside.view(np.uint8))
        first, last = (start + [getattr(side, end) for side in box] for end in ("start", "stop"))
        box_low = np.maximum(first - margin, start)
        box_high = np.minimum(last + margin, start + inside.shape)
        padding = list(zip(margin - (first - box_low), margin - (box_high - last), strict=True))
        solution = _solve(np.pad(share[tuple(map(slice, box_low, box_high))], padding), sides)
        origin = first - margin  # of the solution, in the grid
        a = np.maximum(low, box_low)
        b = np.minimum(high, box_high)
        if (a < b).all():
            block = solution[tuple(map(slice, a - origin, b - origin))]
            field[tuple(map(slice, a, b))] = np.clip(block, -far, far)
    return field


def _solve(share: Singles, sides: Floats) -> Floats:
    """Solve for the function on a whole grid at once."""
    inside = share >= 0.5
    distance = ndimage.distance_transform_edt(inside, sampling=sides)
    distance += ndimage.distance_transform_edt(~inside, sampling=sides)
    field = np.where(inside, -1.0, 1.0) * (distance - 0.5)
    border = ndimage.maximum_filter(inside, 2 * _BAND + 1) & ~ndimage.minimum_filter(
        inside, 2 * _BAND + 1
    )
    nodes = np.flatnonzero(border)
    target = field.reshape(-1)[nodes]
    stencil = np.array([-1.0, 2, -1])
    laplacian = np.zeros_like(field)
    for axis, side in enumerate(sides):
        laplacian += ndimage.correlate1d(field, stencil / side**2, axis)
    steps = np.array(field.strides) // field.itemsize
    curvatures = sides**-2
    weighted = _Stencil(
        np.concatenate([[0], steps, -steps]),
        np.concatenate([[2 * curvatures.sum()], -curvatures, -curvatures]),
    )
    certainty = np.abs(2 * share - 1).reshape(-1)[nodes]

    def relax(sharpness: Floats) -> None:
        min_abs = certainty * np.interp(sharpness.reshape(-1)[nodes], (0, 1), _MIN_ABS_VALUES)
        stiffness = np.interp(sharpness, (0, 1), _STIFFNESS).reshape(-1)
        bounded = _Nodes(nodes, target, inside.reshape(-1)[nodes], min_abs)
        _relax(field.reshape(-1), laplacian.reshape(-1), weighted, stiffness, bounded)

    relax(np.zeros_like(field))
    # Edges are blunter across long voxels.
    bend = np.abs(ndimage.gaussian_filter(laplacian, _WINDOW, truncate=3)) * np.sqrt(sides.max())
    around, weight = (
        ndimage.gaussian_filter(values, _WIDE_WINDOW, truncate=3)
        for values in (bend * border, border.astype(float))
    )
    relax(np.interp(bend - around / np.maximum(weight, 1e-3), _BEND_LIMITS, (0, 1)))
    return field


def filled_volume(field: Floats | Singles, reach: float) -> tuple[float, float]:
    """Return the volume in voxels where the field is negative, and its derivative with respect to the level.

    Voxels with values beyond `reach` lie wholly on one side.
    """
    near = np.nonzero(np.abs(field[1:-1, 1:-1, 1:-1]) < reach)
    at = np.ravel_multi_index(tuple(index + 1 for index in near), field.shape)
    values = field.reshape(-1)
    width = np.full(len(at), 1e-3)
    for step in np.cumprod(
        [1, *field.shape[:0:-1]]
    ).tolist():  # not its strides: splines permute the axes in memory
        width += np.abs(values[at + step] - values[at - step]) / 2
    share = 0.5 - values[at] / width
    n_full = np.count_nonzero(field < 0) - np.count_nonzero(values[at] < 0)
    is_cut = (share > 0) & (share < 1)
    return float(np.clip(share, 0, 1).sum()) + n_full, float((1 / width[is_cut]).sum())


class _Stencil(NamedTuple):
    """The negative Laplacian of a grid: offsets in the flat array, and the coefficient of each."""

    steps: Integers
    weights: Floats


class _Nodes(NamedTuple):
    """The grid points that are changed: where they are, their wanted values, sides, and smallest absolute values."""

    at: Integers
    target: Floats
    inside: Booleans
    min_abs: Floats


@compiled(fastmath=REASSOCIATE)
def _relax(
    field: Floats,
    laplacian: Floats,
    stencil: _Stencil,
    stiffness: Floats,
    nodes: _Nodes,
) -> None:
    """Minimise the weighted squares of the Laplacian in place, by projected Gauss-Seidel sweeps.

    Sweeps run forwards and backwards in turn. The array `laplacian` holds the negative Laplacian, and is updated with
    the field.
    """
    steps = stencil.steps
    weights = stencil.weights
    min_abs = nodes.min_abs
    n = len(nodes.at)
    for sweep in range(_N_SWEEPS):
        for count in range(n):
            at = count if sweep % 2 == 0 else n - 1 - count
            node = nodes.at[at]
            total = _DISTANCE_WEIGHT * (nodes.target[at] - field[node])
            centre = _DISTANCE_WEIGHT
            for k in range(len(steps)):
                weight = weights[k] * stiffness[node + steps[k]]
                total -= weight * laplacian[node + steps[k]]
                centre += weight * weights[k]
            value = field[node] + _RELAXATION * total / centre
            value = min(value, -min_abs[at]) if nodes.inside[at] else max(value, min_abs[at])
            change = value - field[node]
            field[node] = value
            for k in range(len(steps)):
                laplacian[node + steps[k]] += weights[k] * change

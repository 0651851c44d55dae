"""Compute a smooth function on a grid of voxels that is negative at the voxels of a body.

A voxel belongs to the body if the body covers its centre or, for shares, at least half of it. Among all functions with
the right sign at every voxel, the one with small second derivatives is computed. It has no stairs, because its zero
level is free between the last voxel inside and the first outside. It loses nothing thin, because no voxel changes
sides. (Whitaker 2000 and Gibson 1998 use the same constraint; Lempitsky 2010 replaces area by second derivatives, which
do not shrink the surface.) Where the solution bends more than its surroundings, at edges, the function is solved again
with less weight on bending (creases: Blake and Zisserman 1987).
The zero level is later shifted as a whole to match the volume of the voxels: local shifts would restore the stairs.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles
from igps._compiled import REASSOCIATE, compiled
from igps.fields.volumes._boxes import block_corners, bounds_of, box_of

# Minimal absolute value of the function at voxels wholly inside or outside, in shortest sides (0.5 is the largest that
# all bodies allow), and weight of the second derivatives; each in smooth places and at edges. The values for smooth
# places keep round bodies smooth, those for edges let faces run on to their edges.
_MIN_ABS_VALUES = (0.05, 0.3)
_STIFFNESS = (1.0, 0.1)
# Excess of the first solution's Laplacian over its surroundings: up to the first value a place is smooth, from the
# second on it is an edge. An edge bends more than the faces beside it; a thin round body bends everywhere.
_BEND_LIMITS = (0.05, 0.2)
# Standard deviations of the means of the Laplacian and of its surroundings, voxels
_WINDOW = 0.7
_WIDE_WINDOW = 3.0
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
    for low in block_corners(share.shape, _BLOCK):
        high = np.minimum(low + _BLOCK, share.shape)
        start = np.maximum(low - overlap, 0)
        inside = share[box_of(start, high + overlap)] >= 0.5
        if not inside.any():
            continue
        if inside.all():
            field[box_of(low, high)] = -far
            continue
        # The body in the block and its overlap, with a margin: of the share, or else of zeros.
        first, last = bounds_of(inside)
        origin = start + first - margin
        end = start + last + margin
        read_from = np.maximum(origin, start)
        read_to = np.minimum(end, start + inside.shape)
        padding = np.stack([read_from - origin, end - read_to], axis=1)
        solution = _solve(np.pad(share[box_of(read_from, read_to)], padding), sides)
        kept_from = np.maximum(low, read_from)
        kept_to = np.minimum(high, read_to)
        if (kept_from < kept_to).all():
            kept = solution[box_of(kept_from - origin, kept_to - origin)]
            field[box_of(kept_from, kept_to)] = np.clip(kept, -far, far)
    return field


def _solve(share: Singles, sides: Floats) -> Floats:
    """Solve for the function on a whole grid at once."""
    inside = share >= 0.5
    distance = ndimage.distance_transform_edt(inside, sampling=sides)
    distance += ndimage.distance_transform_edt(~inside, sampling=sides)
    field = np.where(inside, -1.0, 1.0) * (distance - 0.5)
    laplacian = np.zeros_like(field)
    stencil = np.array([-1.0, 2, -1])
    for axis, side in enumerate(sides):
        laplacian += ndimage.correlate1d(field, stencil / side**2, axis)
    steps = np.array(field.strides) // field.itemsize
    curvatures = sides**-2
    weighted = _Stencil(
        np.concatenate([[0], steps, -steps]),
        np.concatenate([[2 * curvatures.sum()], -curvatures, -curvatures]),
    )
    width = 2 * _BAND + 1
    near_body = ndimage.maximum_filter(inside, width)
    deep_inside = ndimage.minimum_filter(inside, width)
    border = near_body & ~deep_inside
    nodes = np.flatnonzero(border)
    target = field.ravel()[nodes]
    certainty = np.abs(2 * share - 1).ravel()[nodes]

    def relax(sharpness: Floats) -> None:
        min_abs = np.interp(sharpness.ravel()[nodes], (0, 1), _MIN_ABS_VALUES)
        stiffness = np.interp(sharpness, (0, 1), _STIFFNESS).ravel()
        bounded = _Nodes(nodes, target, inside.ravel()[nodes], certainty * min_abs)
        _relax(field.reshape(-1), laplacian.reshape(-1), weighted, stiffness, bounded)

    relax(np.zeros_like(field))
    bend = np.abs(ndimage.gaussian_filter(laplacian, _WINDOW, truncate=3))
    bend *= np.sqrt(sides.max())  # edges are blunter across long voxels
    total = ndimage.gaussian_filter(bend * border, _WIDE_WINDOW, truncate=3)
    weight = ndimage.gaussian_filter(border.astype(float), _WIDE_WINDOW, truncate=3)
    excess = bend - total / np.maximum(weight, 1e-3)
    relax(np.interp(excess, _BEND_LIMITS, (0, 1)))
    return field


def filled_volume(field: Floats | Singles, reach: float) -> tuple[float, float]:
    """Return the volume in voxels where the field is negative, and its derivative with respect to the level.

    Voxels with values beyond `reach` lie wholly on one side.
    """
    is_near = np.zeros(field.shape, dtype=bool)
    is_near[1:-1, 1:-1, 1:-1] = np.abs(field[1:-1, 1:-1, 1:-1]) < reach
    at = np.flatnonzero(is_near)
    flat = field.reshape(-1)
    values = flat[at]
    width = np.full(len(at), 1e-3)
    _, n_rows, n_columns = field.shape
    for step in (1, n_columns, n_columns * n_rows):  # to the next voxel along each axis
        width += np.abs(flat[at + step] - flat[at - step]) / 2
    share = 0.5 - values / width
    n_full = np.count_nonzero(field < 0) - np.count_nonzero(values < 0)
    is_cut = (share > 0) & (share < 1)
    volume = float(np.clip(share, 0, 1).sum()) + n_full
    return volume, float((1 / width[is_cut]).sum())


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

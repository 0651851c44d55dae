"""A smooth function on a grid of voxels that is negative where most of a voxel lies in the body.

Voxels tell where a body is by their centres, or by the share of each that it fills. Of all functions whose signs agree
with that, one is taken that bends little: no stairs are left, since the zero level is free between the last voxels
inside and the first outside; and nothing thin is lost, since no voxel changes sides. (Whitaker 2000 and Gibson 1998
hold surfaces by the same constraint; Lempitsky 2010 takes second derivatives, which shrink nothing, in place of area.)
Where it bends more than around, at edges, it is solved again with less weight on bending (creases: Blake and
Zisserman 1987).
The level is moved as a whole to give the voxels' volume: if it were moved nearby, that would write their stairs back.
"""

import math

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles
from igps._compiled import SUMS, compiled

# Least absolute value of a voxel that is wholly inside or outside, in shortest sides (half would be the most that all
# bodies allow), and weight of second derivatives: of smooth places and of edges. Those of smooth places leave round
# bodies smooth, those of edges let faces run on to them.
_MARGINS, _STIFFNESS = (0.05, 0.3), (1.0, 0.1)
# How much more than around it the Laplacian of a first solution is in smooth places, at most, and at edges, at least.
# An edge bends more than the faces beside it; a thin round body bends everywhere.
_BENDS = (0.05, 0.2)
# Standard deviations of the windows of the Laplacian and of what is around, in voxels.
_WINDOW, _WIDE_WINDOW = 0.7, 3.0
# Weight of the distance to the voxels of the other side, beside that of the second derivatives.
_NEARNESS = 0.01
_RELAXATION = 1.4
# Of the first solution, and of the second: with 15 and 10 a ball keeps bumps that descriptors see.
_N_SWEEPS = 20
# Voxels from the border within which the function is free.
_BAND = 2

PAD = _BAND + 2
"""Empty voxels that the grid must have on every side."""

# Grids of more voxels, such as those around thin vessels, are solved block by block, each with so many voxels around.
_WHOLE, _BLOCK, _AROUND = 1 << 22, 48, 12


def smooth_field(share: Singles, sides: Floats) -> Floats | Singles:
    """The function at the centres of the voxels, in shortest sides, about the distance to the surface nearby.

    Shares (X, Y, Z) of each voxel that lies in the body, 0 to 1, have `PAD` empty layers around; those of a mask are 0
    or 1 and tell whether the centre is in the body. The sides (3,) of a voxel have 1 as the shortest.
    """
    if share.size <= _WHOLE:
        return _solved(share, sides)
    far = (PAD - 0.5) * float(sides.max())
    margin = np.ceil(PAD * sides.max() / sides).astype(np.int64)
    around = np.maximum(margin, _AROUND)
    field = np.full(share.shape, far, dtype=np.float32)
    for corner in np.ndindex(*(math.ceil(n / _BLOCK) for n in share.shape)):
        low = _BLOCK * np.array(corner)
        high = np.minimum(low + _BLOCK, share.shape)
        start = np.maximum(low - around, 0)
        inside = share[tuple(map(slice, start, high + around))] >= 0.5
        if not inside.any():
            continue
        if inside.all():
            field[tuple(map(slice, low, high))] = -far
            continue
        (box,) = ndimage.find_objects(inside.view(np.uint8))
        first, last = (start + [getattr(side, end) for side in box] for end in ("start", "stop"))
        least, most = np.maximum(first - margin, start), np.minimum(last + margin, start + inside.shape)
        missing = list(zip(margin - (first - least), margin - (most - last), strict=True))
        solved = _solved(np.pad(share[tuple(map(slice, least, most))], missing), sides)
        origin = first - margin  # of what was solved, in the grid
        a, b = np.maximum(low, least), np.minimum(high, most)
        if (a < b).all():
            own = solved[tuple(map(slice, a - origin, b - origin))]
            field[tuple(map(slice, a, b))] = np.clip(own, -far, far)
    return field


def _solved(share: Singles, sides: Floats) -> Floats:
    """The function on a grid as a whole."""
    inside = share >= 0.5
    distance = ndimage.distance_transform_edt(inside, sampling=sides)
    distance += ndimage.distance_transform_edt(~inside, sampling=sides)
    field = np.where(inside, -1.0, 1.0) * (distance - 0.5)
    border = ndimage.maximum_filter(inside, 2 * _BAND + 1) & ~ndimage.minimum_filter(inside, 2 * _BAND + 1)
    nodes = np.flatnonzero(border)
    target = field.reshape(-1)[nodes]
    second = np.array([-1.0, 2, -1])
    laplacian = np.zeros_like(field)
    for axis, side in enumerate(sides):
        laplacian += ndimage.correlate1d(field, second / side**2, axis)
    steps = np.array(field.strides) // field.itemsize
    certain = np.abs(2 * share - 1).reshape(-1)[nodes]

    def relax(sharpness: Floats) -> None:
        margin = np.interp(sharpness.reshape(-1)[nodes], (0, 1), _MARGINS)
        _relax(
            field.reshape(-1), laplacian.reshape(-1), nodes, np.concatenate([[0], steps, -steps]),
            np.concatenate([[2 * (sides**-2).sum()], -(sides**-2), -(sides**-2)]),
            np.interp(sharpness, (0, 1), _STIFFNESS).reshape(-1), target, inside.reshape(-1)[nodes], margin * certain,
        )  # fmt: skip

    relax(np.zeros_like(field))
    # Over long voxels edges are blunter.
    bend = np.abs(ndimage.gaussian_filter(laplacian, _WINDOW, truncate=3)) * np.sqrt(sides.max())
    around, weight = (
        ndimage.gaussian_filter(values, _WIDE_WINDOW, truncate=3) for values in (bend * border, border.astype(float))
    )
    relax(np.interp(bend - around / np.maximum(weight, 1e-3), _BENDS, (0, 1)))
    return field


def filled_share(field: Floats | Singles, reach: float) -> tuple[float, float]:
    """How many voxels the part fills on which the field is negative, and how fast that grows as the level does.

    Of a voxel with a value beyond the reach all is on one side.
    """
    near = np.nonzero(np.abs(field[1:-1, 1:-1, 1:-1]) < reach)
    at = np.ravel_multi_index(tuple(index + 1 for index in near), field.shape)
    values, width = field.reshape(-1), np.full(len(at), 1e-3)
    for step in np.cumprod([1, *field.shape[:0:-1]]).tolist():  # strides are others: splines turn the axes
        width += np.abs(values[at + step] - values[at - step]) / 2
    share = 0.5 - values[at] / width
    full = np.count_nonzero(field < 0) - np.count_nonzero(values[at] < 0)
    part = (share > 0) & (share < 1)
    return float(np.clip(share, 0, 1).sum()) + full, float((1 / width[part]).sum())


@compiled(fastmath=SUMS)
def _relax(
    field: Floats, laplacian: Floats, nodes: Integers, steps: Integers, weights: Floats, stiffness: Floats,
    target: Floats, inside: Booleans, margin: Floats,
) -> None:  # fmt: skip
    """Projected Gauss-Seidel sweeps, forwards and backwards in turn, of weighted squared Laplacians, in place.

    The negative Laplacian, of these steps and weights, is kept up to date.
    """
    n = len(nodes)
    for sweep in range(_N_SWEEPS):
        for count in range(n):
            at = count if sweep % 2 == 0 else n - 1 - count
            node = nodes[at]
            total, centre = _NEARNESS * (target[at] - field[node]), _NEARNESS
            for k in range(len(steps)):
                weight = weights[k] * stiffness[node + steps[k]]
                total -= weight * laplacian[node + steps[k]]
                centre += weight * weights[k]
            value = field[node] + _RELAXATION * total / centre
            value = min(value, -margin[at]) if inside[at] else max(value, margin[at])
            change = value - field[node]
            field[node] = value
            for k in range(len(steps)):
                laplacian[node + steps[k]] += weights[k] * change

"""A smooth function on a grid of voxels that is negative where most of a voxel lies in the body.

Voxels tell where a body is by their centres, or by the share of each that it fills. Of all functions whose signs agree
with that, one is taken that bends little: no stairs are left, since the zero level is free between the last voxels
inside and the first outside; and nothing thin is lost, since no voxel changes sides. (Whitaker 2000 and Gibson 1998
hold surfaces by the same constraint; Lempitsky 2010 takes second derivatives, which shrink nothing, in place of area.)
Convex corners are still cut, so the level is moved to give back the voxels' volume, nearby first, then as a whole.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers
from igps._compiled import compiled

# Least absolute value of a voxel that is wholly inside or outside, in shortest sides; half would be the most that all
# bodies allow. More keeps edges sharper, less leaves round bodies smoother; this serves descriptors best.
_MARGIN = 0.1
# Weight of the distance to the voxels of the other side, beside that of the second derivatives.
_NEARNESS = 0.1
_RELAXATION = 1.4
_N_SWEEPS = 10
# Voxels from the border within which the function is free.
_BAND = 2
# Standard deviation of the window in which the volume is kept, in voxels: of masks, and of shares, which are finer.
_WINDOW, _NARROW_WINDOW = 2.0, 1.0
_N_CORRECTIONS = 2

PAD = _BAND + 2
"""Empty voxels that the grid must have on every side."""


def smooth_field(share: Floats, spacing: Floats, is_mask: bool) -> Floats:
    """The function at the centres of the voxels, in units of length, about the distance to the surface nearby.

    Shares (X, Y, Z) of each voxel that lies in the body, 0 to 1, have `PAD` empty layers around; those of a mask are 0
    or 1 and tell whether the centre is in the body. The spacing (3,) are the sides of a voxel, length.
    """
    scale = float(spacing.min())
    sides = spacing / scale
    inside = share >= 0.5
    distance = ndimage.distance_transform_edt(inside, sampling=sides)
    distance += ndimage.distance_transform_edt(~inside, sampling=sides)
    target = np.where(inside, -1.0, 1.0) * (distance - 0.5)
    border = ndimage.maximum_filter(inside, 2 * _BAND + 1) & ~ndimage.minimum_filter(inside, 2 * _BAND + 1)
    nodes = np.flatnonzero(border)
    field = target.copy()
    offsets, weights = _bending(sides)
    steps = offsets @ (np.array(field.strides) // field.itemsize)
    margin = _MARGIN * np.abs(2 * share - 1)
    _relax(
        field.reshape(-1), nodes, steps[1:], weights[1:], weights[0], target.reshape(-1)[nodes],
        inside.reshape(-1)[nodes], margin.reshape(-1)[nodes],
    )  # fmt: skip
    # As wide along every axis: across long voxels a mask has terraces, which are no shape.
    window = (_WINDOW if is_mask else _NARROW_WINDOW) * sides.max() / sides
    for _ in range(_N_CORRECTIONS):
        filled, slope = filled_share(field)
        missing = ndimage.gaussian_filter(share - filled, window, truncate=3)
        field -= missing / (ndimage.gaussian_filter(slope, window, truncate=3) + 1e-3)
    return field * scale


def filled_share(field: Floats) -> tuple[Floats, Floats]:
    """The share of each voxel on which the field is negative, and how fast it grows as the level does."""
    width = np.full(field.shape, 1e-3)
    for axis in range(3):
        width += np.abs(np.gradient(field, axis=axis))
    share = 0.5 - field / width
    return np.clip(share, 0, 1), np.where((share > 0) & (share < 1), 1 / width, 0.0)


def _bending(sides: Floats) -> tuple[Integers, Floats]:
    """Gradient of the sum of squared second differences: offsets (25, 3), the centre's first, and weights (25,)."""
    weights = {(0, 0, 0): 0.0}

    def add(one: Floats, two: Floats, axes: tuple[int, int], factor: float) -> None:
        for i, a in enumerate(one):
            for j, b in enumerate(two):
                offset = [0, 0, 0]
                offset[axes[0]] += i - len(one) // 2
                offset[axes[1]] += j - len(two) // 2
                weights[tuple(offset)] = weights.get(tuple(offset), 0.0) + factor * a * b  # type: ignore[index,arg-type]

    second = np.array([-1.0, 2.0, -1.0])
    for axis in range(3):
        add(np.convolve(second, second), np.ones(1), (axis, axis), sides[axis] ** -4)
        for other in range(axis + 1, 3):
            add(second, second, (axis, other), 2 * (sides[axis] * sides[other]) ** -2)
    return np.array(list(weights)), np.array(list(weights.values()))


@compiled(fastmath={"contract", "reassoc", "nsz"})
def _relax(
    field: Floats, nodes: Integers, steps: Integers, weights: Floats, centre: float, target: Floats, inside: Booleans,
    margin: Floats,
) -> None:  # fmt: skip
    """Projected Gauss-Seidel sweeps, forwards and backwards in turn, in place."""
    n = len(nodes)
    for sweep in range(_N_SWEEPS):
        for count in range(n):
            at = count if sweep % 2 == 0 else n - 1 - count
            node = nodes[at]
            total = _NEARNESS * target[at]
            for k in range(len(steps)):
                total -= weights[k] * field[node + steps[k]]
            value = field[node] + _RELAXATION * (total / (centre + _NEARNESS) - field[node])
            field[node] = min(value, -margin[at]) if inside[at] else max(value, margin[at])

"""Measure the voxels of a label, before a surface is made."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers
from igps.mesh.raw_body import LabelVoxels

# A label is as thick as a ball if balls of that size that fit inside it cover this share of its voxels.
_MIN_COVERED = 0.95
# Squared distance from a ball's centre, in squared radii, that it covers: 3 reaches the corners of a cube around it.
_NEAR = 3
_MAX_DIAMETER = 10  # voxels
_MIN_WHOLE_VOXELS = 1 << 20  # smaller masks are measured in half voxels
_BLOCK = 96  # voxels a side of the blocks that are measured one by one; their distances fit into the processor's cache


@dataclass(frozen=True)
class VoxelMeasures:
    """Measures of a label."""

    n_voxels: int
    n_pieces: int  # pieces that share no corner
    thinnest: int  # thickness of the thinnest part in voxels, see `thinnest_part`


def measure(voxels: LabelVoxels) -> VoxelMeasures:
    """Measure the voxels of a label."""
    n_pieces = ndimage.label(voxels.mask, np.ones((3, 3, 3)))[1]
    n_voxels = int(np.count_nonzero(voxels.mask))
    return VoxelMeasures(n_voxels, int(n_pieces), thinnest_part(voxels.mask))


def voxel_numbers(mask: Booleans, affine: Floats) -> dict[str, float]:
    """Return what a surface does not tell of a label, see `igps.measures`: volume, pieces, Euler number, spacing.

    Args:
        mask: (X, Y, Z), its axes along x, y and z.
        affine: (4, 4) from voxel indices to the world.
    """
    from skimage.measure import euler_number

    axes = affine[:3, :3]
    spacing = np.linalg.norm(axes, axis=0)
    return {
        "voxel_volume": float(np.count_nonzero(mask) * abs(np.linalg.det(axes))),
        "n_pieces": float(ndimage.label(mask, np.ones((3, 3, 3)))[1]),
        "euler_number": float(euler_number(mask, connectivity=3)),
        "spacing_x": float(spacing[0]),
        "spacing_y": float(spacing[1]),
        "spacing_z": float(spacing[2]),
    }


def thinnest_part(mask: Booleans) -> int:
    """Return the diameter of the largest balls that fit into the mask nearly everywhere, 1 to 10 voxels."""
    mask = np.pad(mask, 1)
    n_voxels = np.count_nonzero(mask)
    cube = _MAX_DIAMETER + 1
    # Where cubes fit, balls do; cubes are found much faster.
    cubes = ndimage.maximum_filter(ndimage.minimum_filter(mask, cube), cube)
    if np.count_nonzero(cubes) >= _MIN_COVERED * n_voxels:
        return _MAX_DIAMETER
    # An even thickness has its middle between voxels
    parts = 2 if mask.size < _MIN_WHOLE_VOXELS else 1
    for axis in range(3):
        mask = np.repeat(mask, parts, axis=axis)
    radii = [float(d) if parts == 2 else (d + 1) / 2 for d in range(2, _MAX_DIAMETER + 1)]
    min_depths = [math.ceil(r**2) for r in radii]  # squared depth of the centre of a ball that fits
    reach = [math.ceil(_NEAR * r**2) for r in radii]
    n_uncovered = np.zeros(len(radii), dtype=np.int64)
    for corner in np.ndindex(*(math.ceil(n / _BLOCK) for n in mask.shape)):
        first = _BLOCK * np.array(corner)
        boxes = ndimage.find_objects(mask[tuple(map(slice, first, first + _BLOCK))].view(np.uint8))
        if not boxes:
            continue
        low, high = (first + [getattr(side, end) for side in boxes[0]] for end in ("start", "stop"))
        block = mask[tuple(map(slice, low, high))]
        start, stop = _widen(low, high, reach[-1])
        start, stop = _widen(start, stop, min_depths[-1])
        depth = _squared_distances(mask[tuple(map(slice, start, stop))], min_depths[-1])
        for k in range(len(radii)):
            begin, end = _widen(low, high, reach[k])
            is_no_centre = depth[tuple(map(slice, begin - start, end - start))] < min_depths[k]
            to_centre = _squared_distances(is_no_centre, reach[k])[
                tuple(map(slice, low - begin, high - begin))
            ]
            n_uncovered[k] += np.count_nonzero(block & (to_centre == reach[k]))
            if n_uncovered[k] > (1 - _MIN_COVERED) * parts**3 * n_voxels:
                radii = radii[:k]  # larger balls need not be tried
                break
    return 1 + len(radii)


def _widen(low: Integers, high: Integers, squared_distance: int) -> tuple[Integers, Integers]:
    """Widen a box by all voxels nearer than a squared distance."""
    around = math.isqrt(squared_distance - 1)
    return np.maximum(low - around, 0), high + around


def _squared_distances(mask: Booleans, max_value: int) -> NDArray[np.unsignedinteger[Any]]:
    """Return the squared distances (X, Y, Z) to the nearest voxel outside the mask, cut at `max_value`.

    Integers of one or two bytes and bounded distances take a tenth of the time of a full distance transform.
    """
    number = np.min_scalar_type(2 * max_value).type
    squares = np.where(mask, number(max_value), number(0))
    for axis in range(3):
        lines = np.moveaxis(squares, axis, 0)
        nearest = lines.copy()
        for step in range(1, min(math.isqrt(max_value - 1) + 1, len(lines))):
            moved = lines + number(step**2)
            np.minimum(nearest[step:], moved[:-step], out=nearest[step:])
            np.minimum(nearest[:-step], moved[step:], out=nearest[:-step])
        squares = np.moveaxis(nearest, 0, axis)
    return squares

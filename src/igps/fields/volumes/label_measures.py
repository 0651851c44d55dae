"""Measure the voxels of a label, before a surface is made."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers
from igps.fields.volumes._boxes import TOUCHING, block_corners, bounds_of, box_of
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
    _, n_pieces = ndimage.label(voxels.mask, TOUCHING)
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
    x, y, z = np.linalg.norm(axes, axis=0).tolist()
    _, n_pieces = ndimage.label(mask, TOUCHING)
    return {
        "voxel_volume": float(np.count_nonzero(mask) * abs(np.linalg.det(axes))),
        "n_pieces": float(n_pieces),
        "euler_number": float(euler_number(mask, connectivity=3)),
        "spacing_x": x,
        "spacing_y": y,
        "spacing_z": z,
    }


def thinnest_part(mask: Booleans) -> int:
    """Return the diameter of the largest balls that fit into the mask nearly everywhere, 1 to 10 voxels."""
    mask = np.pad(mask, 1)
    n_voxels = np.count_nonzero(mask)
    cube = _MAX_DIAMETER + 1
    # Where cubes fit, balls do; cubes are found much faster.
    centres = ndimage.minimum_filter(mask, cube)
    in_cubes = ndimage.maximum_filter(centres, cube)
    if np.count_nonzero(in_cubes) >= _MIN_COVERED * n_voxels:
        return _MAX_DIAMETER
    # An even thickness has its middle between voxels
    parts = 2 if mask.size < _MIN_WHOLE_VOXELS else 1
    for axis in range(3):
        mask = np.repeat(mask, parts, axis=axis)
    diameters = range(2, _MAX_DIAMETER + 1)
    radii = [float(d) if parts == 2 else (d + 1) / 2 for d in diameters]
    min_depths = [math.ceil(r**2) for r in radii]  # squared depth of the centre of a ball that fits
    reach = [math.ceil(_NEAR * r**2) for r in radii]
    max_uncovered = (1 - _MIN_COVERED) * parts**3 * n_voxels
    n_uncovered = np.zeros(len(radii), dtype=np.int64)
    for corner in block_corners(mask.shape, _BLOCK):
        block = mask[box_of(corner, corner + _BLOCK)]
        if not block.any():
            continue
        first, last = bounds_of(block)
        low = corner + first
        high = corner + last
        block = mask[box_of(low, high)]
        start, stop = _widen(low, high, reach[-1])
        start, stop = _widen(start, stop, min_depths[-1])
        depth = _squared_distances(mask[box_of(start, stop)], min_depths[-1])
        for k in range(len(radii)):
            begin, end = _widen(low, high, reach[k])
            is_no_centre = depth[box_of(begin - start, end - start)] < min_depths[k]
            to_centre = _squared_distances(is_no_centre, reach[k])
            is_far = to_centre[box_of(low - begin, high - begin)] == reach[k]
            n_uncovered[k] += np.count_nonzero(block & is_far)
            if n_uncovered[k] > max_uncovered:
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
        n_steps = min(math.isqrt(max_value - 1) + 1, len(lines))
        for step in range(1, n_steps):
            moved = lines + number(step**2)
            np.minimum(nearest[step:], moved[:-step], out=nearest[step:])
            np.minimum(nearest[:-step], moved[step:], out=nearest[:-step])
        squares = np.moveaxis(nearest, 0, axis)
    return squares

"""Measures of the voxels of a label, before a surface is made."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers

# Share of the voxels that must lie near balls of a diameter for no part to be thinner; and how near, as the square of
# so many radii: corners of a box as thick are no thinner.
_COVERED, _NEAR = 0.95, 3
_MOST = 10
# Smaller masks are measured in half voxels.
_SMALL = 1 << 20
# Voxels along the sides of the blocks that are measured one by one: their distances stay in the processor's cache.
_BLOCK = 96


@dataclass(frozen=True)
class VoxelMeasures:
    """Of a label: how many voxels, pieces that share no corner, and the thickness of the thinnest part in voxels."""

    n_voxels: int
    n_pieces: int
    thinnest: int


@dataclass(frozen=True, eq=False)
class LabelVoxels:
    """A label in its grid."""

    mask: Booleans  # (X, Y, Z) where it is, in the smallest box that holds it
    low: Integers  # (3,) index of the first voxel of the box
    grid: tuple[int, ...]  # voxels of the whole volume along its axes
    affine: Floats  # (4, 4) from indices of the volume to the world

    def measures(self) -> VoxelMeasures:
        n_pieces = ndimage.label(self.mask, np.ones((3, 3, 3)))[1]
        return VoxelMeasures(int(np.count_nonzero(self.mask)), int(n_pieces), thinnest_part(self.mask))


def thinnest_part(mask: Booleans) -> int:
    """The largest diameter up to ten voxels of which balls fit into the mask nearly everywhere, at least 1."""
    mask = np.pad(mask, 1)
    n_voxels, cube = np.count_nonzero(mask), _MOST + 1
    # Where cubes fit, which are found much faster, balls do.
    cubes = ndimage.maximum_filter(ndimage.minimum_filter(mask, cube), cube)
    if np.count_nonzero(cubes) >= _COVERED * n_voxels:
        return _MOST
    parts = 2 if mask.size < _SMALL else 1  # thickness of even numbers of voxels is seen in halves alone
    for axis in range(3):
        mask = np.repeat(mask, parts, axis=axis)
    radii = [float(d) if parts == 2 else (d + 1) / 2 for d in range(2, _MOST + 1)]
    least = [math.ceil(r**2) for r in radii]  # squared depth of the middle of a ball
    reach = [math.ceil(_NEAR * r**2) for r in radii]
    bare = np.zeros(len(radii), dtype=np.int64)  # voxels that are near no ball
    for corner in np.ndindex(*(math.ceil(n / _BLOCK) for n in mask.shape)):
        first = _BLOCK * np.array(corner)
        boxes = ndimage.find_objects(mask[tuple(map(slice, first, first + _BLOCK))].view(np.uint8))
        if not boxes:
            continue
        low, high = (first + [getattr(side, end) for side in boxes[0]] for end in ("start", "stop"))
        own = mask[tuple(map(slice, low, high))]
        start, stop = _widened(low, high, reach[-1])
        start, stop = _widened(start, stop, least[-1])
        depth = _squared_distances(mask[tuple(map(slice, start, stop))], least[-1])
        for k in range(len(radii)):
            begin, end = _widened(low, high, reach[k])
            apart = depth[tuple(map(slice, begin - start, end - start))] < least[k]
            near = _squared_distances(apart, reach[k])[tuple(map(slice, low - begin, high - begin))]
            bare[k] += np.count_nonzero(own & (near == reach[k]))
            if bare[k] > (1 - _COVERED) * parts**3 * n_voxels:
                radii = radii[:k]  # no thicker ones need to be tried
                break
    return 1 + len(radii)


def _widened(low: Integers, high: Integers, square: int) -> tuple[Integers, Integers]:
    """A box with all voxels around of less than a squared distance."""
    around = math.isqrt(square - 1)
    return np.maximum(low - around, 0), high + around


def _squared_distances(mask: Booleans, most: int) -> NDArray[np.unsignedinteger[Any]]:
    """(X, Y, Z) squared distances to the nearest voxel that is not in the mask, `most` where that or more.

    Whole numbers of a byte or two, and no more of them than are near, take a tenth of the time of a transform.
    """
    kind = np.min_scalar_type(2 * most)
    found = np.where(mask, kind.type(most), kind.type(0))
    for axis in range(3):
        lines = np.moveaxis(found, axis, 0)
        nearest = lines.copy()
        for step in range(1, min(math.isqrt(most - 1) + 1, len(lines))):
            moved = lines + kind.type(step**2)
            np.minimum(nearest[step:], moved[:-step], out=nearest[step:])
            np.minimum(nearest[:-step], moved[step:], out=nearest[:-step])
        found = np.moveaxis(nearest, 0, axis)
    return found

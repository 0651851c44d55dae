"""Measures of the voxels of a label, before a surface is made."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers

# Share of the voxels that must lie near balls of a diameter for no part to be thinner; and how near, in radii: corners
# of a box as thick are no thinner.
_COVERED, _NEAR = 0.95, 3**0.5
_MOST = 10
# Smaller masks are measured in half voxels.
_SMALL = 1 << 20
# Voxels along the sides of the blocks that are measured one by one: distances take some 50 bytes each.
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
    radii = [d / 2 * parts if parts == 2 else (d + 1) / 2 for d in range(2, _MOST + 1)]
    around = math.ceil((1 + _NEAR) * radii[-1]) + 1
    deepest, covered = 0.0, np.zeros(len(radii), dtype=np.int64)
    for corner in np.ndindex(*(math.ceil(n / _BLOCK) for n in mask.shape)):
        low = _BLOCK * np.array(corner)
        start = np.maximum(low - around, 0)
        part = mask[tuple(map(slice, start, low + _BLOCK + around))]
        inner = tuple(slice(a, a + _BLOCK) for a in low - start)
        own = part[inner]
        if not own.any():
            continue
        depth = np.full(part.shape, np.inf) if part.all() else ndimage.distance_transform_edt(part)
        deepest = max(deepest, float(depth[inner].max()))
        for k, radius in enumerate(radii):
            thin = depth < radius
            if not thin.all():
                near = ndimage.distance_transform_edt(thin)[inner] < _NEAR * radius
                covered[k] += np.count_nonzero(near & own)
    full = (covered >= _COVERED * parts**3 * n_voxels) & (np.array(radii) <= deepest)
    return 1 + int(np.argmin([*full, False]))

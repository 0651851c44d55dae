"""Measures of the voxels of a label, before a surface is made."""

from __future__ import annotations

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


@dataclass(frozen=True)
class VoxelMeasures:
    """Of a label: how many voxels, pieces that share no corner, and the thickness of the thinnest part in voxels."""

    n_voxels: int
    n_pieces: int
    thinnest: int


def thinnest_part(mask: Booleans) -> int:
    """The largest diameter up to ten voxels of which balls fit into the mask nearly everywhere, at least 1."""
    mask = np.pad(mask, 1)
    parts = 2 if mask.size < _SMALL else 1  # thickness of even numbers of voxels is seen in halves alone
    for axis in range(3):
        mask = np.repeat(mask, parts, axis=axis)
    depth, n_voxels, found = ndimage.distance_transform_edt(mask), np.count_nonzero(mask), 1
    for diameter in range(2, _MOST + 1):
        radius = diameter * parts / 2 if parts == 2 else (diameter + 1) / 2
        if radius > depth.max():
            break
        covered = np.count_nonzero(ndimage.distance_transform_edt(depth < radius)[mask] < _NEAR * radius)
        if covered < _COVERED * n_voxels:
            break
        found = diameter
    return found

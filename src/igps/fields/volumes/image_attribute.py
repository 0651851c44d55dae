"""Attributes from images and grids."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from igps._arrays import Floats
from igps.data.attribute_sources import FileAttribute, is_known
from igps.fields.meshes import brains
from igps.fields.volumes import images
from igps.mesh.formats import dependencies_of, stat_key
from igps.mesh.loading import BodyRef


@dataclass(frozen=True)
class ImageAttribute(FileAttribute):
    """Values of an image or grid, interpolated linearly between the centres of voxels.

    NIfTI, MGH, NRRD and MetaImage are in world coordinates (RAS, millimetres); OpenDX, MRC and CCP4 in ångström.
    """

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        grid, affine = images.read(file, stat_key(*dependencies_of(file)))
        indices = (brains.in_scanner(body.path, points) - affine[:3, 3]) @ np.linalg.inv(
            affine[:3, :3]
        ).T
        size = np.array(grid.shape)
        inside = ((indices > -0.5) & (indices < size - 0.5)).all(axis=1)
        values = np.full(len(points), np.nan)
        if not inside.any():
            return values
        # A large image is converted only where it is needed
        low = np.clip(np.floor(indices[inside].min(axis=0)).astype(int), 0, size - 1)
        high = np.clip(np.ceil(indices[inside].max(axis=0)).astype(int), 0, size - 1)
        block = grid[tuple(map(slice, low, high + 1))].astype(np.float64)
        known = is_known(block)
        interpolate = partial(
            map_coordinates, coordinates=(indices[inside] - low).T, order=1, mode="nearest"
        )
        weight = interpolate(known.astype(np.float64))
        sums = interpolate(np.where(known, block, 0.0))
        values[inside] = np.where(weight > 0.5, sums / np.maximum(weight, 0.5), np.nan)
        return values

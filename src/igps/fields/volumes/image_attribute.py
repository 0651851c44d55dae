"""Attributes from images and grids."""

from dataclasses import dataclass
from pathlib import Path

from igps._arrays import Floats
from igps.data.attribute_sources import FileAttribute
from igps.data.grids import Grid
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
        return Grid(grid, affine).at(brains.in_scanner(body.path, points))

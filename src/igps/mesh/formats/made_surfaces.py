"""Files that hold no surface, of which one is made for each body: label volumes and molecules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from igps.mesh._label_measures import VoxelMeasures
from igps.mesh.formats import _structures, _volume_files
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions

if TYPE_CHECKING:
    from igps.mesh.formats.molecules import MoleculeBodies


def read_volume(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surfaces of the labels of a volume; or of all of them together as the whole."""
    from igps.mesh.formats.volumes import label_surface, read_label_volume

    volume = read_label_volume(path, options)
    if options.bodies in ("whole", "pieces"):
        labelled = np.any([layer > 0 for layer in volume.layers], axis=0).astype(np.uint8)
        volume = replace(volume, layers=(labelled,), names=None, segments=None)
        made = partial(label_surface, volume, 1, cavities=options.cavities)
        return [_body(made, None, volume.unit, partial(volume.measures, 1))]
    made = partial(label_surface, volume, how=options.mend, cavities=options.cavities)
    names = [body.name for body in volume.bodies] if part is None else [volume.body(part).name]
    return [_body(partial(made, name), name, volume.unit, partial(volume.measures, name)) for name in names]


def read_structure(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surfaces of the chains, models or the assembly of a structure file, in ångström."""
    from igps.mesh.formats.molecules import molecules_by_part
    from igps.mesh.molecular_surface import molecular_surface

    how: MoleculeBodies = options.bodies if options.bodies in ("chains", "assembly") else "models"
    found = molecules_by_part(path, path.stat().st_mtime_ns, how)
    names = [name for name in found if part in (None, name)]
    return [_body(partial(molecular_surface, found[name]), name, "Å") for name in names]


def _body(
    make: Callable[[], Mesh], part: str | None, unit: str | None, voxels: Callable[[], VoxelMeasures] | None = None
) -> RawBody:
    """A body whose surface is made when it is asked for; a fault of it leaves the others."""

    def made() -> RawBody:
        try:
            mesh = make()
        except MeshError as fault:
            return RawBody(part=part, fault=fault, voxels=voxels)
        return RawBody(mesh.vertices, mesh.faces, part, unit, notes=mesh.notes, voxels=voxels)

    return RawBody(part=part, make=made)


_STRUCTURES = tuple(sorted(suffix + packed for suffix in _structures.SUFFIXES for packed in ("", ".gz")))
_VOLUMES = tuple(_volume_files.READERS)
VOLUMES = Format("a label volume", _VOLUMES, read_volume, ("labels",), extra="volumes")
MOLECULES = Format("a structure", _STRUCTURES, read_structure, ("chains", "models", "assembly"), extra="molecules")

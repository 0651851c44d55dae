"""Scenes and CAD files: GLB, glTF, COLLADA, 3DXML and XAML, STEP. An object is what stands at a place of the scene."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

from igps.mesh.formats._format import Format, RawBody, check_unpacked
from igps.mesh.formats._trimesh import objects
from igps.mesh.options import LoadOptions


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The objects of a scene."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_unpacked(sum(one.file_size for one in archive.infolist()), path, options.max_unpacked)
    return objects(path, options)


def read_gltf(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The objects of a glTF scene, which is in metres."""
    return [replace(body, unit="m") for body in objects(path, options)]


def read_step(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The solids of a STEP file, in millimetres."""
    return [replace(body, vertices=1000 * body.vertices, unit="mm") for body in objects(path, options)]


GLTF = Format("glTF", (".glb", ".gltf"), read_gltf, bodies=("whole", "objects"))
STEP = Format("STEP", (".step", ".stp"), read_step, bodies=("whole", "objects"), extra="cad")
OTHERS = Format(
    "COLLADA, 3DXML or XAML", (".dae", ".zae", ".3dxml", ".xaml"), read, bodies=("whole", "objects"), extra="formats"
)

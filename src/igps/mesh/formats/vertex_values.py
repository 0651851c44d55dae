"""Values at the vertices of a surface, or at the points of tetrahedra, as files have them."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps.mesh.formats import brains, vtk
from igps.mesh.formats._trimesh import ply_columns
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions

Arrays = Mapping[str, Floats]

_MAGIC = b"\xff\xff\xff"
_VTK = (".vtk", ".vtp", ".vtu")


def read(path: Path) -> Arrays:
    """Arrays (V,) or (V, C) by name: of PLY, VTK, GIFTI, or of FreeSurfer's files of thickness, curvature and the like.
    A ValueError if there is none, or the file is damaged."""
    name = path.name.lower()
    if name.endswith(_VTK):
        found = vtk.point_values(path, LoadOptions()).values
    elif name.endswith(".gii"):
        found = brains.gifti_values(path, LoadOptions())
    elif name.endswith(".ply"):
        found = _ply(path)
    else:
        found = {path.suffix.lstrip("."): _freesurfer(path)}
    if not found:
        raise MeshError(f"{path}: has no values at vertices. Export it with them.")
    return {one: np.asarray(values, dtype=np.float64) for one, values in found.items()}


def read_tetrahedra(path: Path) -> tuple[Floats, Integers, Arrays]:
    """Points (V, 3), tetrahedra (T, 4), and arrays (V,) or (V, C) by name, of a VTK file; a ValueError without them."""
    found = vtk.point_values(path, LoadOptions())
    if not len(found.tetrahedra) or not found.values:
        raise MeshError(f"{path}: expected tetrahedra with values at their points. Export both.")
    if found.tetrahedra.min() < 0 or found.tetrahedra.max() >= len(found.vertices):
        raise MeshError(f"{path}: a tetrahedron has a corner that is no point. Export it again.")
    return found.vertices, found.tetrahedra, {name: values.astype(float) for name, values in found.values.items()}


def chosen(arrays: Arrays, name: str, path: Path) -> Floats:
    """The array of a name, or the only one."""
    if name in arrays:
        return arrays[name]
    if not name and len(arrays) == 1:
        return next(iter(arrays.values()))
    raise MeshError(f"{path}: expected one of its arrays {', '.join(arrays)}, got {name!r}. Name it as FILE#ARRAY.")


def _ply(path: Path) -> dict[str, NDArray[np.generic]]:
    """Every property of the vertices, but for places, normals and colours."""
    scene = trimesh.load_scene(BytesIO(path.read_bytes()), file_type="ply", process=False, fix_texture=False)
    columns = ply_columns(scene).items()
    usual = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
    return {name: values[:, 0] if values.shape[1] == 1 else values for name, values in columns if name not in usual}


def _freesurfer(path: Path) -> NDArray[np.generic]:
    content = path.read_bytes()
    if not content.startswith(_MAGIC) or len(content) < 15:
        raise ValueError("neither of the suffix of a format that is read, nor a file of values of FreeSurfer")
    n, _, n_each = (int(x) for x in np.frombuffer(content, ">i4", 3, 3))
    if n < 1 or n_each != 1 or len(content) < 15 + 4 * n:
        raise ValueError(f"{n} vertices of {n_each} values announced, {len(content) - 15} of {4 * n} bytes there")
    return np.frombuffer(content, ">f4", n, 15)

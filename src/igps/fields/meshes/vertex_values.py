"""Readers of values at the vertices of surfaces."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.fields.meshes import brains, ply, vtk
from igps.mesh.errors import MeshError
from igps.mesh.options import LoadOptions

Arrays = Mapping[str, Floats]


def read(path: Path) -> Arrays:
    """Read the arrays (V,) or (V, C) of values at vertices by name; a ValueError if there are none.

    Formats are PLY, VTK, GIFTI, and FreeSurfer's files of thickness, curvature and the like.
    """
    name = path.name.lower()
    if name.endswith((".vtk", ".vtp", ".vtu")):
        arrays = vtk.point_values(path, LoadOptions())
    elif name.endswith(".gii"):
        arrays = brains.gifti_values(path, LoadOptions())
    elif name.endswith(".ply"):
        arrays = _ply(path)
    else:
        arrays = {path.suffix.lstrip("."): _freesurfer(path)}
    if not arrays:
        raise MeshError(
            f"{path}: expected values at vertices, got none. Export the file with values."
        )
    return {key: np.asarray(values, dtype=np.float64) for key, values in arrays.items()}


def chosen(arrays: Arrays, name: str, path: Path) -> Floats:
    """Return the array of a name; an empty name stands for the only array."""
    if name in arrays:
        return arrays[name]
    if not name and len(arrays) == 1:
        return next(iter(arrays.values()))
    raise MeshError(
        f"{path}: expected one of its arrays {', '.join(arrays)}, got {name!r}. Name it as FILE#ARRAY."
    )


def _ply(path: Path) -> dict[str, NDArray[np.generic]]:
    """Read the properties of vertices other than coordinates, normals and colours."""
    ignored = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
    values = {}
    for name, column in ply.elements(path)["vertex"].items():
        is_single = (column.lengths == 1).all()
        if name not in ignored and is_single:
            values[name] = column.numbers
    return values


def _freesurfer(path: Path) -> NDArray[np.generic]:
    content = path.read_bytes()
    if not content.startswith(b"\xff\xff\xff") or len(content) < 15:
        raise ValueError(
            "expected PLY, VTK or GIFTI by its suffix, or a file of values of FreeSurfer"
        )
    n, _, n_values = np.frombuffer(content, ">i4", 3, 3).tolist()
    if n < 1 or n_values != 1 or len(content) < 15 + 4 * n:
        raise ValueError(
            f"expected {n} values in {4 * n} bytes, got {n_values} a vertex in {len(content) - 15} bytes"
        )
    return np.frombuffer(content, ">f4", n, 15)

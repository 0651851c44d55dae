"""What trimesh reads, from bytes: of other files it gets those of the same folder alone."""

from __future__ import annotations

import logging
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray

from igps.mesh.formats._format import RawBody, check_unpacked, distinct
from igps.mesh.options import LoadOptions

# Errors name the file and its fault; the tracebacks that trimesh logs by default add nothing
logging.getLogger("trimesh").addHandler(logging.NullHandler())


class Beside(trimesh.resolvers.Resolver):
    """The files of one folder, and those below it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()

    def place(self, name: str) -> Path:
        """The file of a name, in which blanks and the like may be written as in addresses."""
        place = (self._folder / name).resolve()
        place = place if place.is_file() else (self._folder / unquote(name)).resolve()
        if not place.is_relative_to(self._folder):
            raise ValueError(f"it refers to {name!r}, outside of its folder")
        return place

    def get(self, name: str) -> bytes:
        return self.place(name).read_bytes()

    def keys(self) -> list[str]:
        return []

    def namespaced(self, namespace: str) -> Beside:
        return self

    def write(self, name: str, data: bytes) -> None:
        raise NotImplementedError


def objects(path: Path, options: LoadOptions, content: bytes | None = None, **loading: Any) -> list[RawBody]:
    """A body for each place of a scene where a geometry stands; `loading` is for trimesh."""
    loading = {"file_type": path.suffix.lower().lstrip("."), **loading}
    stream = BytesIO(path.read_bytes() if content is None else content)
    scene = trimesh.load_scene(stream, resolver=Beside(path.parent), process=False, **loading)
    nodes = [(node, *scene.graph.get(node)) for node in scene.graph.nodes_geometry]
    sizes = {name: 24 * (len(one.vertices) + len(getattr(one, "faces", ()))) for name, one in scene.geometry.items()}
    check_unpacked(sum(sizes[name] for _, _, name in nodes), path, options.max_unpacked)
    bodies = []
    for part, (_, matrix, name) in zip(distinct(str(node) for node, _, _ in nodes), nodes, strict=True):
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh | trimesh.PointCloud):
            continue
        vertices = np.asarray(geometry.vertices, dtype=np.float64)
        if not np.array_equal(matrix, np.eye(4)):
            vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if isinstance(geometry, trimesh.PointCloud):
            columns = ply_columns(scene)
            normals = [columns[name].astype(np.float64) for name in ("nx", "ny", "nz") if name in columns]
            bodies.append(RawBody(vertices, part=part, normals=np.hstack(normals) if len(normals) == 3 else None))
            continue
        faces = np.asarray(geometry.faces, dtype=np.int64)
        turned = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
        bodies.append(RawBody(vertices, np.ascontiguousarray(turned), part))
    if not bodies:
        raise ValueError("it holds no surface")
    return bodies


def ply_columns(scene: trimesh.Scene) -> dict[str, NDArray[Any]]:
    """(V, C) of every property of the vertices of a PLY file, which trimesh keeps in its metadata."""
    raws = (thing.metadata.get("_ply_raw", {}) for thing in (scene, *scene.geometry.values()))
    rows: dict[str, Any] = next((one["vertex"] for one in raws if "data" in one.get("vertex", {})), {"properties": ()})
    return {name: np.asarray(rows["data"][name]).reshape(rows["length"], -1) for name in rows["properties"]}

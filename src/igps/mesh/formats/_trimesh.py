"""Reading by trimesh, which gets bytes, and other files only from the same folder."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray

from igps.mesh.formats._format import RawBody, check_unpacked, distinct
from igps.mesh.options import LoadOptions


class FolderResolver(trimesh.resolvers.Resolver):
    """Access of trimesh to the files in and below one folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()

    def path(self, name: str) -> Path:
        """Return the path of a file; characters of the name may be escaped as in URLs."""
        path = (self._folder / name).resolve()
        path = path if path.is_file() else (self._folder / unquote(name)).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"it refers to {name!r}, outside of its folder")
        return path

    def get(self, name: str) -> bytes:
        return self.path(name).read_bytes()

    def keys(self) -> list[str]:
        return []

    def namespaced(self, namespace: str) -> FolderResolver:
        return self

    def write(self, name: str, data: bytes) -> None:
        raise NotImplementedError


def objects(
    path: Path, options: LoadOptions, content: bytes | None = None, **loading: Any
) -> list[RawBody]:
    """Return a body for each node of a scene that has a geometry; `loading` is passed to trimesh."""
    loading = {"file_type": path.suffix.lower().lstrip("."), **loading}
    stream = BytesIO(path.read_bytes() if content is None else content)
    scene = trimesh.load_scene(
        stream, resolver=FolderResolver(path.parent), process=False, **loading
    )
    nodes = [(node, *scene.graph.get(node)) for node in scene.graph.nodes_geometry]
    sizes = {
        name: 24 * (len(x.vertices) + len(getattr(x, "faces", ())))
        for name, x in scene.geometry.items()
    }
    check_unpacked(sum(sizes[name] for _, _, name in nodes), path, options.max_unpacked)
    bodies = []
    for part, (_, matrix, name) in zip(
        distinct(str(node) for node, _, _ in nodes), nodes, strict=True
    ):
        geometry = scene.geometry[name]
        vertices = np.asarray(geometry.vertices, dtype=np.float64)
        if not np.array_equal(matrix, np.eye(4)):
            vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if isinstance(geometry, trimesh.PointCloud):
            columns = ply_columns(scene)
            normals = [
                columns[name].astype(np.float64) for name in ("nx", "ny", "nz") if name in columns
            ]
            bodies.append(
                RawBody(
                    vertices, part=part, normals=np.hstack(normals) if len(normals) == 3 else None
                )
            )
        elif isinstance(geometry, trimesh.Trimesh):
            faces = np.asarray(geometry.faces, dtype=np.int64)
            faces = (
                faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
            )  # turned back if mirrored
            bodies.append(RawBody(vertices, np.ascontiguousarray(faces), part))
    if not bodies:
        raise ValueError("it holds no surface")
    return bodies


def ply_columns(scene: trimesh.Scene) -> dict[str, NDArray[Any]]:
    """Return the properties of the vertices of a PLY file, (V, C) by name, from trimesh's metadata."""
    raw = (
        item.metadata.get("_ply_raw", {}).get("vertex", {})
        for item in (scene, *scene.geometry.values())
    )
    vertex: dict[str, Any] = next((x for x in raw if "data" in x), {"properties": ()})
    return {
        name: np.asarray(vertex["data"][name]).reshape(vertex["length"], -1)
        for name in vertex["properties"]
    }

"""Reading by trimesh, which gets bytes, and other files only from the same folder."""

from __future__ import annotations

import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh

from igps._arrays import Floats
from igps.mesh.limits import check_unpacked
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, distinct, joined

_RANDOM_END = "_[0-9a-fA-F]{6}"  # of the names that trimesh makes up


class FolderResolver(trimesh.resolvers.Resolver):
    """Access of trimesh to the files in and below one folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()

    def path(self, name: str) -> Path:
        """Return the path of a file; characters of the name may be escaped as in URLs."""
        path = (self._folder / name).resolve()
        if not path.is_file():
            path = (self._folder / unquote(name)).resolve()
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
    """Return a body for each node of a scene that has a geometry; `loading` is passed to trimesh.

    Trimesh makes a node of its own, with a name that ends at random, for each material of a glTF mesh. Here, these are
    parts of the node that is in the file.
    """
    loading = {"file_type": path.suffix.lower().lstrip("."), **loading}
    stream = BytesIO(path.read_bytes() if content is None else content)
    folder = FolderResolver(path.parent)
    scene = trimesh.load_scene(stream, resolver=folder, process=False, **loading)
    nodes = [(node, *scene.graph.get(node)) for node in scene.graph.nodes_geometry]
    n_rows = 0  # of vertices and faces; a geometry may be in many places
    for _, _, name in nodes:
        geometry = scene.geometry[name]
        n_rows += len(geometry.vertices) + len(getattr(geometry, "faces", ()))
    check_unpacked(24 * n_rows, path, options.max_unpacked)
    surfaces: dict[str, list[RawBody]] = {}
    for node, matrix, name in nodes:
        surface = _surface(scene.geometry[name], matrix)
        if surface is not None:
            surfaces.setdefault(_node_in_file(scene, node), []).append(surface)
    if not surfaces:
        raise ValueError("it holds no surface")
    names = distinct(surfaces)
    parts = zip(names, surfaces.values(), strict=True)
    return [replace(joined(own), part=name) for name, own in parts]


def _node_in_file(scene: trimesh.Scene, node: str) -> str:
    """Return the node of the file to which a node of trimesh belongs: its parent, if it is one of its materials."""
    parent = scene.graph.transforms.parents.get(node)
    is_material = parent is not None and re.fullmatch(re.escape(parent) + _RANDOM_END, node)
    return str(parent if is_material else node)


def _surface(geometry: Any, matrix: Floats) -> RawBody | None:
    """Return the surface or the points of a node, placed by its matrix (4, 4); None for lines."""
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    if not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    if isinstance(geometry, trimesh.PointCloud):
        return RawBody(vertices)
    if not isinstance(geometry, trimesh.Trimesh):
        return None
    faces = np.asarray(geometry.faces, dtype=np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:  # the matrix mirrors: turned back
        faces = faces[:, ::-1]
    return RawBody(vertices, np.ascontiguousarray(faces))

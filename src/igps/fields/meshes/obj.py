"""Wavefront OBJ: vertices and polygons as text, in objects or groups; textures, normals and curves are ignored."""

import itertools
import re
from pathlib import Path

import numpy as np

from igps._arrays import Integers
from igps.mesh.formats import Format
from igps.mesh.options import LoadOptions
from igps.mesh.polygons import flat_triangles
from igps.mesh.raw_body import ONLY_LINES, RawBody, distinct, text_of

_TEXTURE_AND_NORMAL = re.compile(r"/\S*")  # indices behind that of the vertex, as in 1/2/3


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the surface of an OBJ file, or its objects; groups count as objects if the file has no objects."""
    coordinates: list[str] = []
    polygons: list[str] = []
    n_before: list[int] = []  # vertices above each polygon: negative indices count back from there
    # Of objects and groups: first polygon, and name
    starts: dict[str, list[tuple[int, str]]] = {"o": [], "g": []}
    has_lines = False
    continued = text_of(path).replace("\\\n\n", " ").replace("\\\n", " ")
    for line in continued.split("\n"):
        word, _, fields = line.lstrip().replace("\t", " ").partition(" ")
        if word == "v":
            coordinates.append(fields)
        elif word == "f":
            polygons.append(fields)
            n_before.append(len(coordinates))
        elif word == "l":
            has_lines = True
        elif word in starts:
            starts[word].append((len(polygons), fields.strip()))
    if not coordinates:
        raise ValueError("no vertex in it")
    # Weights and colours may follow the coordinates
    vertices = np.loadtxt(coordinates, np.float64, comments="#", usecols=(0, 1, 2), ndmin=2)
    if not polygons:
        if has_lines:
            raise ValueError(ONLY_LINES)
        return [RawBody(vertices)]
    corners, n_corners = _corners(polygons, np.array(n_before, dtype=np.int64))
    names, owner = _owners(starts, len(polygons))
    if options.bodies != "objects" or len(names) < 2:
        return [RawBody(vertices, flat_triangles(corners, n_corners, vertices))]
    bodies = []
    for number, name in enumerate(names):
        is_own = owner == number
        own_corners = corners[np.repeat(is_own, n_corners)]
        faces = flat_triangles(own_corners, n_corners[is_own], vertices)
        used, index = np.unique(faces, return_inverse=True)
        if len(used) and (used[0] < 0 or used[-1] >= len(vertices)):
            raise ValueError(f"object {name!r} refers to vertices that are not there")
        bodies.append(RawBody(vertices[used], index.reshape(-1, 3), part=name))
    return bodies


def _corners(polygons: list[str], n_before: Integers) -> tuple[Integers, Integers]:
    """Return the corners of polygons laid end to end, counted from zero, and the number of corners of each polygon."""
    text = "\n".join(polygons)
    if "#" in text:
        text = "\n".join(line.partition("#")[0] for line in polygons)
    rows = [line.split() for line in _TEXTURE_AND_NORMAL.sub("", text).split("\n")]
    n_corners = np.array([len(row) for row in rows], dtype=np.int64)
    corners = np.array([int(word) for row in rows for word in row], dtype=np.int64)
    if (corners == 0).any():
        raise ValueError("a face refers to vertex 0; vertices are counted from 1")
    from_end = np.repeat(n_before, n_corners) + corners
    return np.where(corners > 0, corners - 1, from_end), n_corners


def _owners(
    starts: dict[str, list[tuple[int, str]]], n_polygons: int
) -> tuple[list[str], Integers]:
    """Return the names of objects (or groups) with polygons, and for each polygon the index of its object, (P,)."""
    parts = [(0, ""), *(starts["o"] or starts["g"]), (n_polygons, "")]
    names = []
    lengths = []
    for (first, name), (end, _) in itertools.pairwise(parts):
        if end > first:
            names.append(name or "unnamed")
            lengths.append(end - first)
    if starts["o"]:  # objects of the same name are separate, but a group may continue further down
        names = distinct(names)
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return list(index), np.repeat([index[name] for name in names], lengths)


FORMAT = Format("OBJ", (".obj",), read, bodies=("whole", "objects"))

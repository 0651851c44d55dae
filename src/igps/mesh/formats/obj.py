"""Wavefront OBJ: places and polygons as text, in objects or groups; textures, normals and curves are passed over."""

import re
from pathlib import Path

import numpy as np

from igps._arrays import Integers
from igps.mesh.formats._format import Format, RawBody, distinct, text_of
from igps.mesh.formats._polygons import flat_triangles
from igps.mesh.options import LoadOptions

_BEYOND_PLACE = re.compile(r"/\S*")


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surface of an OBJ file; or its objects, if it has none its groups."""
    places: list[str] = []
    polygons: list[str] = []
    before: list[int] = []  # vertices above each polygon, from which negative indices count
    starts: dict[str, list[tuple[int, str]]] = {"o": [], "g": []}  # polygons above each, and its name
    for line in text_of(path).replace("\\\n\n", " ").replace("\\\n", " ").split("\n"):
        word, _, rest = line.lstrip().replace("\t", " ").partition(" ")
        if word == "v":
            places.append(rest)
        elif word == "f":
            polygons.append(rest)
            before.append(len(places))
        elif word in starts:
            starts[word].append((len(polygons), rest.strip()))
    if not places:
        raise ValueError("no vertex in it")
    # Weights and colours behind the coordinates are passed over
    vertices = np.loadtxt(places, np.float64, comments="#", usecols=(0, 1, 2), ndmin=2)
    if not polygons:
        return [RawBody(vertices)]
    corners, n_corners = _corners(polygons, np.array(before, dtype=np.int64))
    names, owner = _owners(starts, len(polygons)) if options.bodies == "objects" else ([], np.zeros(0))
    if len(names) < 2:
        return [RawBody(vertices, flat_triangles(corners, n_corners, vertices))]
    bodies = []
    for number, name in enumerate(names):
        mine = owner == number
        faces = flat_triangles(corners[np.repeat(mine, n_corners)], n_corners[mine], vertices)
        used, index = np.unique(faces, return_inverse=True)
        if len(used) and (used[0] < 0 or used[-1] >= len(vertices)):
            raise ValueError(f"object {name!r} refers to vertices that are not there")
        bodies.append(RawBody(vertices[used], index.reshape(-1, 3), part=name))
    return bodies


def _corners(polygons: list[str], before: Integers) -> tuple[Integers, Integers]:
    """The corners of polygons laid end to end, counted from zero; and how many each has."""
    text = "\n".join(polygons)
    if "#" in text:
        text = "\n".join(line.partition("#")[0] for line in polygons)
    rows = [line.split() for line in _BEYOND_PLACE.sub("", text).split("\n")]
    n_corners = np.array([len(row) for row in rows], dtype=np.int64)
    corners = np.array([int(word) for row in rows for word in row], dtype=np.int64)
    if (corners == 0).any():
        raise ValueError("a face refers to vertex 0; vertices are counted from 1")
    return np.where(corners > 0, corners - 1, corners + np.repeat(before, n_corners)), n_corners


def _owners(starts: dict[str, list[tuple[int, str]]], n_polygons: int) -> tuple[list[str], Integers]:
    """Names of objects, or else of groups, that have polygons, and the number of each polygon's, (P,)."""
    found = [(0, "unnamed"), *(starts["o"] or starts["g"])]
    ends = [*(first for first, _ in found[1:]), n_polygons]
    ranges = [(name or "unnamed", first, end) for (first, name), end in zip(found, ends, strict=True) if end > first]
    names = [name for name, _, _ in ranges]
    # Objects of one name are several; a group may go on further down.
    names = distinct(names) if starts["o"] else names
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    lengths = [end - first for _, first, end in ranges]
    return list(number), np.repeat([number[name] for name in names], lengths)


FORMAT = Format("OBJ", (".obj",), read, bodies=("whole", "objects"))

"""PLY: vertices and polygons, or points with normals, as text or bytes."""

import re
import struct
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Surface
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.formats._polygons import flat_triangles, of_strip
from igps.mesh.formats._trimesh import objects
from igps.mesh.options import LoadOptions

# Letters of `struct` and of NumPy alike
_KINDS = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_index", "vertex_indices")
_HAS_FACES = re.compile(rb"element\s+(face|tristrips)\s+0*[1-9]")
Polygons = tuple[Floats, list[tuple[int, ...]]]  # vertices (V, 3), and the corners of each
Property = tuple[str, str, str]  # its name; its kind; of a list also the kind of its length, else ""


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    head, end, body = path.read_bytes().partition(b"end_header")
    try:
        polygons = _polygons(head.decode("latin-1"), body.partition(b"\n")[2])
    except (ValueError, KeyError, IndexError, struct.error):  # a broken file, whose fault trimesh tells, or a rare one
        polygons = None
    if polygons is not None:
        return [RawBody(*polygons)]
    # trimesh takes the header for UTF-8, and would split vertices at the seams of textures
    content = head.decode("latin-1").encode("ascii", "replace") + end + body
    found = objects(path, options, content, fix_texture=False)
    if _HAS_FACES.search(head) and not any(len(one.faces) for one in found):  # the points are no cloud
        raise ValueError("it announces faces, of which none can be read; export it as triangles, in text")
    return found


def _polygons(head: str, body: bytes) -> Surface | None:
    """The surface of strips of triangles, or of polygons of several sizes; None where all are triangles."""
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    for words in map(str.split, head.splitlines()):
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            name, kind, *length = words[:0:-1]
            elements[-1][2].append((name, _KINDS[kind], _KINDS[length[0]] if len(length) > 1 else ""))
    if [name for name, _, _ in elements[:2]] not in (["vertex", "face"], ["vertex", "tristrips"]):
        return None
    (_, n_vertices, of_vertex), (kind_of_face, n_faces, of_face) = elements[:2]
    at = next((i for i, (name, _, _) in enumerate(of_face) if name in _CORNERS), -1)
    other = [length for _, _, length in of_vertex + of_face[:at] + of_face[at + 1 :]]
    if any(other) or at < 0 or min(n_vertices, n_faces) < 1:
        return None
    if order is None:
        found = _of_text(body, [name for name, _, _ in of_vertex], n_vertices, n_faces, at)
    else:
        kinds = [(name, order + kind) for name, kind, _ in of_vertex]
        found = _of_bytes(body, np.dtype(kinds), n_vertices, n_faces, of_face, at, order)
    if found is None:
        return None
    vertices, polygons = found
    if kind_of_face == "tristrips":  # -1 ends one within a list
        lists = [np.array(one, dtype=np.int64) for one in polygons]
        parts = [part for one in lists for part in np.split(one, np.flatnonzero(one < 0))]
        return vertices, np.concatenate([of_strip(part[part >= 0]) for part in parts])
    n_corners = np.array([len(one) for one in polygons], dtype=np.int64)
    corners = np.array([corner for one in polygons for corner in one], dtype=np.int64)
    return vertices, flat_triangles(corners, n_corners, vertices)


def _of_text(text: bytes, names: list[str], n_vertices: int, n_faces: int, at: int) -> Polygons | None:
    lines = [line for line in text.splitlines() if line and not line.isspace()]
    places, faces = lines[:n_vertices], lines[n_vertices : n_vertices + n_faces]
    if len(faces) < n_faces:  # trimesh would read the part that is there
        raise EOFError(f"{n_vertices} vertices and {n_faces} faces announced, {len(lines)} lines there")
    if at == 0 and all(line.startswith(b"3 ") for line in faces):
        return None
    rows = [line.split() for line in faces]
    if all(row[at] == b"3" for row in rows):
        return None
    columns = [names.index(axis) for axis in "xyz"]
    vertices = np.loadtxt(places, np.float64, comments=None, usecols=columns, ndmin=2, encoding="latin-1")
    polygons = [tuple(map(int, row[at + 1 : at + 1 + int(row[at])])) for row in rows]
    is_whole = all(len(one) == int(row[at]) for one, row in zip(polygons, rows, strict=True))
    return (vertices, polygons) if is_whole else None


def _of_bytes(
    body: bytes, of_vertex: np.dtype[np.void], n_vertices: int, n_faces: int, of_face: list[Property], at: int,
    order: str,
) -> Polygons | None:  # fmt: skip
    rows = np.frombuffer(body, of_vertex, n_vertices)
    place, polygons = rows.nbytes, list[tuple[int, ...]]()
    of_triangle = [(f"{i}", order + (length or kind)) for i, (_, kind, length) in enumerate(of_face)]
    of_triangle.insert(at + 1, ("corners", f"3{order}{of_face[at][1]}"))
    is_long = len(body) - place >= n_faces * np.dtype(of_triangle).itemsize
    if is_long and (np.frombuffer(body, of_triangle, n_faces, place)[f"{at}"] == 3).all():
        return None
    for _ in range(n_faces):
        for i, (_, kind, length) in enumerate(of_face):
            n = 1
            if length:
                (n,) = struct.unpack_from(order + length, body, place)
                place += struct.calcsize(order + length)
            values = struct.unpack_from(f"{order}{n}{kind}", body, place)
            place += struct.calcsize(f"{order}{n}{kind}")
            if i == at:
                polygons.append(values)
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64), polygons


FORMAT = Format("PLY", (".ply",), read)

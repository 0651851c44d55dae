"""PLY as text or bytes: point clouds and triangles are read by trimesh, polygons of several sizes and strips here."""

import re
import struct
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Surface
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.formats._polygons import flat_triangles, strip_triangles
from igps.mesh.formats._trimesh import objects
from igps.mesh.options import LoadOptions

# Type codes of both `struct` and NumPy
_TYPES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "float32": "f",
    "float64": "d",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_index", "vertex_indices")
_HAS_FACES = re.compile(rb"element\s+(face|tristrips)\s+0*[1-9]")
Polygons = tuple[Floats, list[tuple[int, ...]]]  # vertices (V, 3), and the corners of each polygon
Property = tuple[str, str, str]  # name, type code, and type code of the length of a list, else ""


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    head, end, body = path.read_bytes().partition(b"end_header")
    try:
        polygons = _polygons(head.decode("latin-1"), body.partition(b"\n")[2])
    except (
        ValueError,
        KeyError,
        IndexError,
        struct.error,
    ):  # a rare file, or a broken one: trimesh names the fault
        polygons = None
    if polygons is not None:
        return [RawBody(*polygons)]
    # Trimesh expects a header in UTF-8. Without fix_texture=False, it splits vertices at the seams of textures
    content = head.decode("latin-1").encode("ascii", "replace") + end + body
    bodies = objects(path, options, content, fix_texture=False)
    if _HAS_FACES.search(head) and not any(len(x.faces) for x in bodies):  # not a point cloud
        raise ValueError("it declares faces, but none can be read; export it as triangles, in text")
    return bodies


def _polygons(head: str, body: bytes) -> Surface | None:
    """Read strips of triangles, or polygons of several sizes; return None for files that trimesh can read."""
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    for words in map(str.split, head.splitlines()):
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            name, kind, *length = words[:0:-1]
            elements[-1][2].append(
                (name, _TYPES[kind], _TYPES[length[0]] if len(length) > 1 else "")
            )
    if [name for name, _, _ in elements[:2]] not in (["vertex", "face"], ["vertex", "tristrips"]):
        return None
    (_, n_vertices, vertex_properties), (element, n_faces, face_properties) = elements[:2]
    at = next((i for i, (name, _, _) in enumerate(face_properties) if name in _CORNERS), -1)
    others = vertex_properties + face_properties[:at] + face_properties[at + 1 :]
    if any(length for _, _, length in others) or at < 0 or min(n_vertices, n_faces) < 1:
        return None
    if order is None:
        content = _read_text(
            body, [name for name, _, _ in vertex_properties], n_vertices, n_faces, at
        )
    else:
        vertex_type = np.dtype([(name, order + kind) for name, kind, _ in vertex_properties])
        content = _read_binary(body, vertex_type, n_vertices, n_faces, face_properties, at, order)
    if content is None:
        return None
    vertices, polygons = content
    if element == "tristrips":  # -1 separates strips within a list
        lists = [np.array(polygon, dtype=np.int64) for polygon in polygons]
        strips = [strip for row in lists for strip in np.split(row, np.flatnonzero(row < 0))]
        return vertices, np.concatenate([strip_triangles(strip[strip >= 0]) for strip in strips])
    n_corners = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    corners = np.array([corner for polygon in polygons for corner in polygon], dtype=np.int64)
    return vertices, flat_triangles(corners, n_corners, vertices)


def _read_text(
    text: bytes, names: list[str], n_vertices: int, n_faces: int, at: int
) -> Polygons | None:
    """Read polygons as text; `at` is the index of the corners among the properties of a face."""
    lines = [line for line in text.splitlines() if line and not line.isspace()]
    coordinates, faces = lines[:n_vertices], lines[n_vertices : n_vertices + n_faces]
    if len(faces) < n_faces:  # trimesh would silently read a part
        raise EOFError(
            f"expected {n_vertices} vertices and {n_faces} faces, got {len(lines)} lines"
        )
    if at == 0 and all(line.startswith(b"3 ") for line in faces):
        return None
    rows = [line.split() for line in faces]
    if all(row[at] == b"3" for row in rows):
        return None
    columns = [names.index(axis) for axis in "xyz"]
    vertices = np.loadtxt(
        coordinates, np.float64, comments=None, usecols=columns, ndmin=2, encoding="latin-1"
    )
    polygons = [tuple(map(int, row[at + 1 : at + 1 + int(row[at])])) for row in rows]
    is_complete = all(
        len(polygon) == int(row[at]) for polygon, row in zip(polygons, rows, strict=True)
    )
    return (vertices, polygons) if is_complete else None


def _read_binary(
    body: bytes,
    vertex_type: np.dtype[np.void],
    n_vertices: int,
    n_faces: int,
    face_properties: list[Property],
    at: int,
    order: str,
) -> Polygons | None:
    rows = np.frombuffer(body, vertex_type, n_vertices)
    offset, polygons = rows.nbytes, list[tuple[int, ...]]()
    triangle_type = [
        (f"{i}", order + (length or kind)) for i, (_, kind, length) in enumerate(face_properties)
    ]
    triangle_type.insert(at + 1, ("corners", f"3{order}{face_properties[at][1]}"))
    is_long_enough = len(body) - offset >= n_faces * np.dtype(triangle_type).itemsize
    if is_long_enough and (np.frombuffer(body, triangle_type, n_faces, offset)[f"{at}"] == 3).all():
        return None
    for _ in range(n_faces):
        for i, (_, kind, length) in enumerate(face_properties):
            n = 1
            if length:
                (n,) = struct.unpack_from(order + length, body, offset)
                offset += struct.calcsize(order + length)
            values = struct.unpack_from(f"{order}{n}{kind}", body, offset)
            offset += struct.calcsize(f"{order}{n}{kind}")
            if i == at:
                polygons.append(values)
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64), polygons


FORMAT = Format("PLY", (".ply",), read)

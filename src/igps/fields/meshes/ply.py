"""PLY as text or bytes: point clouds and triangles are read by trimesh, polygons of several sizes and strips here."""

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Surface
from igps.mesh.formats import Format
from igps.mesh.options import LoadOptions
from igps.mesh.polygons import flat_triangles, strip_triangles
from igps.mesh.raw_body import RawBody

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


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # type code
    length_kind: str = ""  # type code of the length of a list; "" for a single value


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def corners_at(self) -> int:
        """Index of the list of corners among the properties, -1 if there is none."""
        names = [known.name for known in self.properties]
        found = [at for at, name in enumerate(names) if name in _CORNERS]
        return found[0] if found else -1


@dataclass
class _Header:
    order: str = ""  # of bytes, "<" or ">"; "" for text
    elements: list[_Element] = field(default_factory=list)

    @classmethod
    def parsed(cls, text: str) -> "_Header":
        header = cls()
        for line in text.splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                header.order = _ORDERS.get(words[1], "")
            elif words[:1] == ["element"]:
                header.elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                of_list = _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
                header.elements[-1].properties.append(of_list)
            elif words[:1] == ["property"]:
                single = _Property(words[2], _TYPES[words[1]])
                header.elements[-1].properties.append(single)
        return header


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    head, end, body = path.read_bytes().partition(b"end_header")
    try:
        surface = _surface(head.decode("latin-1"), body.partition(b"\n")[2])
    except (ValueError, KeyError, IndexError, struct.error):
        surface = None  # a rare file, or a broken one: trimesh names the fault
    if surface is not None:
        return [RawBody(*surface)]
    from igps.fields.meshes._trimesh import objects

    # Trimesh expects a header in UTF-8. Without fix_texture=False, it splits vertices at the seams of textures
    content = head.decode("latin-1").encode("ascii", "replace") + end + body
    bodies = objects(path, options, content, fix_texture=False)
    if _HAS_FACES.search(head) and not any(len(x.faces) for x in bodies):  # not a point cloud
        raise ValueError("it declares faces, but none can be read; export it as triangles, in text")
    return bodies


def _surface(head: str, body: bytes) -> Surface | None:
    """Read strips of triangles, or polygons of several sizes; return None for files that trimesh can read."""
    header = _Header.parsed(head)
    if [element.name for element in header.elements[:2]] not in (
        ["vertex", "face"],
        ["vertex", "tristrips"],
    ):
        return None
    points, faces = header.elements[:2]
    has_lists = any(known.length_kind for known in points.properties)
    if has_lists or faces.corners_at < 0 or min(points.count, faces.count) < 1:
        return None
    if header.order:
        if _are_triangles(body, points, faces, header.order):
            return None
        vertices, polygons = _read_binary(body, points, faces, header.order)
    else:
        lines = [line for line in body.splitlines() if line and not line.isspace()]
        n_lines = points.count + faces.count
        if len(lines) < n_lines:  # trimesh would silently read a part
            raise EOFError(f"expected {n_lines} vertices and faces, got {len(lines)} lines")
        rows = lines[points.count : n_lines]
        if _are_triangle_lines(rows, faces):
            return None
        vertices = _text_vertices(lines[: points.count], points)
        polygons = [_text_polygon(row.split(), faces) for row in rows]
    n_corners = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    corners = np.array([corner for polygon in polygons for corner in polygon], dtype=np.int64)
    if faces.name == "tristrips":  # -1 separates strips within a list
        lists = np.split(corners, np.cumsum(n_corners)[:-1])
        strips = [strip for row in lists for strip in np.split(row, np.flatnonzero(row < 0))]
        return vertices, np.concatenate([strip_triangles(strip[strip >= 0]) for strip in strips])
    return vertices, flat_triangles(corners, n_corners, vertices)


def _are_triangle_lines(rows: list[bytes], faces: _Element) -> bool:
    """Return whether all polygons are triangles, which trimesh reads many times faster."""
    return not _has_other_lists(faces) and all(
        row.split(None, faces.corners_at + 1)[faces.corners_at] == b"3" for row in rows
    )


def _are_triangles(body: bytes, points: _Element, faces: _Element, order: str) -> bool:
    """Return whether all polygons are triangles, which trimesh reads many times faster."""
    if _has_other_lists(faces):
        return False
    fields = []
    for at, known in enumerate(faces.properties):
        fields.append((f"{at}", order + (known.length_kind or known.kind)))
        if at == faces.corners_at:
            fields.append(("corners", f"3{order}{known.kind}"))
    row_type = np.dtype(fields)
    start = points.count * _vertex_type(points, order).itemsize
    if len(body) - start < faces.count * row_type.itemsize:
        return False
    rows = np.frombuffer(body, row_type, faces.count, start)
    return bool((rows[f"{faces.corners_at}"] == 3).all())


def _has_other_lists(faces: _Element) -> bool:
    """Return whether faces have lists beside that of the corners, such as texture coordinates."""
    others = [known for known in faces.properties if known.name not in _CORNERS]
    return any(known.length_kind for known in others)


def _text_vertices(lines: list[bytes], points: _Element) -> Floats:
    names = [known.name for known in points.properties]
    columns = [names.index(axis) for axis in "xyz"]
    return np.loadtxt(
        lines, np.float64, comments=None, usecols=columns, ndmin=2, encoding="latin-1"
    )


def _text_polygon(words: list[bytes], faces: _Element) -> list[int]:
    """Return the corners of a polygon from the words of its line."""
    start = 0
    for known in faces.properties[: faces.corners_at]:
        start += 1 + int(words[start]) if known.length_kind else 1
    end = start + 1 + int(words[start])
    if end > len(words):
        raise ValueError(f"expected {end} numbers for a face, got {len(words)}")
    return [int(word) for word in words[start + 1 : end]]


def _vertex_type(points: _Element, order: str) -> np.dtype[np.void]:
    return np.dtype([(known.name, order + known.kind) for known in points.properties])


def _read_binary(
    body: bytes, points: _Element, faces: _Element, order: str
) -> tuple[Floats, list[list[int]]]:
    """Return the vertices (V, 3), and the corners of each polygon."""
    rows = np.frombuffer(body, _vertex_type(points, order), points.count)
    vertices = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    offset = rows.nbytes
    polygons = []
    for _ in range(faces.count):
        for at, known in enumerate(faces.properties):
            n_values = 1
            if known.length_kind:
                (n_values,) = struct.unpack_from(order + known.length_kind, body, offset)
                offset += struct.calcsize(order + known.length_kind)
            layout = f"{order}{n_values}{known.kind}"
            if at == faces.corners_at:
                polygons.append(list(struct.unpack_from(layout, body, offset)))
            offset += struct.calcsize(layout)
    return vertices, polygons


FORMAT = Format("PLY", (".ply",), read)

"""PLY: vertices with properties, polygons and strips of triangles, as text or bytes.

Trimesh is not used: it reads no polygons of several sizes, and no strips.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
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
_TEXT = "="  # in place of an order of bytes
_ORDERS = {"ascii": _TEXT, "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_index", "vertex_indices")

Numbers = tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Column:
    """A property of all rows of an element: its numbers laid end to end, and how many each row has."""

    numbers: NDArray[np.generic]
    lengths: Integers  # 1 for a single value


Columns = Mapping[str, Column]


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # order of bytes and type code of its numbers
    length_kind: str  # the same of the length of a list; "" for a single value
    type: str  # of its numbers in a column


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def elements(path: Path) -> dict[str, Columns]:
    """Return the columns of each element; a ValueError if the file is longer or shorter than its header says."""
    head, _, content = path.read_bytes().partition(b"end_header")
    content = content.partition(b"\n")[2]
    order, declared = _header(head.decode("latin-1"))
    if order == _TEXT:
        content = np.fromstring(content, sep=" ").tobytes()
    found: dict[str, Columns] = {}
    at = 0
    for element in declared:
        fault = f"expected {element.count} rows of {element.name}, got fewer"
        if not 0 <= element.count <= len(content):  # a row takes at least a byte
            raise ValueError(fault)
        try:
            found[element.name], at = _columns(content, at, element)
        except struct.error as error:
            raise ValueError(fault) from error
    if at != len(content):
        raise ValueError(f"expected {at} bytes of numbers, got {len(content)}")
    return found


def _header(text: str) -> tuple[str, list[_Element]]:
    """Return the order of bytes, and the elements."""
    first, *lines = text.splitlines()
    if first.strip() != "ply":
        raise ValueError("its first line is not ply")
    order = ""
    declared: list[_Element] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["format"]:
            order = _ORDERS[words[1]]
        elif words[:1] == ["element"]:
            declared.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"]:
            declared[-1].properties.append(_property(words, order))
    return order, declared


def _property(words: list[str], order: str) -> _Property:
    """Return the property of a line of the header. Text is stored as if it were bytes in double precision."""
    *length, word, name = words[1:]
    code = _TYPES[word]
    stored = "d" if order == _TEXT else code
    length_kind = ""
    if length:  # the word "list", and the type of the length
        length_kind = order + ("d" if order == _TEXT else _TYPES[length[1]])
    return _Property(name, order + stored, length_kind, "f" if code == "f" else stored)


def _columns(content: bytes, at: int, element: _Element) -> tuple[Columns, int]:
    """Return the columns of an element whose rows begin at `at`, and where they end."""
    if not element.count:
        return {}, at
    first, behind_first = _row(content, at, element)
    end = at + element.count * (behind_first - at)
    if end <= len(content):
        rows = np.frombuffer(content, _row_type(element, first), element.count, at)
        if _has_even_lists(rows, element, first):
            return _even_columns(rows, element), end
    parts: list[list[Numbers]] = [[] for _ in element.properties]
    for _ in range(element.count):
        row, at = _row(content, at, element)
        for own, numbers in zip(parts, row, strict=True):
            own.append(numbers)
    columns = {}
    for known, own in zip(element.properties, parts, strict=True):
        laid_out = np.array(list(chain.from_iterable(own)), known.type)
        columns[known.name] = Column(laid_out, np.array([len(numbers) for numbers in own]))
    return columns, at


def _row(content: bytes, at: int, element: _Element) -> tuple[list[Numbers], int]:
    """Return the numbers of each property in the row that begins at `at`, and where the row ends."""
    row = []
    for known in element.properties:
        n = 1
        if known.length_kind:
            n = int(struct.unpack_from(known.length_kind, content, at)[0])
            at += struct.calcsize(known.length_kind)
        layout = f"{known.kind[0]}{n}{known.kind[1]}"
        row.append(struct.unpack_from(layout, content, at))
        at += struct.calcsize(layout)
    return row, at


def _row_type(element: _Element, first: list[Numbers]) -> np.dtype[np.void]:
    """Return the type of rows whose lists are as long as those of the first row."""
    fields: list[Any] = []
    for known, numbers in zip(element.properties, first, strict=True):
        if known.length_kind:
            fields.append((_length_of(known), known.length_kind))
        fields.append((known.name, known.kind, (len(numbers),)))
    return np.dtype(fields)


def _length_of(known: _Property) -> str:
    return f"length of {known.name}"


def _has_even_lists(rows: NDArray[Any], element: _Element, first: list[Numbers]) -> bool:
    """Return whether the lists of all rows are as long as those of the first row."""
    for known, numbers in zip(element.properties, first, strict=True):
        if known.length_kind and (rows[_length_of(known)] != len(numbers)).any():
            return False
    return True


def _even_columns(rows: NDArray[Any], element: _Element) -> Columns:
    columns = {}
    for known in element.properties:
        numbers = rows[known.name].astype(known.type)
        lengths = np.full(len(rows), numbers.shape[1])
        columns[known.name] = Column(numbers.ravel(), lengths)
    return columns


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    found = elements(path)
    points = found["vertex"]
    vertices = _vectors(points, ("x", "y", "z"))
    faces = [np.zeros((0, 3), dtype=np.int64)]
    for name in ("face", "tristrips"):
        rows = found.get(name)
        if not rows:
            continue
        lists = [rows[known] for known in _CORNERS if known in rows]
        if not lists:
            raise ValueError("it declares faces, and no corners of them; export it as triangles")
        corners = lists[0].numbers.astype(np.int64)
        if (corners != lists[0].numbers).any():
            raise ValueError("a corner of a face is no whole number")
        if name == "face":
            faces.append(flat_triangles(corners, lists[0].lengths, vertices))
        else:
            faces += _strips(corners, lists[0].lengths)
    triangles = np.concatenate(faces)
    normals = None
    if not len(triangles) and {"nx", "ny", "nz"} <= points.keys():
        normals = _vectors(points, ("nx", "ny", "nz"))
    return [RawBody(vertices, triangles, normals=normals)]


def _vectors(points: Columns, names: Sequence[str]) -> Floats:
    return np.stack([points[name].numbers for name in names], axis=1).astype(np.float64)


def _strips(corners: Integers, lengths: Integers) -> list[Integers]:
    """Return the triangles of each strip; -1 separates strips within a list."""
    triangles = []
    for row in np.split(corners, np.cumsum(lengths)[:-1]):
        for strip in np.split(row, np.flatnonzero(row < 0)):
            triangles.append(strip_triangles(strip[strip >= 0]))
    return triangles


FORMAT = Format("PLY", (".ply",), read)

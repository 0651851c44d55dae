"""VTK: legacy files of polygons or cells (.vtk), and XML files (.vtp, .vtu), as text or bytes.

No library is used: meshio does not read PolyData, and VTK itself takes a hundred megabytes and ends the process if a
header declares too large a size.
"""

import base64
import re
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps.fields.meshes import _vtk_cells, _xml
from igps.mesh.formats import Format
from igps.mesh.limits import check_unpacked
from igps.mesh.options import LoadOptions
from igps.mesh.polygons import corners_of_rows
from igps.mesh.raw_body import ONLY_LINES, RawBody

_LEGACY_TYPES = {  # VTK writes vtkIdType as int
    "float": "f4",
    "double": "f8",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "vtktypeint64": "i8",
    "vtktypeint32": "i4",
    "short": "i2",
    "unsigned_short": "u2",
    "char": "i1",
    "unsigned_char": "u1",
    "vtkidtype": "i4",
}
_XML_TYPES = {
    "Float32": "f4",
    "Float64": "f8",
    "Int8": "i1",
    "Int16": "i2",
    "Int32": "i4",
    "Int64": "i8",
    "UInt8": "u1",
    "UInt16": "u2",
    "UInt32": "u4",
    "UInt64": "u8",
}
_BLANK_LINE = re.compile(rb"\n\r?\n")
# Types of cells by the sections of legacy and of XML files.
_LEGACY_CELLS = {
    "POLYGONS": _vtk_cells.POLYGON,
    "TRIANGLE_STRIPS": _vtk_cells.STRIP,
    "LINES": _vtk_cells.POLY_LINE,
}
_XML_CELLS = {
    "Polys": _vtk_cells.POLYGON,
    "Strips": _vtk_cells.STRIP,
    "Lines": _vtk_cells.POLY_LINE,
}
_COMPRESSORS = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}
# Corners laid end to end; corner counts of cells; types of cells
Cells = tuple[Integers, Integers, Integers]


class _Legacy:
    """A legacy file, read from start to end."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0
        header = self.line()
        self.line()  # the title
        kind = self.line().upper()
        if not header.lower().startswith("# vtk datafile") or kind not in ("ASCII", "BINARY"):
            raise ValueError("not a legacy file of VTK")
        self._is_text = kind == "ASCII"

    def line(self) -> str:
        """Return the next line that is not blank; "" at the end."""
        while self._at < len(self._content):
            end = self._content.find(b"\n", self._at)
            end = len(self._content) if end < 0 else end
            text = self._content[self._at : end].decode("latin-1").strip()
            self._at = end + 1
            if text == "METADATA":  # ends at a blank line
                blank = _BLANK_LINE.search(self._content, self._at)
                self._at = len(self._content) if blank is None else blank.start()
            elif text:
                return text
        return ""

    def numbers(self, n: int, type_name: str) -> NDArray[np.generic]:
        kind = np.dtype(_LEGACY_TYPES[type_name.lower()])
        n_left = len(self._content) - self._at
        least_bytes = 2 if self._is_text else kind.itemsize  # of a number
        if not 0 <= n <= n_left // least_bytes + 1:
            raise ValueError(f"expected {n} numbers, got {n_left} bytes")
        if not self._is_text:
            values = np.frombuffer(self._content, kind.newbyteorder(">"), n, self._at)
            self._at += values.nbytes
            return values
        words = self._content[self._at :].split(None, n)
        remainder = words.pop() if len(words) > n else b""
        if len(words) != n:
            raise ValueError(f"expected {n} numbers, got {len(words)}")
        self._at = len(self._content) - len(remainder)
        return np.array(words, dtype=kind)

    def cells(self, n: int, size: int) -> tuple[Integers, Integers]:
        """Read the corners of n cells, laid end to end, and their counts: two arrays, or rows before VTK 5."""
        before = self._at
        words = self.line().split()
        if words[:1] == ["OFFSETS"]:
            offsets = self.numbers(n, words[1]).astype(np.int64)
            kind = self.line().split()[1]
            return self.numbers(size, kind).astype(np.int64), np.diff(offsets)
        self._at = before
        corners, n_corners = corners_of_rows(self.numbers(size, "int").astype(np.int64))
        if len(n_corners) != n:
            raise ValueError("the numbers of corners do not add up")
        return corners, n_corners

    def geometry(self) -> tuple[Floats, list[Cells], str]:
        """Read points and cells; return also the first line behind them."""
        vertices = np.zeros((0, 3))
        cells: list[Cells] = []
        while True:
            words = self.line().split()
            word = words[0].upper() if words else ""
            if word in ("", "POINT_DATA", "CELL_DATA"):
                return vertices, cells, " ".join(words).upper()
            if word == "DATASET":
                if words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
                    raise ValueError(f"expected POLYDATA or UNSTRUCTURED_GRID, got {words[1]}")
            elif word == "POINTS":
                coordinates = self.numbers(3 * int(words[1]), words[2])
                vertices = coordinates.astype(np.float64).reshape(-1, 3)
            elif word in ("POLYGONS", "TRIANGLE_STRIPS", "CELLS", "VERTICES", "LINES"):
                corners, n_corners = self.cells(int(words[1]), int(words[2]))
                kinds = np.full(len(n_corners), _LEGACY_CELLS.get(word, 0))
                cells.append((corners, n_corners, kinds))
            elif word == "CELL_TYPES" and cells:
                corners, n_corners, _ = cells[-1]
                kinds = self.numbers(int(words[1]), "int").astype(np.int64)
                cells[-1] = (corners, n_corners, kinds)
            elif word == "FIELD":
                for _ in range(int(words[2])):
                    self._field_array()
            else:  # skipped cells would leave a cloud of points
                raise ValueError(f"expected a section of points or cells, got {word[:40]!r}")

    def arrays(self, heading: str, n_points: int) -> dict[str, NDArray[np.generic]]:
        """Read the arrays at points by name; `heading` is the line before."""
        arrays: dict[str, NDArray[np.generic]] = {}
        is_of_points = heading.startswith("POINT_DATA")
        n = n_points
        while words := self.line().split():
            word = words[0].upper()
            if word in ("POINT_DATA", "CELL_DATA"):
                is_of_points = word == "POINT_DATA"
                n = int(words[1])
                continue
            if word == "FIELD":
                found = [self._field_array() for _ in range(int(words[2]))]
            elif word in ("VECTORS", "NORMALS"):
                found = [(words[1], self._rows(n, 3, words[2]))]
            elif word == "SCALARS":
                width = int(words[3]) if len(words) > 3 else 1
                self._skip_lookup_table()
                found = [(words[1], self._rows(n, width, words[2]))]
            else:
                continue
            for name, values in found:
                if is_of_points and len(values) == n_points:
                    arrays[name] = _squeezed(values)
        return arrays

    def _field_array(self) -> tuple[str, NDArray[np.generic]]:
        name, width, length, kind = self.line().split()
        return name, self._rows(int(length), int(width), kind)

    def _rows(self, length: int, width: int, kind: str) -> NDArray[np.generic]:
        return self.numbers(width * length, kind).reshape(length, width)

    def _skip_lookup_table(self) -> None:
        before = self._at
        if not self.line().upper().startswith("LOOKUP_TABLE"):
            self._at = before


def read_legacy(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    vertices, cells, _ = _Legacy(path.read_bytes()).geometry()
    return [_body(vertices, cells)]


def point_values(path: Path, options: LoadOptions) -> dict[str, NDArray[np.generic]]:
    """Read the arrays (V,) or (V, C) at the points of a VTK file of one piece, by name."""
    if path.suffix.lower() == ".vtk":
        legacy = _Legacy(path.read_bytes())
        vertices, _, heading = legacy.geometry()
        return legacy.arrays(heading, len(vertices))
    file = _Xml(path, options)
    pieces = list(file.root.iter("Piece"))
    if len(pieces) != 1:
        raise ValueError(f"expected one piece, got {len(pieces)}")
    vertices, _ = file.geometry(pieces[0])
    arrays: dict[str, NDArray[np.generic]] = {}
    for element in pieces[0].findall("PointData/DataArray"):
        values = file.array(element).reshape(len(vertices), -1)
        arrays[element.get("Name") or f"array {len(arrays) + 1}"] = _squeezed(values)
    return arrays


def _squeezed(values: NDArray[np.generic]) -> NDArray[np.generic]:
    return values[:, 0] if values.shape[1] == 1 else values


def read_xml(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the surfaces of an XML file of polygons or cells; each piece is a body."""
    file = _Xml(path, options)
    pieces = list(file.root.iter("Piece"))
    bodies = []
    for number, piece in enumerate(pieces, 1):
        vertices, cells = file.geometry(piece)
        name = f"piece {number}" if len(pieces) > 1 else None
        bodies.append(_body(vertices, cells, name))
    return bodies


class _Xml:
    """An XML file, to which raw bytes may be appended."""

    def __init__(self, path: Path, options: LoadOptions) -> None:
        content = path.read_bytes()
        self._path = path
        self._options = options
        self._appended = b""
        self._n_unpacked = -len(content)  # bytes of all arrays beyond the size of the file
        start = content.find(b"<AppendedData")
        self._is_raw = start >= 0 and b'"raw"' in content[start : content.find(b">", start)]
        if start >= 0:
            begin = content.find(b"_", content.find(b">", start)) + 1
            self._appended = content[begin : content.rfind(b"</AppendedData>")]
            content = content[:start] + b"</VTKFile>"
        self.root = _xml.parse(content)
        self._order = _xml.byte_order(self.root.get("byte_order", "LittleEndian"))
        n_bytes = 8 if self.root.get("header_type") == "UInt64" else 4
        self._header = np.dtype(f"{self._order}u{n_bytes}")
        name = self.root.get("compressor")
        if name is not None and name not in _COMPRESSORS:
            raise ValueError(
                f"expected compression by zlib, LZMA or none, got {name}; export it anew"
            )
        self._compressor = None if name is None else _COMPRESSORS[name]

    def geometry(self, piece: Element) -> tuple[Floats, list[Cells]]:
        points = piece.find("Points/DataArray")
        if points is None:
            raise ValueError("no points in it")
        vertices = self.array(points).astype(np.float64).reshape(-1, 3)
        _check_declared(piece, "Points", len(vertices))
        cells: list[Cells] = []
        for group in (*_XML_CELLS, "Cells"):
            arrays = {}
            for element in piece.findall(f"{group}/DataArray"):
                arrays[element.get("Name")] = self.array(element)
            _check_declared(piece, group, len(arrays.get("offsets", ())))
            if len(arrays) < 2:
                continue
            corners = arrays["connectivity"].astype(np.int64)
            ends = arrays["offsets"].astype(np.int64)
            n_corners = np.diff(ends, prepend=np.int64(0))
            if group == "Cells":
                kinds = arrays["types"].astype(np.int64)
            else:
                kinds = np.full(len(n_corners), _XML_CELLS[group], dtype=np.int64)
            cells.append((corners, n_corners, kinds))
        return vertices, cells

    def array(self, element: Element) -> NDArray[np.generic]:
        kind = np.dtype(_XML_TYPES[element.get("type", "")]).newbyteorder(self._order)
        encoding = element.get("format")
        text = element.text or ""
        if encoding == "ascii":
            values = _xml.from_text(text, kind)
        elif encoding == "appended":
            start = int(element.get("offset", "0"))
            values = np.frombuffer(self._decode(self._appended[start:], self._is_raw), kind)
        else:
            content = "".join(text.split()).encode()
            values = np.frombuffer(self._decode(content, is_raw=False), kind)
        # A sum, as thousands of arrays may refer to the same bytes
        self._n_unpacked += values.nbytes
        check_unpacked(self._n_unpacked, self._path, self._options.max_unpacked)
        return values

    def _decode(self, content: bytes, is_raw: bool) -> bytes:
        """Return the bytes of an array, whose header states their number or the sizes of compressed blocks."""
        size = self._header.itemsize
        (n,) = np.frombuffer(_first(size, content, is_raw), self._header).tolist()
        if self._compressor is None:
            return _first(size + n, content, is_raw)[size:]
        header = _first((3 + n) * size, content, is_raw)
        _, n_bytes, n_last, *packed_sizes = np.frombuffer(header, self._header).tolist()
        check_unpacked(n * n_bytes, self._path, self._options.max_unpacked)
        start = len(header) if is_raw else _n_letters(len(header))
        packed = _first(sum(packed_sizes), content[start:], is_raw)
        blocks = []
        at = 0
        for number, n_packed in enumerate(packed_sizes):
            n_unpacked = n_last if number == n - 1 and n_last else n_bytes
            blocks.append(_xml.inflated(packed[at : at + n_packed], n_unpacked, self._compressor))
            at += n_packed
        return b"".join(blocks)


def _check_declared(piece: Element, group: str, n: int) -> None:
    """Raise a ValueError unless a piece has as many points or cells as it declares: without cells it is a cloud."""
    n_declared = int(piece.get(f"NumberOf{group}", n))
    if n_declared != n:
        raise ValueError(f"{n_declared} {group.lower()} are declared, {n} are there")


def _first(n: int, content: bytes, is_raw: bool) -> bytes:
    """Decode the first n bytes of content that is raw or in base64."""
    decoded = content[:n] if is_raw else base64.b64decode(content[: _n_letters(n)])[:n]
    if len(decoded) < n:
        raise ValueError(f"expected an array of {n} bytes, got {len(decoded)}")
    return decoded


def _n_letters(n_bytes: int) -> int:
    return 4 * -(-n_bytes // 3)  # in base64


def _body(vertices: Floats, cells: list[Cells], part: str | None = None) -> RawBody:
    """Make a body of the surface of cells; a ValueError if the counts do not add up."""
    faces = [np.zeros((0, 3), dtype=np.int64)]
    has_lines = False
    for corners, n_corners, kinds in cells:
        if len(kinds) != len(n_corners) or (n_corners < 0).any() or n_corners.sum() != len(corners):
            raise ValueError("the numbers of cells and corners do not agree")
        faces.append(_vtk_cells.surface(corners, n_corners, kinds, vertices))
        has_lines |= bool(np.isin(kinds, _vtk_cells.LINES).any())
    triangles = np.concatenate(faces)
    if has_lines and not len(triangles):
        raise ValueError(ONLY_LINES)
    return RawBody(vertices, triangles, part)


LEGACY = Format("VTK", (".vtk",), read_legacy)
XML = Format("VTK XML", (".vtp", ".vtu"), read_xml, bodies=("whole", "objects"))

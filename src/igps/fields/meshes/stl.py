"""STL: the corners of triangles, as text or bytes. Equal corners are merged, as the format has no shared vertices."""

import codecs
import re
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Surface
from igps.mesh.formats import Format
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_HEADER = 84  # bytes, with the number of triangles at the end
_VERTEX = re.compile(rb"vertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)
_NAME = re.compile(rb"^[ \t]*(end)?solid\b[^\r\n]*[\r\n]", re.MULTILINE | re.IGNORECASE)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    content = path.read_bytes()
    n_declared = int.from_bytes(content[80:_HEADER], "little")
    n_needed = _HEADER + _TRIANGLE.itemsize * n_declared
    # The letters of a text, taken for a number of triangles, would need 27 GB.
    is_binary = n_declared > 0 and n_needed <= len(content)
    corners = np.zeros((0, 3)) if is_binary else _read_text(content)
    notes: tuple[str, ...] = ()
    if not len(corners):
        corners, notes = _read_binary(content, n_declared)
    if not len(corners):
        raise ValueError("no triangle in it")
    return [RawBody(*merged(corners), notes=notes)]


def _read_text(content: bytes) -> Floats:
    """Return the corners of triangles in text (3F, 3), none if there are none. The name of a solid is any text."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        content = content.decode("utf-16", "replace").encode()
    found = _VERTEX.findall(_NAME.sub(b"", content))
    if not found and b"facet" in content.lower():  # all in one line
        found = _VERTEX.findall(content)
    corners = np.array(b"\n".join(found).split(), dtype=np.float64)
    if len(corners) % 9:
        raise ValueError(
            f"{len(found)} vertices do not make whole triangles; the file is cut short"
        )
    return corners.reshape(-1, 3)


def _read_binary(content: bytes, n_declared: int) -> tuple[Floats, tuple[str, ...]]:
    """Read the triangles of the file, even if their number differs from that in the header."""
    n_complete = max(len(content) - _HEADER, 0) // _TRIANGLE.itemsize
    n = min(n_complete, n_declared) or n_complete
    notes: tuple[str, ...] = ()
    if n != n_declared:
        notes = (f"the header declares {n_declared} triangles: {n} were read",)
    rows = np.frombuffer(content, _TRIANGLE, n, _HEADER) if n else np.zeros(0, _TRIANGLE)
    corners = rows["corners"].reshape(-1, 3)
    return corners.astype(np.float64), notes


def merged(corners: Floats) -> Surface:
    """Merge equal corners (3F, 3) into vertices (V, 3), in order of their first use; return them and faces (F, 3)."""
    corners = corners + 0.0  # turns -0 into 0
    _, first, index = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    vertices = corners[np.sort(first)]
    rank = np.argsort(np.argsort(first))
    return vertices, rank[index.ravel()].reshape(-1, 3)


FORMAT = Format("STL", (".stl", ".stl_ascii"), read)

"""STL: the corners of triangles, as text or bytes. Corners in one place are one vertex: the format has no others."""

import re
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Surface
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.options import LoadOptions

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_HEADER = 84
_VERTEX = re.compile(rb"vertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    content = path.read_bytes()
    announced = int.from_bytes(content[80:_HEADER], "little")
    exact = len(content) == _HEADER + _TRIANGLE.itemsize * announced
    is_text = not exact and content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower()
    corners, notes = _text(content) if is_text else _binary(content, announced)
    if not len(corners):
        raise ValueError("no triangle in it")
    return [RawBody(*merged(corners), notes=notes)]


def _text(content: bytes) -> tuple[Floats, tuple[str, ...]]:
    corners = np.array(b"\n".join(_VERTEX.findall(content)).split(), dtype=np.float64)
    if len(corners) % 9:
        raise ValueError(f"{len(corners) // 3} vertices are no triangles; the file is cut short")
    return corners.reshape(-1, 3), ()


def _binary(content: bytes, announced: int) -> tuple[Floats, tuple[str, ...]]:
    """The triangles that are there, whatever number the header announces."""
    there = max(len(content) - _HEADER, 0) // _TRIANGLE.itemsize
    n = min(there, announced) or there
    notes = () if n == announced else (f"the header announces {announced} triangles: the {n} that are there were read",)
    rows = np.frombuffer(content, _TRIANGLE, n, _HEADER) if n else np.zeros(0, _TRIANGLE)
    return rows["corners"].reshape(-1, 3).astype(np.float64), notes


def merged(corners: Floats) -> Surface:
    """The places (V, 3) of corners (3F, 3), in the order in which they first come, and the triangles (F, 3)."""
    corners = corners + 0.0  # -0 is 0
    _, first, place = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return corners[np.sort(first)], rank[place.ravel()].reshape(-1, 3)


FORMAT = Format("STL", (".stl", ".stl_ascii"), read)

"""STL: the corners of triangles, as text or bytes. Equal corners are merged, as the format has no shared vertices."""

import re
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Surface
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.options import LoadOptions

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_HEADER = 84  # bytes, with the number of triangles at the end
_VERTEX = re.compile(rb"vertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    content = path.read_bytes()
    n_declared = int.from_bytes(content[80:_HEADER], "little")
    is_exact = len(content) == _HEADER + _TRIANGLE.itemsize * n_declared
    is_text = (
        not is_exact
        and content.lstrip()[:5].lower() == b"solid"
        and b"facet" in content[:4096].lower()
    )
    corners, notes = _read_text(content) if is_text else _read_binary(content, n_declared)
    if not len(corners):
        raise ValueError("no triangle in it")
    return [RawBody(*merged(corners), notes=notes)]


def _read_text(content: bytes) -> tuple[Floats, tuple[str, ...]]:
    corners = np.array(b"\n".join(_VERTEX.findall(content)).split(), dtype=np.float64)
    if len(corners) % 9:
        raise ValueError(
            f"{len(corners) // 3} vertices do not make whole triangles; the file is cut short"
        )
    return corners.reshape(-1, 3), ()


def _read_binary(content: bytes, n_declared: int) -> tuple[Floats, tuple[str, ...]]:
    """Read the triangles of the file, even if their number differs from that in the header."""
    n_complete = max(len(content) - _HEADER, 0) // _TRIANGLE.itemsize
    n = min(n_complete, n_declared) or n_complete
    notes = (
        () if n == n_declared else (f"the header declares {n_declared} triangles: {n} were read",)
    )
    rows = np.frombuffer(content, _TRIANGLE, n, _HEADER) if n else np.zeros(0, _TRIANGLE)
    return rows["corners"].reshape(-1, 3).astype(np.float64), notes


def merged(corners: Floats) -> Surface:
    """Merge equal corners (3F, 3) into vertices (V, 3), in order of their first use; return them and faces (F, 3)."""
    corners = corners + 0.0  # turns -0 into 0
    _, first, index = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return corners[np.sort(first)], rank[index.ravel()].reshape(-1, 3)


FORMAT = Format("STL", (".stl", ".stl_ascii"), read)

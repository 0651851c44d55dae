"""OFF: coordinates and polygons as text; what stands behind them in a line, as colours do, is passed over."""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from igps._arrays import Integers
from igps.mesh.formats._format import Format, RawBody, text_of
from igps.mesh.formats._polygons import flat_triangles
from igps.mesh.options import LoadOptions

_WHOLE_NUMBERS = re.compile(r"[\d\s]+", re.ASCII)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    text = text_of(path)
    if "#" in text:
        text = "\n".join(line.partition("#")[0] for line in text.split("\n"))
    kind, _, rest = text.partition("OFF")
    lines = [line for line in rest.splitlines() if line and not line.isspace()]
    if not lines:
        raise ValueError("no OFF with the numbers of vertices and faces behind it")
    if "BINARY" in lines[0]:
        raise ValueError("numbers as bytes (OFF BINARY), of which text is expected; export it as text, or as PLY")
    if "4" in kind:
        raise ValueError("four coordinates for each vertex (4OFF), of which three are expected")
    n_vertices, n_faces, *_ = map(int, lines[0].split())
    places, rows = lines[1 : n_vertices + 1], lines[n_vertices + 1 :][:n_faces]
    if min(n_vertices, n_faces) < 0 or len(rows) < n_faces or len(places) < n_vertices:
        raise ValueError(f"{n_vertices} vertices and {n_faces} faces announced, {len(lines) - 1} lines there")
    if not places:
        return [RawBody()]
    vertices = np.array([line.split()[:3] for line in places], dtype=np.float64).reshape(n_vertices, 3)
    corners, n_corners = _corners(rows)
    if corners.min(initial=0) < 0 or corners.max(initial=0) >= n_vertices:
        raise ValueError("a face refers to a vertex that is not there")
    return [RawBody(vertices, flat_triangles(corners, n_corners, vertices))]


def _corners(lines: list[str]) -> tuple[Integers, Integers]:
    """The corners of polygons laid end to end, and how many each has."""
    # An older NumPy makes whole numbers of broken ones
    if _WHOLE_NUMBERS.fullmatch("\n".join(lines)):
        with suppress(ValueError):  # of lines that are alike, many times faster
            rows = np.loadtxt(lines, np.int64, comments=None, ndmin=2)
            n_corners = rows[:, 0]
            if (n_corners == n_corners[0]).all() and n_corners[0] < rows.shape[1]:
                return rows[:, 1 : n_corners[0] + 1].ravel(), n_corners
    words = [line.split() for line in lines]
    n_corners = np.array([int(row[0]) for row in words], dtype=np.int64)
    polygons = [row[1 : n + 1] for n, row in zip(n_corners.tolist(), words, strict=True)]
    corners = np.array([int(corner) for polygon in polygons for corner in polygon], dtype=np.int64)
    if len(corners) != n_corners.sum():
        raise ValueError("a line with fewer corners than it announces")
    return corners, n_corners


FORMAT = Format("OFF", (".off",), read)

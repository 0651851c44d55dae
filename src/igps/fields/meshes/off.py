"""OFF: vertices and polygons as text; further fields of a line, such as colours, are ignored."""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from igps._arrays import Integers
from igps.mesh.formats import Format
from igps.mesh.options import LoadOptions
from igps.mesh.polygons import flat_triangles
from igps.mesh.raw_body import RawBody, text_of

# The first word, in any case; kinds such as COFF have more columns. Some programs leave it out.
_WORD = re.compile(r"\s*([a-z4]*?)off\b", re.IGNORECASE)
_WHOLE_NUMBERS = re.compile(r"[\d\s]+", re.ASCII)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    text = text_of(path)
    if "#" in text:
        text = "\n".join(line.partition("#")[0] for line in text.split("\n"))
    word = _WORD.match(text)
    kind = word[1].upper() if word else ""
    content = text[word.end() :] if word else text
    lines = [line for line in content.splitlines() if line and not line.isspace()]
    if not lines:
        raise ValueError("expected OFF, followed by the numbers of vertices and faces")
    if "BINARY" in lines[0]:
        raise ValueError(
            "expected numbers as text, got bytes (OFF BINARY); export it as text, or as PLY"
        )
    if "4" in kind:
        raise ValueError("expected three coordinates for each vertex, got four (4OFF)")
    n_vertices, n_faces, *_ = map(int, lines[0].split())
    coordinates = lines[1 : n_vertices + 1]
    behind = lines[n_vertices + 1 :]
    rows = behind[:n_faces]
    if min(n_vertices, n_faces) < 0 or len(rows) < n_faces or len(coordinates) < n_vertices:
        raise ValueError(
            f"expected {n_vertices} vertices and {n_faces} faces, got {len(lines) - 1} lines"
        )
    if not coordinates:
        return [RawBody()]
    columns = [line.split()[:3] for line in coordinates]
    vertices = np.array(columns, dtype=np.float64).reshape(n_vertices, 3)
    corners, n_corners = _corners(rows)
    if corners.min(initial=0) < 0 or corners.max(initial=0) >= n_vertices:
        raise ValueError("a face refers to a vertex that is not there")
    return [RawBody(vertices, flat_triangles(corners, n_corners, vertices))]


def _corners(lines: list[str]) -> tuple[Integers, Integers]:
    """Return the corners of polygons laid end to end, and the number of corners of each polygon."""
    # Old versions of NumPy round fractions to integers
    if _WHOLE_NUMBERS.fullmatch("\n".join(lines)):
        with suppress(ValueError):  # many times faster, if all polygons have as many corners
            rows = np.loadtxt(lines, np.int64, comments=None, ndmin=2)
            n_corners = rows[:, 0]
            n = n_corners[0]
            if (n_corners == n).all() and n < rows.shape[1]:
                return rows[:, 1 : n + 1].ravel(), n_corners
    counts = []
    words: list[str] = []
    for line in lines:
        count, *further = line.split()
        counts.append(int(count))
        words += further[: int(count)]
    n_corners = np.array(counts, dtype=np.int64)
    corners = np.array([int(word) for word in words], dtype=np.int64)
    if len(corners) != n_corners.sum():
        raise ValueError("a line with fewer corners than it declares")
    return corners, n_corners


FORMAT = Format("OFF", (".off",), read)

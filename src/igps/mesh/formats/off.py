"""OFF: coordinates and polygons as text."""

import re
from pathlib import Path

import numpy as np

from igps._arrays import Surface
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.formats._polygons import flat_triangles
from igps.mesh.formats._trimesh import objects
from igps.mesh.options import LoadOptions

_WHOLE_NUMBERS = re.compile(r"\s*\d[\d\s]*", re.ASCII)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    found = _plain(path) or _polygons(path)
    return objects(path, options) if found is None else [RawBody(*found)]


def _plain(path: Path) -> Surface | None:
    """What trimesh reads of a file of coordinates and triangles alone, in a tenth of the time.

    None where it holds anything else, or is broken.
    """
    try:
        head, counts, *lines = path.read_text(encoding="utf-8").splitlines()
        n_vertices, n_faces, _ = map(int, counts.split())
        places, rows = lines[: max(n_vertices, 0)], lines[max(n_vertices, 0) :]
        # Of no lines NumPy warns, and an older one makes whole numbers of broken ones
        plain = head.strip() == "OFF" and "".join(places[:1]).strip() and _WHOLE_NUMBERS.fullmatch("\n".join(rows))
        if not plain:
            return None
        vertices = np.loadtxt(places, np.float64, comments=None, ndmin=2)
        faces = np.loadtxt(rows, np.int64, comments=None, ndmin=2)
    except ValueError:  # comments, colours, polygons of several sizes, or no text
        return None
    if vertices.shape != (n_vertices, 3) or faces.shape != (n_faces, 4) or (faces[:, 0] != 3).any():
        return None
    return (vertices, np.ascontiguousarray(faces[:, 1:])) if faces[:, 1:].max() < n_vertices else None


def _polygons(path: Path) -> Surface | None:
    """The surface of polygons, behind which colours may stand; None of triangles alone, and of what is broken.

    Trimesh folds concave ones, and cannot read those of more than four corners.
    """
    try:
        text = path.read_text(encoding="utf-8")
        lines = [kept for line in text.splitlines() if (kept := line.partition("#")[0].strip())]
        n_vertices, n_faces = map(int, lines[1].split()[:2])
        rows = [line.split() for line in lines[2 + n_vertices : 2 + n_vertices + n_faces]]
        n_corners = np.array([int(row[0]) for row in rows], dtype=np.int64)
        if lines[0] != "OFF" or len(rows) < n_faces or min(n_vertices, n_faces) < 1 or not (n_corners > 3).any():
            return None
        corners = np.array(
            [int(word) for n, row in zip(n_corners.tolist(), rows, strict=True) for word in row[1 : n + 1]],
            dtype=np.int64,
        )
        vertices = np.loadtxt(lines[2 : 2 + n_vertices], np.float64, comments=None, usecols=(0, 1, 2), ndmin=2)
    except (ValueError, IndexError):
        return None
    if len(corners) != n_corners.sum() or (n_corners < 3).any():
        return None
    return vertices, flat_triangles(corners, n_corners, vertices)


FORMAT = Format("OFF", (".off",), read)

"""OFF: coordinates and polygons as text."""

import re
from pathlib import Path

import numpy as np

from igps._arrays import Surface
from igps.mesh.formats._format import Format, RawBody
from igps.mesh.formats._trimesh import objects
from igps.mesh.options import LoadOptions

_WHOLE_NUMBERS = re.compile(r"\s*\d[\d\s]*", re.ASCII)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surface of an OFF file."""
    plain = _plain(path)
    return objects(path, options) if plain is None else [RawBody(*plain)]


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


FORMAT = Format("OFF", (".off",), read)

"""Clouds of points as text: lines of three coordinates, or of six with normals."""

from pathlib import Path

import numpy as np

from igps.mesh.formats._format import Format, RawBody
from igps.mesh.options import LoadOptions


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    rows = np.loadtxt(path, ndmin=2, comments=("#", "//"), encoding="latin-1")  # which has a letter for any byte
    if rows.shape[1] not in (3, 6):
        raise ValueError(f"expected lines of 3 numbers, or of 6 with normals, got {rows.shape[1]}")
    return [RawBody(rows[:, :3], normals=rows[:, 3:] if rows.shape[1] == 6 else None)]


FORMAT = Format("points", (".xyz",), read)

"""Point clouds as text: lines of three coordinates, or of six numbers with normals."""

from pathlib import Path

import numpy as np

from igps.mesh.formats import Format
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    rows = np.loadtxt(path, ndmin=2, comments=("#", "//"), encoding="latin-1")  # decodes any byte
    n_columns = rows.shape[1]
    if n_columns == 3:
        return [RawBody(rows)]
    if n_columns == 6:
        return [RawBody(rows[:, :3], normals=rows[:, 3:])]
    raise ValueError(f"expected 3 numbers in a line, or 6 with normals, got {n_columns}")


FORMAT = Format("points", (".xyz",), read)

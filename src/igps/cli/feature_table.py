"""Tables of descriptions, for statistics packages: one row per body, or one row per file."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from igps.cli.reading import is_named_after_file
from igps.data.dataset import SignatureDataset
from igps.data.sources import LABELS_FILE, file_name_of, is_number
from igps.report.tables import write_rows

SUFFIXES = (".csv", ".parquet")
_TEXT_COLUMNS = ("file", "folder", "part", "name", "class", "unit")
Table = Mapping[str, Sequence[Any]]
"""Columns of equal length by name; None for a missing value."""


def feature_table(dataset: SignatureDataset, features: np.ndarray) -> tuple[Table, Table]:
    """Return the metadata and the measured values of bodies as two tables with one row per body.

    Args:
        dataset: N bodies, their Signatures cached.
        features: (N, ...) descriptions.

    Returns:
        The metadata: `file`, `part`, `name`, `class`, further columns of labels.csv, and the `unit` of length. A column
        of labels.csv whose name is in use already, or is `folder`, is called `NAME of labels.csv`.
        The measured values: `volume`, `area`, and the description as `v0`, `v1` and so on.
    """
    bodies = dataset.bodies
    units, volumes, areas = zip(
        *((s.unit, s.volume, s.area) for s in dataset.signatures()), strict=True
    )
    files = list(map(file_name_of, bodies.names, bodies.parts))
    own = {
        "file": files,
        "part": bodies.parts,
        "name": bodies.names,
        "class": bodies.labels or [None] * len(bodies),
    }
    vectors = features.reshape(len(features), -1)
    measured = {
        "volume": volumes,
        "area": areas,
        **{f"v{i}": list(column) for i, column in enumerate(vectors.T)},
    }
    reserved = {*own, "folder", "unit", *measured}
    further = {
        f"{name} of {LABELS_FILE}" * (name in reserved) or name: bodies.columns[name]
        for name in bodies.columns
    }
    return {**own, **further, "unit": units}, measured


def wide_table(metadata: Table, measured: Table) -> Table:
    """Return a table with one row per file, from the two tables of `feature_table`.

    Metadata that all bodies of each file share is one column; everything else is a column per body: `PART.volume`,
    `PART.v0` and so on. A body that is missing in a file, or could not be used, has no values.

    Where each file is the mask of one organ, a row is a folder of files instead. This is assumed if bodies are named
    after their files, or if the same names occur in several folders. Files that are only numbered stay one row each.
    """
    folders = [PurePath(file).parent.as_posix() for file in metadata["file"]]
    n, parts = len(folders), set(metadata["part"])
    has_one_body_per_file = (
        len(set(metadata["file"])) == n == len(set(zip(folders, metadata["part"], strict=True)))
    )
    is_named_by_file = all(map(is_named_after_file, metadata["name"], metadata["part"]))
    if is_named_by_file and all(part and part.isdigit() for part in parts):
        metadata = {**metadata, "part": [None] * n}
    elif has_one_body_per_file and len(parts) > 1 and (n > len(parts) or is_named_by_file):
        metadata = {
            "folder": folders,
            **{name: metadata[name] for name in metadata if name != "file"},
        }
    rows: dict[str, dict[str | None, int]] = {}
    for i, (file, part) in enumerate(
        zip(next(iter(metadata.values())), metadata["part"], strict=True)
    ):
        rows.setdefault(file, {})[part] = i
    table: dict[str, Sequence[Any]] = {}
    per_body: dict[str, Sequence[Any]] = {}
    for name in [name for name in metadata if name not in ("part", "name")]:
        values_of_rows = [{metadata[name][i] for i in bodies.values()} for bodies in rows.values()]
        if all(len(values) == 1 for values in values_of_rows):
            table[name] = [values.pop() for values in values_of_rows]
        else:
            per_body[name] = metadata[name]
    for part in dict.fromkeys(metadata["part"]):
        indices = [bodies.get(part) for bodies in rows.values()]
        for name, column in {**per_body, **measured}.items():
            title = name if part is None else f"{part}.{name}"
            table[title] = [None if i is None else column[i] for i in indices]
    return table


def write_table(path: Path, table: Table) -> None:
    """Write a table as Parquet, which needs pyarrow, if the suffix is .parquet, otherwise as CSV."""
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet
        except ImportError as error:
            raise ImportError(
                'out: Parquet needs pyarrow: pip install "interior-gps[table]". Or write CSV.'
            ) from error
        arrays = {name: pyarrow.array(_typed(name, values)) for name, values in table.items()}
        pyarrow.parquet.write_table(pyarrow.table(arrays), path)
    else:
        write_rows(path, table, zip(*table.values(), strict=True))


def _typed(column: str, values: Sequence[Any]) -> list[Any]:
    """Return a column of labels.csv as floats if all values are numbers; names stay strings even if they are digits."""
    if column.rpartition(".")[2] not in _TEXT_COLUMNS and all(map(is_number, values)):
        return [None if value is None else float(value) for value in values]
    return list(values)

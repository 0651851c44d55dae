"""Descriptions as a table, for statistics packages: a row for each body, or for each file."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from igps.cli.reading import is_called_by_file
from igps.data.dataset import SignatureDataset
from igps.data.sources import LABELS_FILE, file_name_of, is_number
from igps.report.tables import write_rows

SUFFIXES = (".csv", ".parquet")
_WORDS = ("file", "folder", "part", "name", "class", "unit")
Table = Mapping[str, Sequence[Any]]
"""Columns by name, all of one length; None where a value is missing."""


def feature_table(dataset: SignatureDataset, features: np.ndarray) -> tuple[Table, Table]:
    """What is known of each body, and what was measured of it.

    Args:
        dataset: N bodies, their Signatures cached.
        features: (N, ...) descriptions.

    Returns:
        `file`, `part`, `name`, `class`, further columns of the table of labels, and the `unit` of length; and `volume`,
        `area`, and the description as `v0`, `v1` and so on. A further column of one of these names, or `folder`, is
        `NAME of labels.csv`.
    """
    bodies = dataset.bodies
    units, volumes, areas = zip(*((one.unit, one.volume, one.area) for one in dataset.signatures()), strict=True)
    files = list(map(file_name_of, bodies.names, bodies.parts))
    own = {"file": files, "part": bodies.parts, "name": bodies.names, "class": bodies.labels or [None] * len(bodies)}
    vectors = features.reshape(len(features), -1)
    measured = {"volume": volumes, "area": areas, **{f"v{i}": list(column) for i, column in enumerate(vectors.T)}}
    taken = {*own, "folder", "unit", *measured}
    further = {f"{name} of {LABELS_FILE}" * (name in taken) or name: bodies.columns[name] for name in bodies.columns}
    return {**own, **further, "unit": units}, measured


def wide_table(known: Table, measured: Table) -> Table:
    """A row for each file: what its bodies share, and `PART.volume`, `PART.v0` and so on; see `feature_table`.

    Masks of one organ each, called by their files or with names that come again in other folders, have a row for each
    folder, unless they are only numbered. A body that a file or folder lacks, or that could not be used, has no values.
    """
    folders = [PurePath(file).parent.as_posix() for file in known["file"]]
    n, parts = len(folders), set(known["part"])
    one_each = len(set(known["file"])) == n == len(set(zip(folders, known["part"], strict=True)))
    called = all(map(is_called_by_file, known["name"], known["part"]))
    if called and all(part and part.isdigit() for part in parts):
        known = {**known, "part": [None] * n}
    elif one_each and len(parts) > 1 and (n > len(parts) or called):
        known = {"folder": folders, **{name: known[name] for name in known if name != "file"}}
    rows: dict[str, dict[str | None, int]] = {}
    for i, (file, part) in enumerate(zip(next(iter(known.values())), known["part"], strict=True)):
        rows.setdefault(file, {})[part] = i
    table: dict[str, Sequence[Any]] = {}
    apart: dict[str, Sequence[Any]] = {}
    for name in [name for name in known if name not in ("part", "name")]:
        per_file = [{known[name][i] for i in bodies.values()} for bodies in rows.values()]
        if all(len(found) == 1 for found in per_file):
            table[name] = [found.pop() for found in per_file]
        else:
            apart[name] = known[name]
    for part in dict.fromkeys(known["part"]):
        places = [bodies.get(part) for bodies in rows.values()]
        for name, values in {**apart, **measured}.items():
            column = name if part is None else f"{part}.{name}"
            table[column] = [None if i is None else values[i] for i in places]
    return table


def write_table(path: Path, table: Table) -> None:
    """Write a table as CSV or Parquet, by the suffix; the latter needs pyarrow."""
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet
        except ImportError as error:
            raise ImportError('out: Parquet needs pyarrow: pip install "interior-gps[table]". Or write CSV.') from error
        arrays = {name: pyarrow.array(_typed(name, values)) for name, values in table.items()}
        pyarrow.parquet.write_table(pyarrow.table(arrays), path)
        return
    write_rows(path, table, zip(*table.values(), strict=True))


def _typed(column: str, values: Sequence[Any]) -> list[Any]:
    """Numbers of a further column, which labels.csv has as words; names stay words, though they may be digits."""
    if column.rpartition(".")[2] not in _WORDS and all(map(is_number, values)):
        return [None if one is None else float(one) for one in values]
    return list(values)

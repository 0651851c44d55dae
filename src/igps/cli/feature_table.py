"""Tables of descriptions, for statistics packages: one row per body, or one row per file."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from igps.cli.reading import is_named_after_file
from igps.data.dataset import SignatureDataset
from igps.data.sources import LABELS_FILE, file_name_of, is_number
from igps.fields.volumes.border import border_of
from igps.mesh.mesh import MILLIMETRES, millimetres
from igps.report.tables import write_rows
from igps.signature.measures import POWERS

SUFFIXES = (".csv", ".parquet")
_TEXT_COLUMNS = ("file", "folder", "part", "name", "class", "unit", "border_sides", "notes")
# Columns that a wide table has for each body, whether or not the bodies of a file happen to agree
_OF_BODIES = ("at_border", "border_sides", "notes")
# Units in names of columns, which statistics packages read as letters
_WRITTEN = {"Å": "A", "µm": "um", "\u03bcm": "um"}
Table = Mapping[str, Sequence[Any]]
"""Columns of equal length by name; None for a missing value."""


def feature_table(
    dataset: SignatureDataset, vectors: np.ndarray, columns: Sequence[str] = ()
) -> tuple[Table, Table]:
    """Return the metadata and the measured values of bodies as two tables with one row per body.

    Args:
        dataset: N bodies, their Signatures cached.
        vectors: (N, D) descriptions; D is 0 for plain numbers alone.
        columns: names of the D columns of the vectors.

    Returns:
        The metadata: `file`, `part`, `name`, `class`, further columns of labels.csv, the `unit` of length, the share of
        the surface `at_border` of the image and the `border_sides` (None for bodies that are not from volumes), and the
        `notes` on how the body was read and changed. A column of labels.csv whose name is in use already, or is
        `folder`, is called `NAME of labels.csv`.
        The measured values: the plain numbers of `igps.measures`, named with their unit, such as `volume_mm3`, and the
        vectors. Bodies with different known units are told in millimetres, and no unit is named if one is unknown.
    """
    bodies = dataset.bodies
    own: dict[str, Sequence[Any]] = {
        "file": list(map(file_name_of, bodies.names, bodies.parts)),
        "part": bodies.parts,
        "name": bodies.names,
        "class": bodies.labels or [None] * len(bodies),
    }
    measured = _plain_numbers(dataset)
    for name, column in zip(columns, vectors.T, strict=True):
        measured[name] = list(column)
    last: dict[str, Sequence[Any]] = {
        "unit": dataset.units(),
        **_border_columns(dataset),
        "notes": ["; ".join(notes) for notes in dataset.all_notes()],
    }
    reserved = {"folder", *own, *last, *measured}
    further = {}
    for name, values in bodies.columns.items():
        title = f"{name} of {LABELS_FILE}" if name in reserved else name
        further[title] = values
    return {**own, **further, **last}, measured


def _border_columns(dataset: SignatureDataset) -> dict[str, Sequence[Any]]:
    """Return which share of each surface lies at the border of the image, and at which sides."""
    shares: list[float | None] = []
    sides: list[str | None] = []
    for notes, measures in zip(dataset.all_notes(), dataset.measures(), strict=True):
        border = border_of(notes)
        if border is not None:
            shares.append(border.share)
            sides.append(border.sides)
        else:
            is_from_voxels = "voxel_volume" in measures
            shares.append(0.0 if is_from_voxels else None)
            sides.append(None)
    return {"at_border": shares, "border_sides": sides}


def _plain_numbers(dataset: SignatureDataset) -> dict[str, Sequence[Any]]:
    """Return a column for each measure, None where a body has none; the name of a column ends with its unit."""
    units = dataset.units()
    known = [unit for unit in units if unit is not None and unit in MILLIMETRES]
    shown = ""
    lengths = [1.0] * len(units)
    if len(known) == len(units):
        shown = _WRITTEN.get(known[0], known[0])
        if len(set(known)) > 1:
            shown = "mm"
            lengths = [millimetres(unit) for unit in known]
    rows = dataset.measures()
    columns: dict[str, Sequence[Any]] = {}
    for name, power in POWERS.items():
        values = []
        for row, length in zip(rows, lengths, strict=True):
            values.append(row[name] * length**power if name in row else None)
        columns[name + _unit_suffix(shown, power)] = values
    return columns


def _unit_suffix(unit: str, power: int) -> str:
    """Return the end of a column's name: `_mm3` for a volume, `_per_mm` for a curvature."""
    if not unit or not power:
        return ""
    if power < 0:
        return f"_per_{unit}"
    return f"_{unit}{power}" if power > 1 else f"_{unit}"


def wide_table(metadata: Table, measured: Table) -> Table:
    """Return a table with one row per file, from the two tables of `feature_table`.

    Metadata that all bodies of each file share is one column; everything else is a column per body, in the order of the
    names of the bodies: `PART.volume_mm3`, `PART.class.0` and so on. A body that is missing in a file, or could not be
    used, has no values.

    Where each file is the mask of one organ, a row is a folder of files instead. This is assumed if bodies are named
    after their files, or if the same names occur in several folders. Files that are only numbered stay one row each.
    """
    metadata = _with_rows(metadata)
    row_names = metadata["folder" if "folder" in metadata else "file"]
    rows: dict[str, dict[str | None, int]] = {}
    for i, (row, part) in enumerate(zip(row_names, metadata["part"], strict=True)):
        rows.setdefault(row, {})[part] = i
    table: dict[str, Sequence[Any]] = {}
    per_body: dict[str, Sequence[Any]] = {}
    for name, column in metadata.items():
        if name in ("part", "name"):
            continue
        values = [{column[i] for i in bodies.values()} for bodies in rows.values()]
        if name in _OF_BODIES or any(len(own) > 1 for own in values):
            per_body[name] = column
        else:
            table[name] = [own.pop() for own in values]
    per_body |= measured
    for part in sorted(set(metadata["part"]), key=str):
        indices = [bodies.get(part) for bodies in rows.values()]
        for name, column in per_body.items():
            title = name if part is None else f"{part}.{name}"
            table[title] = [None if i is None else column[i] for i in indices]
    return table


def _with_rows(metadata: Table) -> Table:
    """Return metadata with the column that names the row of each body: its file, or its folder."""
    files = metadata["file"]
    parts = metadata["part"]
    folders = [PurePath(file).parent.as_posix() for file in files]
    n = len(parts)
    n_different = len(set(parts))
    is_named_by_file = all(map(is_named_after_file, metadata["name"], parts))
    if is_named_by_file and all(part and part.isdigit() for part in parts):
        return {**metadata, "part": [None] * n}
    has_one_body_per_file = len(set(files)) == n
    has_one_part_per_folder = len(set(zip(folders, parts, strict=True))) == n
    is_mask_of_organ = has_one_body_per_file and has_one_part_per_folder and n_different > 1
    if not is_mask_of_organ or (n == n_different and not is_named_by_file):
        return metadata
    table = {"folder": folders, **metadata}
    del table["file"]
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
        return
    write_rows(path, table, zip(*table.values(), strict=True))


def _typed(column: str, values: Sequence[Any]) -> list[Any]:
    """Return a column of labels.csv as floats if all values are numbers; names stay strings even if they are digits."""
    _, _, name = column.rpartition(".")  # behind that of a part
    if name in _TEXT_COLUMNS or not all(map(is_number, values)):
        return list(values)
    return [None if value is None else float(value) for value in values]

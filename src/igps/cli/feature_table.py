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
    measured |= {name: list(column) for name, column in zip(columns, vectors.T, strict=True)}
    last: dict[str, Sequence[Any]] = {
        "unit": dataset.units(),
        **_border_columns(dataset),
        "notes": ["; ".join(notes) for notes in dataset.all_notes()],
    }
    reserved = {"folder", *own, *last, *measured}
    further = {}
    for name, values in bodies.columns.items():
        further[f"{name} of {LABELS_FILE}" if name in reserved else name] = values
    return {**own, **further, **last}, measured


def _border_columns(dataset: SignatureDataset) -> dict[str, Sequence[Any]]:
    """Return which share of each surface lies at the border of the image, and at which sides."""
    borders = [border_of(notes) for notes in dataset.all_notes()]
    is_from_voxels = ["voxel_volume" in row for row in dataset.measures()]
    whole = [0.0 if known else None for known in is_from_voxels]
    shares = [
        share if border is None else border.share
        for border, share in zip(borders, whole, strict=True)
    ]
    sides = [None if border is None else border.sides for border in borders]
    return {"at_border": shares, "border_sides": sides}


def _plain_numbers(dataset: SignatureDataset) -> dict[str, Sequence[Any]]:
    """Return a column for each measure, None where a body has none; the name of a column ends with its unit."""
    units = dataset.units()
    known = [unit for unit in units if unit is not None and unit in MILLIMETRES]
    is_known = len(known) == len(units)
    is_mixed = is_known and len(set(known)) > 1
    suffix = ""
    if is_known:
        suffix = "mm" if is_mixed else _WRITTEN.get(known[0], known[0])
    rows = dataset.measures()
    columns: dict[str, Sequence[Any]] = {}
    for name, power in POWERS.items():
        factors = [millimetres(unit) ** power if is_mixed else 1.0 for unit in units]
        pairs = zip(rows, factors, strict=True)
        values = [row[name] * factor if name in row else None for row, factor in pairs]
        columns[name + _unit_suffix(suffix, power)] = values
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
    for name in [name for name in metadata if name not in ("part", "name")]:
        shared = [{metadata[name][i] for i in bodies.values()} for bodies in rows.values()]
        is_shared = name not in _OF_BODIES and all(len(values) == 1 for values in shared)
        if is_shared:
            table[name] = [values.pop() for values in shared]
        else:
            per_body[name] = metadata[name]
    for part in sorted(set(metadata["part"]), key=str):
        indices = [bodies.get(part) for bodies in rows.values()]
        for name, column in {**per_body, **measured}.items():
            title = name if part is None else f"{part}.{name}"
            table[title] = [None if i is None else column[i] for i in indices]
    return table


def _with_rows(metadata: Table) -> Table:
    """Return metadata with the column that names the row of each body: its file, or its folder."""
    folders = [PurePath(file).parent.as_posix() for file in metadata["file"]]
    parts = metadata["part"]
    n = len(parts)
    n_different = len(set(parts))
    has_one_body_per_file = len(set(metadata["file"])) == n
    has_one_part_per_folder = len(set(zip(folders, parts, strict=True))) == n
    is_named_by_file = all(map(is_named_after_file, metadata["name"], parts))
    if is_named_by_file and all(part and part.isdigit() for part in parts):
        return {**metadata, "part": [None] * n}
    is_mask_of_organ = has_one_body_per_file and has_one_part_per_folder and n_different > 1
    if is_mask_of_organ and (n > n_different or is_named_by_file):
        others = {name: metadata[name] for name in metadata if name != "file"}
        return {"folder": folders, **others}
    return metadata


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

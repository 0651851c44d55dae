"""The command `igps inside`."""

from __future__ import annotations

import math
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from igps.analysis.inside_collection import InsideTable
    from igps.cli.reading import Folder
    from igps.data.dataset import Failure, SignatureDataset
    from igps.data.sources import Bodies

_SHOWN = ("mean", "rim.contrast", "core.contrast", "ends.contrast", "axis1.correlation", "moran")
_N_SHOWN = 20  # bodies


def inside(meshes: list[Path], out: Path | None = None, **reading: Any) -> list[dict[str, Any]]:
    """Tell where in each body the values of --attribute lie, in numbers that do not depend on pose.

    For each attribute, a row of the table has the mean, spread and quantiles in the core, the middle and the ends of
    the body, and from its rim to its depth; contrasts; correlations with the first axes of the body; how alike values
    are at small, middle and large interior distance; and the share of the brightest tenth in each class. For two
    attributes, it has their joint distribution.

    Args:
        meshes: a folder of bodies, or files.
        out: file ending in .csv or .parquet for the table: a row per body, with the columns file, part, name, class,
            further columns of labels.csv, unit, notes, the plain numbers of igps extract, and all numbers inside.
    """
    from igps.cli.feature_table import feature_table, write_table
    from igps.cli.reading import files_or_folder, print_failures

    dataset, table, failures = inside_bodies(files_or_folder(meshes), **reading)
    rows = []
    for name, numbers in zip(dataset.bodies.names, table.rows.tolist(), strict=True):
        row: dict[str, Any] = {"name": name}
        for column, number in zip(table.columns, numbers, strict=True):
            row[column] = None if math.isnan(number) else number
        rows.append(row)
    if out is not None:
        metadata, measured = feature_table(dataset, table.rows[:, :0], [])
        columns = {name: [row[name] for row in rows] for name in table.columns}
        out.parent.mkdir(parents=True, exist_ok=True)
        write_table(out, {**metadata, **measured, **columns})
    print(_text(rows, table.attributes))
    print_failures(failures, len(rows))
    if out is not None:
        print(f"{len(table.columns)} numbers of {len(rows)} bodies written to {out}")
    return rows


def inside_bodies(
    source: Folder | Sequence[Path] | Bodies, **reading: Any
) -> tuple[SignatureDataset, InsideTable, list[Failure]]:
    """Return the bodies that could be used, where inside them the attributes lie, and the failures of the others.

    Remarks on the numbers are printed. A ValueError is raised if there is no attribute.
    """
    from igps.analysis.inside_collection import inside_config, inside_table, remarks
    from igps.cli.reading import signatures
    from igps.signature.config import SignatureConfig

    check_has_attribute(reading)
    config = inside_config(reading.pop("signature", SignatureConfig()))
    dataset, failures = signatures(source, signature=config, **reading)
    unusable: list[Failure] = []
    attributes = tuple(dataset.pipeline.attributes)
    n_workers = reading.get("n_workers")
    table = inside_table(dataset, attributes, failures=unusable, n_workers=n_workers)
    for remark in remarks(dataset, table):
        print(remark)
    return dataset, table, [*failures, *unusable]


def check_has_attribute(reading: Mapping[str, Any]) -> None:
    """Raise a ValueError if the options of reading name no attribute."""
    if not reading.get("attribute"):
        raise ValueError(
            "attribute: expected at least one, such as --attribute ct=images/{stem}.nii.gz, got none."
        )


Vectors = tuple[str, list[int], Any]
"""A title, the indices of N bodies, and their vectors (N, D)."""


def inside_vectors(
    source: Folder, bodies: Bodies, members: Mapping[str, list[int]], **reading: Any
) -> tuple[list[Vectors], list[Vectors]]:
    """Return what `igps groups` tests inside bodies, and print which bodies have no numbers and are left out.

    Args:
        source: where the bodies are read.
        bodies: the bodies that are tested.
        members: indices of the bodies of each kind, such as an organ.

    Returns:
        All numbers without a unit at once, as standard scores, for each kind; and each number by itself.
    """
    from igps.cli.reading import print_failures

    dataset, table, failures = inside_bodies(source, **reading)
    row_of = {name: row for row, name in enumerate(dataset.bodies.names)}
    # Those without a signature are told with the test of shape
    print_failures([failure for failure in failures if failure.id in row_of], len(dataset))
    whole: list[Vectors] = []
    by_number: list[Vectors] = []
    for kind, indices in members.items():
        own = [i for i in indices if bodies.names[i] in row_of]
        part = table.subset([row_of[bodies.names[i]] for i in own])
        is_whole, scores = part.scores()
        complete = list(compress(own, is_whole))
        whole.append((f"{kind}, inside", complete, scores))
        for name in table.columns:
            is_known, numbers = part.known(name)
            known = list(compress(own, is_known))
            by_number.append((f"{kind}, {name}", known, numbers))
    return whole, by_number


def _text(rows: Sequence[dict[str, Any]], attributes: Sequence[str]) -> str:
    """Return a text table of the numbers that tell most, with one line per body."""
    from igps.report.tables import text_table

    shown = rows[:_N_SHOWN]
    parts = []
    for attribute in attributes:
        titles = [f"{attribute}.{number}" for number in _SHOWN]
        cells = []
        for row in shown:
            numbers = ["–" if row[title] is None else f"{row[title]:.4g}" for title in titles]
            cells.append([row["name"], *numbers])
        parts.append(text_table(["", *titles], cells, left=[""]))
    if len(rows) > len(shown):
        parts.append(f"the first {len(shown)} of {len(rows)} bodies; --out writes all")
    return "\n".join(parts)

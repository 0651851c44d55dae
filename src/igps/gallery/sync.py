"""Synchronisation of a gallery with a folder."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from igps.data.dataset import Failure, SignatureDataset
from igps.gallery.columns import KNOWN
from igps.gallery.gallery import Gallery
from igps.gallery.rows import checksum_of, each_body_once, further_columns, known_rows

_ROWS_PER_COMMIT = 1000


def sync(
    gallery: Gallery,
    dataset: SignatureDataset,
    root: str | Path,
    *,
    n_workers: int | None = None,
    strict: bool = False,
    progress: bool = False,
) -> tuple[int, int, list[Failure]]:
    """Bring a gallery up to date with a folder: describe new and changed files, remove deleted ones, update columns.

    Files whose size and modification time have not changed are not read. If the description of a body fails, its old
    row stays, as do the rows of files in folders without read permission and of files outside the folder.

    Args:
        gallery: the gallery to change.
        dataset: all bodies below the folder; missing Signatures are computed.
        root: the folder.
        n_workers, strict, progress: see `Gallery.build`.

    Returns:
        The number of bodies that were described, the number that were removed, and the bodies that failed.
    """
    dataset = each_body_once(dataset)
    kinds = further_columns(dataset.bodies, gallery.columns)
    # Columns that the folder no longer has
    cleared = dict.fromkeys(gallery.columns.keys() - KNOWN.keys())
    rows = known_rows(dataset.bodies, kinds, dataset.reading)
    current = [{**cleared, **row} for row in rows]
    columns = [name for name in ("checksum", *current[0]) if name in gallery.columns]
    known = {row["id"]: row for row in gallery.rows(*columns)}
    new: list[int] = []
    # Rows of the same content with other metadata, such as a class
    changed: dict[str, dict[str, Any]] = {}
    for i, row in enumerate(current):
        before = known.get(row["id"], {})
        differences = {name for name, value in row.items() if before.get(name) != value}
        is_unmodified = row["modified"] >= 0 and not {"bytes", "modified"} & differences
        if not is_unmodified and before.get("checksum") != checksum_of(dataset, i):
            new.append(i)
        elif differences:
            changed[row["id"]] = row
    for where in _where_id(sorted(changed)):
        for batch in gallery.table.batches(where):
            descriptions, rows = gallery.table.decoded(batch)
            for row in rows:
                row |= changed[row["id"]]
            gallery.table.add(descriptions, rows, kinds)
    failures: list[Failure] = []
    if new:
        subset = dataset.subset(new)
        failures = subset.precompute(n_workers=n_workers, strict=strict, progress=progress)
        failures += gallery.add(
            subset.usable(failures), n_workers=n_workers, strict=strict, progress=progress
        )
    prefix = f"{Path(root).resolve()}{os.sep}"
    failed = {failure.id for failure in failures}
    # Their parts may exist
    unread = {row["file"] for row in current if row["part"] is None and row["name"] in failed}
    gone = []
    for name in known.keys() - {row["id"] for row in current}:
        file = known[name]["file"]
        if name.startswith(prefix) and file not in unread and not _is_hidden(file):
            gone.append(name)
    for where in _where_id(gone):
        gallery.remove(where)
    return len(new) - len(failures), len(gone), failures


def _is_hidden(file: str) -> bool:
    """Return whether a file may exist, but in a folder that this user may not read."""
    try:
        os.lstat(file)
    except OSError as error:
        return isinstance(error, PermissionError)
    return not os.access(os.path.dirname(file), os.R_OK)


def _where_id(ids: Sequence[str]) -> Iterator[str]:
    """Yield conditions that select the rows with some ids, in groups."""
    for start in range(0, len(ids), _ROWS_PER_COMMIT):
        quoted = (
            "'" + name.replace("'", "''") + "'" for name in ids[start : start + _ROWS_PER_COMMIT]
        )
        yield f"id IN ({', '.join(quoted)})"

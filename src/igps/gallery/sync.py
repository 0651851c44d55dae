"""A gallery brought up to a folder, in the time that the changes take."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from igps.data.dataset import Failure, SignatureDataset
from igps.gallery.about import KNOWN
from igps.gallery.gallery import Gallery
from igps.gallery.rows import checksum_of, each_body_once, further_columns, known_rows

# Rows that are removed, or changed, in one commit.
_AT_ONCE = 1000


def sync(
    gallery: Gallery,
    dataset: SignatureDataset,
    root: str | Path,
    *,
    n_workers: int | None = None,
    strict: bool = False,
    progress: bool = False,
) -> tuple[int, int, list[Failure]]:
    """Describe new and changed files of a folder, take classes and columns over, and remove deleted files.

    Files of the same size and time of change as before are not read.

    Args:
        dataset: of all bodies below the folder; Signatures that are missing are computed.
        root: the folder. Rows of files elsewhere stay.
        n_workers, strict, progress: see `Gallery.build`.

    Returns:
        How many bodies were described, how many removed, and those that failed, of which the old row stays; as does
        that of a file in a folder that may not be read.
    """
    dataset = each_body_once(dataset)
    kinds = further_columns(dataset.bodies, gallery.columns)
    empty = dict.fromkeys(gallery.columns.keys() - KNOWN.keys())  # what the folder tells no more
    now = [{**empty, **row} for row in known_rows(dataset.bodies, kinds, dataset.reading)]
    asked = [name for name in ("checksum", *now[0]) if name in gallery.columns]
    known = {one["id"]: one for one in gallery.rows(*asked)}
    new: list[int] = []
    told: dict[str, dict[str, Any]] = {}
    for i, row in enumerate(now):
        before = known.get(row["id"], {})
        differs = [name for name, value in row.items() if before.get(name) != value]
        is_known = row["modified"] >= 0 and not {"bytes", "modified"} & set(differs)
        if not is_known and before.get("checksum") != checksum_of(dataset, i):
            new.append(i)
        elif differs:
            told[row["id"]] = row
    for where in _where_id(sorted(told)):  # of the same content, with another class
        for some in gallery.table.batches(where):
            descriptions, rows = gallery.table.decoded(some)
            gallery.table.add(descriptions, [{**row, **told[row["id"]]} for row in rows], kinds)
    failures: list[Failure] = []
    if new:
        chosen = dataset.subset(new)
        failures = chosen.precompute(n_workers=n_workers, strict=strict, progress=progress)
        failures += gallery.add(chosen.usable(failures), n_workers=n_workers, strict=strict, progress=progress)
    here = f"{Path(root).resolve()}{os.sep}"
    gone = [name for name in known.keys() - {row["id"] for row in now} if name.startswith(here)]
    lost = {failure.id for failure in failures}
    unread = {row["file"] for row in now if row["part"] is None and row["name"] in lost}  # whose parts are not known
    gone = [name for name in gone if known[name]["file"] not in unread and not _is_out_of_reach(known[name]["file"])]
    for where in _where_id(gone):
        gallery.remove(where)
    return len(new) - len(failures), len(gone), failures


def _is_out_of_reach(file: str) -> bool:
    """Whether a file may be there that is not seen, as in a folder that this user may not read."""
    try:
        os.lstat(file)
    except OSError as error:
        return isinstance(error, PermissionError)
    return not os.access(os.path.dirname(file), os.R_OK)


def _where_id(ids: Sequence[str]) -> Iterator[str]:
    """Conditions that some of the ids satisfy, together all."""
    for start in range(0, len(ids), _AT_ONCE):
        quoted = ("'" + name.replace("'", "''") + "'" for name in ids[start : start + _AT_ONCE])
        yield f"id IN ({', '.join(quoted)})"

"""Rows of a gallery: the description of each body with its metadata."""

import os
import time
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from igps._progress import Progress
from igps.data.dataset import Failure, SignatureDataset
from igps.data.known_files import MIN_AGE
from igps.data.sources import LABELS_FILE, Bodies, is_number
from igps.gallery.columns import KNOWN, Batch
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of, stat_key
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor

_BATCH_SIZE = 256  # descriptions in memory at once


def described_rows(
    dataset: SignatureDataset,
    descriptor: Descriptor,
    kinds: Mapping[str, type],
    known: Mapping[str, str],
    failures: list[Failure],
    n_workers: int | None,
    strict: bool,
    progress: bool,
) -> Iterator[Batch]:
    """Yield descriptions and rows of the bodies whose checksums are not `known`; append failures to the list."""
    dataset = each_body_once(dataset)
    with Progress(desc="descriptions", total=len(dataset), disable=not progress) as bar:
        for start in range(0, len(dataset), _BATCH_SIZE):
            batch = dataset.subset(range(start, min(start + _BATCH_SIZE, len(dataset))))
            # Time stamps are taken before files are read: a file that changes meanwhile is described again next time
            rows = known_rows(batch.bodies, kinds, dataset.reading)
            for i, row in enumerate(rows):
                row["checksum"] = checksum_of(batch, i)
            new = [i for i, row in enumerate(rows) if not _is_known(row, known)]
            failed: list[Failure] = []
            missing = batch.subset(new)
            descriptions = _described(missing, descriptor, None if strict else failed, n_workers)
            described = missing.usable(failed)
            if len(described):
                row_of = {row["name"]: row for row in rows}
                complete = []
                for name, own in zip(described.bodies.names, described.signatures(), strict=True):
                    measured = {"area": own.area, "volume": own.volume, "unit": own.unit}
                    complete.append({**row_of[name], **measured})
                yield descriptions, complete
            failures += failed
            bar.update(len(batch))


def _is_known(row: Mapping[str, Any], known: Mapping[str, str]) -> bool:
    checksum = row["checksum"]
    return bool(checksum) and known.get(row["id"]) == checksum


def further_columns(bodies: Bodies, there: Mapping[str, type] = KNOWN) -> dict[str, type]:
    """Return the names and types of the further columns of the table of labels.

    A column is numeric if all of its values are numbers, and if the gallery does not have it as text already. A
    ValueError is raised for a name that the gallery uses itself or does not allow.
    """
    kinds: dict[str, type] = {}
    for name, values in bodies.columns.items():
        # LanceDB has a column _rowid itself, and reads a dot as a field within a column
        if name.startswith("_") or "." in name:
            expected = "expected column names without dots that do not begin with an underscore"
            raise ValueError(f"{LABELS_FILE}: {expected}, got {name!r}. Rename the column.")
        if name in (*KNOWN, "vector", "code"):
            raise ValueError(
                f"{LABELS_FILE}: every gallery has a column {name!r}. Give the column another name."
            )
        is_numeric = there.get(name) is not str and all(map(is_number, values))
        kinds[name] = float if is_numeric else str
    return kinds


def known_rows(
    bodies: Bodies, kinds: Mapping[str, type], reading: LoadOptions
) -> list[dict[str, Any]]:
    """Return the metadata of bodies that are known without reading their files."""
    files = _files(bodies)
    labels = bodies.labels or [None] * len(bodies)
    stamps = {file: _stamp(Path(file), reading) for file in set(files)}
    rows: list[dict[str, Any]] = []
    for file, part, name, label in zip(files, bodies.parts, bodies.names, labels, strict=True):
        rows.append(
            {
                "id": file if part is None else f"{file}#{part}",
                "name": name,
                "class": label,
                "file": file,
                "part": part,
                **stamps[file],
            }
        )
    for column, values in bodies.columns.items():
        for row, value in zip(rows, values, strict=True):
            row[column] = None if value is None else kinds[column](value)
    return rows


def each_body_once(dataset: SignatureDataset) -> SignatureDataset:
    """Drop bodies that are listed twice because of a symbolic link to a folder; the alphabetically first name stays."""
    bodies = dataset.bodies
    files = zip(_files(bodies), bodies.parts, strict=True)
    first: dict[tuple[str, str | None], int] = {}
    for _, file, i in sorted(zip(bodies.names, files, range(len(bodies)), strict=True)):
        first.setdefault(file, i)
    return dataset.subset(sorted(first.values()))


def _files(bodies: Bodies) -> list[str]:
    resolved = cache(os.path.realpath)
    files = []
    for path in bodies.paths:
        folder, name = os.path.split(path)
        files.append(os.path.join(resolved(folder), name))
    return files


def _stamp(file: Path, reading: LoadOptions) -> dict[str, int]:
    """Return the size and the modification time of the files that are read; time −1 if it is not reliable yet."""
    try:
        n_bytes, *times = stat_key(*dependencies_of(file, reading))
    except (OSError, MeshError):  # the description will fail with the reason
        return {"bytes": -1, "modified": -1}
    modified = max(times)
    is_reliable = time.time_ns() - modified > MIN_AGE
    return {"bytes": n_bytes, "modified": modified if is_reliable else -1}


def checksum_of(dataset: SignatureDataset, i: int) -> str:
    """Return the cache key of a Signature, a checksum of the body and all parameters; "" if the body is unreadable."""
    try:
        return dataset.key(i)
    except MeshError:  # the description will fail with the reason
        return ""


def _described(
    dataset: SignatureDataset,
    descriptor: Descriptor,
    failures: list[Failure] | None,
    n_workers: int | None,
) -> Tensor:
    """Return the descriptions of the bodies that can be described; there may be none."""
    try:
        if len(dataset):
            return describe(dataset, descriptor, failures=failures, n_workers=n_workers)
    except MeshError:
        if failures is None:
            raise
    return torch.zeros(0)

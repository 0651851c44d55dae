"""Bodies become rows of a gallery: described, and with what is known of them."""

import io
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import LABELS_FILE, Bodies, is_number
from igps.gallery.about import KNOWN, Batch
from igps.mesh.formats import files_read, stamp_of
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor
from igps.signature.signature import Signature

# So many descriptions are in memory at once; pixels of a side of a thumbnail, which shows the samples of the surface.
_AT_ONCE, _PIXELS = 256, 40
# A file that was changed so few nanoseconds ago may change again at what the clock calls the same time.
_YOUNG = 2 * 10**9


def described_rows(
    dataset: SignatureDataset, descriptor: Descriptor, kinds: Mapping[str, type], known: Mapping[str, str],
    failures: list[Failure], n_workers: int | None, strict: bool, progress: bool,
) -> Iterator[Batch]:  # fmt: skip
    """Descriptions and rows of the bodies that are not known by their checksums; failures are added to the list."""
    dataset = each_body_once(dataset)
    bodies = dataset.bodies
    with tqdm(desc="descriptions", total=len(dataset), disable=not progress) as bar:
        for start in range(0, len(dataset), _AT_ONCE):
            numbers = range(start, min(start + _AT_ONCE, len(dataset)))
            # Before files are read: one that changes meanwhile is described again next time
            of_each = known_rows(bodies.subset(numbers), kinds, dataset.reading)
            told = dict(zip(numbers, of_each, strict=True))
            keys = {i: checksum_of(dataset, i) for i in numbers}
            new = [i for i in numbers if not keys[i] or known.get(told[i]["id"]) != keys[i]]
            failed: list[Failure] = []
            descriptions = _described(dataset.subset(new), descriptor, None if strict else failed, n_workers)
            lost = {failure.id for failure in failed}
            left = [i for i in new if bodies.names[i] not in lost]
            if left:
                yield descriptions, [{**told[i], **_measured(dataset, i), "checksum": keys[i]} for i in left]
            failures += failed
            bar.update(len(numbers))


def further_columns(bodies: Bodies, there: Mapping[str, type] = KNOWN) -> dict[str, type]:
    """Further columns of the table of labels, and of which type: numbers where all values are, unless text is there.

    Raises:
        ValueError: one has the name of a column that every gallery has, or a name that none can have.
    """
    # One called _rowid would make the gallery unreadable, and a dot means a field within a column
    if wrong := [name for name in bodies.columns if name.startswith("_") or "." in name]:
        told = f"a gallery takes no column whose name has a dot, or begins with an underscore, got {wrong[0]!r}"
        raise ValueError(f"{LABELS_FILE}: {told}. Rename it.")
    if taken := bodies.columns.keys() & {*KNOWN, "vector", "code"}:
        raise ValueError(f"{LABELS_FILE}: every gallery has a column {min(taken)!r}. Give the column another name.")
    texts = {
        name for name, values in bodies.columns.items() if there.get(name) is str or not all(map(is_number, values))
    }
    return {name: str if name in texts else float for name in bodies.columns}


def known_rows(bodies: Bodies, kinds: Mapping[str, type], reading: LoadOptions) -> list[dict[str, Any]]:
    """What is known of bodies without reading their files, which are read by the options."""
    files = _files(bodies)
    labels = bodies.labels or [None] * len(bodies)
    stamps = {file: _stamp(Path(file), reading) for file in set(files)}
    told: list[dict[str, Any]] = []
    for file, part, name, label in zip(files, bodies.parts, bodies.names, labels, strict=True):
        id_ = file if part is None else f"{file}#{part}"
        told.append({"id": id_, "name": name, "class": label, "file": file, "part": part, **stamps[file]})
    for column, values in bodies.columns.items():
        for row, value in zip(told, values, strict=True):
            row[column] = None if value is None else kinds[column](value)
    return told


def each_body_once(dataset: SignatureDataset) -> SignatureDataset:
    """Without what a link to a folder shows again: of the names of a body the first in order stays."""
    bodies = dataset.bodies
    files = list(zip(_files(bodies), bodies.parts, strict=True))
    kept = {files[i]: i for i in sorted(range(len(bodies)), key=bodies.names.__getitem__, reverse=True)}
    return dataset if len(kept) == len(bodies) else dataset.subset(sorted(kept.values()))


def _files(bodies: Bodies) -> list[str]:
    folders = {folder: os.path.realpath(folder) for folder in {os.path.dirname(path) for path in bodies.paths}}
    return [os.path.join(folders[os.path.dirname(path)], os.path.basename(path)) for path in bodies.paths]


def _stamp(file: Path, reading: LoadOptions) -> dict[str, int]:
    """Size and time of the last change of all that is read; −1 where it may change again within a clock's grain."""
    try:
        n_bytes, *times = stamp_of(*files_read(file, reading))
    except (OSError, MeshError):  # describing it will say why
        return {"bytes": -1, "modified": -1}
    changed = max(times)
    return {"bytes": n_bytes, "modified": changed if time.time_ns() - changed > _YOUNG else -1}


def checksum_of(dataset: SignatureDataset, i: int) -> str:
    """A checksum of a body and of all that its Signature depends on; "" where it cannot be read."""
    try:
        return dataset.key(i)
    except MeshError:  # describing it will say why
        return ""


def thumbnail(signature: Signature) -> bytes:
    """A PNG of a body: how near the samples of its surface are, seen along its shortest axis."""
    from matplotlib.image import imsave

    points = np.asarray(signature.surface.points if len(signature.surface) else signature.interior.points, np.float64)
    centred = points - points.mean(axis=0)
    seen = centred @ np.linalg.eigh(centred.T @ centred)[1][:, ::-1]
    span, depth = np.abs(seen[:, :2]).max(initial=1e-300), np.abs(seen[:, 2]).max(initial=1e-300)
    columns, rows = np.rint((seen[:, :2] / span + 1) * (_PIXELS - 1) / 2).astype(int).T
    picture, file = np.zeros((_PIXELS, _PIXELS)), io.BytesIO()
    np.maximum.at(picture, (rows, columns), 0.6 + 0.4 * seen[:, 2] / depth)
    imsave(file, picture, cmap="gray", vmin=0, vmax=1, origin="lower", format="png")
    return file.getvalue()


def _measured(dataset: SignatureDataset, i: int) -> dict[str, Any]:
    signature = dataset[i].signature
    measured = {name: getattr(signature, name) for name in ("area", "volume", "unit")}
    return {**measured, "thumbnail": thumbnail(signature)}


def _described(
    dataset: SignatureDataset, descriptor: Descriptor, failures: list[Failure] | None, n_workers: int | None
) -> Tensor:
    """Descriptions of those of the bodies that can be described, which may be none."""
    try:
        if len(dataset):
            return describe(dataset, descriptor, failures=failures, n_workers=n_workers)
    except MeshError:
        if failures is None:
            raise
    return torch.zeros(0)

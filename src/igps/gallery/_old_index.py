"""The folders that `igps index` wrote, read once to become galleries."""

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igps.data.sources import file_and_part
from igps.gallery._table import alone, exists, write
from igps.gallery.about import MANIFEST, Batch

_ROWS_AT_ONCE = 1024


def convert(path: Path) -> None:
    """Make a gallery of an index beside its files, which are not needed any more; none of its rows tells its size.

    A ValueError where it is damaged.
    """
    with alone(path):
        if not exists(path):  # another process may have been quicker
            write(path, *_read(path), {})


def _read(path: Path) -> tuple[dict[str, Any], Any, Iterator[Batch]]:
    try:
        manifest = json.loads((path / MANIFEST).read_text())
        if manifest["format"] not in ("igps-index-1", "igps-index-2"):
            raise ValueError(f"format {manifest['format']}")
        searched_by = manifest.get("searched_by", manifest.get("comparison"))
        parts = list(_parts(path, manifest))  # whole before anything is written
        return manifest["about"], searched_by, (batch for part in parts for batch in part)
    except (ValueError, KeyError, TypeError, OSError, sqlite3.Error) as error:
        raise ValueError(f"{path}: expected an index of an earlier version, which cannot be read ({error}). "
                         "Build a gallery in a new folder; signatures that are cached serve.") from error  # fmt: skip


def _parts(path: Path, manifest: dict[str, Any]) -> Iterator[Iterator[Batch]]:
    shape = [int(one) for one in manifest["shape"]]
    width = int(np.prod(shape))
    for part in manifest["parts"]:
        folder, n = path / Path(part["folder"]).name, int(part["n"])
        half = width > 1024
        values = np.memmap(folder / "descriptions.raw", "<f2" if half else "<f4", "r", shape=(n, width))
        scales = np.fromfile(folder / "scales.raw", "<f4") if half else np.ones(n, np.float32)
        known = sqlite3.connect(f"{(folder / 'entries.sqlite').absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        known.execute("PRAGMA trusted_schema=OFF")
        rows = known.execute("SELECT id, name, label, mark FROM entry ORDER BY position").fetchall()
        if not n == len(rows) == len(scales):
            raise ValueError(f"{folder.name} is incomplete")
        yield _batches(values, scales, rows, sorted(set(range(n)) - set(part["removed"])), shape)


def _batches(values: Any, scales: Any, rows: list[Any], kept: list[int], shape: list[int]) -> Iterator[Batch]:
    for start in range(0, len(kept), _ROWS_AT_ONCE):
        some, told = kept[start : start + _ROWS_AT_ONCE], []
        for id_, name, label, mark in (rows[i] for i in some):
            file, part = file_and_part(Path(id_))
            told.append({"id": id_, "name": name, "class": label, "file": str(file), "part": part, "checksum": mark})
        descriptions = torch.from_numpy(values[some].astype(np.float32) * scales[some, None])
        yield descriptions.reshape(-1, *shape), told

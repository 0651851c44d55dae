"""How commands read meshes: the options they share, and the signatures these give."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import MeshFiles, find_meshes
from igps.geometry.reading import Component
from igps.geometry.signature import SignatureConfig
from igps.nn.presets import Preset

FLAGS = {
    "paper": "use the parameters of Rustamov 2010: as the defaults, but the grid is never refined",
    "repair": "weld vertices, drop degenerate, duplicate and unused elements, and orient the faces of each mesh",
    "allow_open": "accept surfaces with holes",
    "strict": "stop at the first mesh that cannot be used instead of skipping it",
}
"""Switches of every command that passes its `**reading` on to `signatures`, and what they do."""


def signatures(
    source: Path | Sequence[Path] | MeshFiles,
    cache: Path | None = None,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    paper: bool = False,
    repair: bool = False,
    component: Component | None = None,
    allow_open: bool = False,
    strict: bool = False,
    workers: int | None = None,
) -> tuple[SignatureDataset, list[Failure]]:
    """The meshes whose signatures are in the cache, after computing what was missing; and those that failed.

    The parameters are options of every command that reads meshes.

    Args:
        source: a folder, files, or what was found in a folder.
        cache: folder where computed signatures are kept; the user's cache directory if not given.
        signature: parameters of the signatures.
        component: largest keeps only the largest connected component of each mesh.
        workers: processes that compute signatures; all cores if not given.
        paper, repair, allow_open, strict: see `FLAGS`.

    Raises:
        ValueError: no mesh could be used, or `paper` beside other parameters of the signatures.
    """
    config = _config(signature, paper)
    dataset = SignatureDataset(source, config, cache, repair=repair, component=component, allow_open=allow_open)
    failures = dataset.precompute(n_workers=workers, strict=strict)
    if len(failures) == len(dataset):
        raise ValueError(f"none of {len(dataset)} meshes could be used; the first: {failures[0].error}")
    return dataset.usable(failures), failures


def preset_signatures(
    chosen: Preset,
    source: Path | Sequence[Path] | MeshFiles,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    paper: bool = False,
    **reading: Any,
) -> tuple[SignatureDataset, list[Failure]]:
    """`signatures` that carry what a descriptor needs of them.

    Args:
        chosen: the descriptor.
        source: a folder, files, or what was found in a folder.
        signature: parameters of the signatures.
        paper: see `FLAGS`.
    """
    return signatures(source, signature=chosen.completed(_config(signature, paper)), **reading)


def _config(signature: SignatureConfig, paper: bool) -> SignatureConfig:
    if not paper:
        return signature
    if signature != SignatureConfig():
        raise ValueError("paper: expected no other parameters of the signatures beside it. Leave one out.")
    return SignatureConfig.paper()


def labelled_meshes(root: Path) -> MeshFiles:
    """The meshes of a folder, with their classes.

    Raises:
        ValueError: the folder tells no classes.
    """
    files = find_meshes(root)
    if files.labels is None:
        raise ValueError(f"{root}: no classes found. Expected one folder per class, or a labels.csv (file,label).")
    return files


def write_failures(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a list of failures, or remove the one of an earlier run where there are none."""
    rows = list(rows)
    path.unlink(missing_ok=True)
    if rows:
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(rows)

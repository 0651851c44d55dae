"""What a folder of results holds, read again for its page."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps.retrieval import PrecisionRecallCurve, RetrievalScores, precision_recall_curve, rank, retrieval_scores

_RETRIEVAL, _COMPARISON, _ROBUSTNESS = "distances.npz", "compare.json", "robustness.json"


@dataclass(frozen=True, eq=False)
class System:
    """Distances of one descriptor among the N meshes that it describes.

    Args:
        name: of the descriptor.
        names: of the meshes.
        labels: their classes; None where they are not known.
        distances: (N, N), a row a query.
        seconds_per_mesh: processor time of a description; None where it was not measured.
    """

    name: str
    names: tuple[str, ...]
    labels: tuple[str, ...] | None
    distances: Tensor
    seconds_per_mesh: float | None = None

    def scores(self) -> RetrievalScores | None:
        """Leave-one-out; None where no two meshes share a class."""
        if self.labels is None or len(set(self.labels)) == len(self.labels):
            return None
        return retrieval_scores(self.distances, self.labels)

    def curve(self) -> PrecisionRecallCurve | None:
        """Precision and recall; None where there are no scores."""
        if self.labels is None or len(set(self.labels)) == len(self.labels):
            return None
        return precision_recall_curve(self.distances, self.labels)

    def ranked(self) -> NDArray[np.int64]:
        """(N, N − 1) the other meshes, nearest first, ties in the order of the meshes."""
        n = len(self.names)
        order = rank(self.distances)
        return order[order != torch.arange(n)[:, None]].view(n, max(n - 1, 0)).numpy()


@dataclass(frozen=True)
class Unused:
    """A mesh that a descriptor, or none at all, could use.

    Args:
        file: its name.
        error: why.
        descriptor: None for all.
    """

    file: str
    error: str
    descriptor: str | None = None


@dataclass(frozen=True, eq=False)
class Results:
    """All that a page is made from but pictures.

    Args:
        command: that wrote them.
        names: of all meshes that were used.
        labels: their classes; None where they are not known.
        systems: descriptors with distances.
        rows: the table of `igps compare`, one line a descriptor.
        robustness: robustness.json.
        unused: meshes that could not be used.
        notes: what was done to a mesh, by name.
        config: the parameters.
        parts: of bodies that share their file with others, by name.
        columns: what else is known of the bodies, by column and name of the body.
        groups: the table of `igps groups`, where it wrote to the same folder, a line a body.
        outliers: that of `igps outliers`.
    """

    command: str
    names: tuple[str, ...]
    labels: tuple[str, ...] | None
    systems: tuple[System, ...] = ()
    rows: tuple[Mapping[str, Any], ...] = ()
    robustness: Mapping[str, Any] | None = None
    unused: tuple[Unused, ...] = ()
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, Mapping[str, str | None]] = field(default_factory=dict)
    groups: tuple[Mapping[str, Any], ...] = ()
    outliers: tuple[Mapping[str, Any], ...] = ()


def read_results(folder: Path) -> Results:
    """What `igps retrieve`, `compare` or `robustness` wrote to a folder; of several, the last.

    Raises:
        FileNotFoundError: the folder does not exist, or holds results of none of them.
    """
    readers = {_RETRIEVAL: _retrieval, _COMPARISON: _comparison, _ROBUSTNESS: _robustness}
    written = {name: (folder / name).stat().st_mtime for name in readers if (folder / name).is_file()}
    if not written:
        raise FileNotFoundError(
            f"{folder}: no results found. Expected {', '.join(readers)}, which `igps retrieve`, `igps compare` and "
            "`python -m training.study robustness` write with --out."
        )
    found = readers[max(written, key=lambda name: written[name])](folder)
    about = _json(folder / "meshes.json") or {}
    bodies = about.get("meshes", [])
    return replace(
        found,
        parts={one["file"]: one["part"] for one in bodies if one.get("part")},
        columns={
            name: {one["file"]: value for one, value in zip(bodies, values, strict=True)}
            for name, values in about.get("columns", {}).items()
        },
        groups=tuple(_json(folder / "groups.json") or ()),
        outliers=tuple(_json(folder / "outliers.json") or ()),
    )


def _retrieval(folder: Path) -> Results:
    summary = _json(folder / "scores.json") or {}
    config = dict(summary.get("config", {}))
    system = _system(folder / _RETRIEVAL, str(config.get("descriptor", "descriptor")))
    return Results(
        command="retrieve",
        names=system.names,
        labels=system.labels,
        systems=(system,),
        unused=tuple(Unused(row["file"], row["error"]) for row in _rows(folder / "failures.csv")),
        notes=_notes(folder),
        config=config,
    )


def _comparison(folder: Path) -> Results:
    rows = _json(folder / _COMPARISON)
    systems = []
    for row in rows:
        path = folder / "distances" / f"{row['descriptor']}.npz"
        if row["n_models"] and path.is_file():
            systems.append(_system(path, row["descriptor"], row["seconds_per_mesh"]))
    label_of = {
        name: label for system in systems for name, label in zip(system.names, system.labels or (), strict=False)
    }
    names = tuple(dict.fromkeys(name for system in systems for name in system.names))
    unused = [
        Unused(row["file"], row["error"], None if row["descriptor"] == "all" else row["descriptor"])
        for row in _rows(folder / "failures.csv")
    ]
    return Results(
        command="compare",
        names=names,
        labels=tuple(label_of[name] for name in names) if label_of else None,
        systems=tuple(systems),
        rows=tuple(rows),
        unused=tuple(unused),
        notes=_notes(folder),
        config=(_json(folder / "meshes.json") or {}).get("signature", {}),
    )


def _robustness(folder: Path) -> Results:
    summary = _json(folder / _ROBUSTNESS)
    names: dict[str, None] = {}
    unused: dict[tuple[str, str], Unused] = {}
    for descriptor, movements in summary["movements"].items():
        for column, movement in movements.items():
            if column in summary["disturbances"]:  # the others are of pairs of poses
                names.update(dict.fromkeys([*movement["each"], *movement["notes"]]))
            for file, why in movement["notes"].items():
                unused.setdefault((file, why), Unused(file, f"{column}: {why}", descriptor))
    everywhere = [Unused(row["file"], row["error"]) for row in _rows(folder / "failures.csv")]
    return Results(
        command="robustness",
        names=tuple(names),
        labels=None,
        robustness=summary,
        unused=(*everywhere, *unused.values()),
        notes=_notes(folder),
        config=summary.get("config", {}),
    )


def _system(path: Path, name: str, seconds: float | None = None) -> System:
    with np.load(path) as archive:
        names = tuple(archive["names"].tolist())
        labels = tuple(str(label) for label in archive["labels"].tolist()) if "labels" in archive else ()
        distances = torch.from_numpy(archive["distances"])
    if len(labels) not in (0, len(names)) or distances.shape != (len(names), len(names)):
        raise ValueError(
            f"{path}: expected distances between {len(names)} meshes and as many labels or none, got "
            f"{tuple(distances.shape)} and {len(labels)}. Run the command again."
        )
    return System(name, names, labels or None, distances, seconds)


def _notes(folder: Path) -> dict[str, list[str]]:
    notes: dict[str, list[str]] = {}
    for row in _rows(folder / "notes.csv"):
        notes.setdefault(row["file"], []).append(row["note"])
    return notes


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _json(path: Path) -> Any:
    return json.loads(path.read_text()) if path.is_file() else None

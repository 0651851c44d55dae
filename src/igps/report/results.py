"""What a folder of results holds, read again for its page; and where its meshes lie and how they were read."""

import csv
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Integers
from igps.data.dataset import SignatureDataset
from igps.data.sources import Bodies, file_name_of
from igps.mesh.options import LoadOptions
from igps.retrieval import rank
from igps.signature.signature import SignatureConfig

MESHES_FILE = "meshes.json"
_FORMAT = "igps-meshes-1"
_RETRIEVAL, _COMPARISON, _ROBUSTNESS = "distances.npz", "compare.json", "robustness.json"


@dataclass(frozen=True, eq=False)
class System:
    """Distances of one descriptor among the N meshes that it describes."""

    name: str
    names: tuple[str, ...]
    labels: tuple[str, ...] | None  # None where they are not known
    distances: Tensor  # (N, N), a row a query
    seconds_per_mesh: float | None = None  # of processor time for a description; None where it was not measured

    def ranked(self) -> Integers:
        """(N, N − 1) the other meshes, nearest first, ties in the order of the meshes."""
        n = len(self.names)
        order = rank(self.distances)
        return order[order != torch.arange(n)[:, None]].view(n, max(n - 1, 0)).numpy()


@dataclass(frozen=True)
class Unused:
    """A mesh that one descriptor could not use, or none of them could."""

    file: str
    error: str
    descriptor: str | None = None  # None for all


@dataclass(frozen=True, eq=False)
class Results:
    """All that a page is made from but pictures."""

    command: str  # that wrote them
    names: tuple[str, ...]  # of all meshes that were used
    labels: tuple[str, ...] | None  # None where they are not known
    systems: tuple[System, ...] = ()
    rows: tuple[Mapping[str, Any], ...] = ()  # the table of `igps compare`, one line a descriptor
    robustness: Mapping[str, Any] | None = None  # robustness.json
    unused: tuple[Unused, ...] = ()
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)  # what was done to a mesh, by name
    config: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)  # of bodies that share their file with others, by name
    columns: Mapping[str, Mapping[str, str | None]] = field(default_factory=dict)  # by column and name of the body
    groups: tuple[Mapping[str, Any], ...] = ()  # what `igps groups` wrote to the same folder, a line a body
    outliers: tuple[Mapping[str, Any], ...] = ()  # what `igps outliers` wrote there


def read_results(folder: Path) -> Results:
    """What `igps retrieve`, `compare` or `robustness` wrote to a folder; of several, the last."""
    readers = {_RETRIEVAL: _retrieval, _COMPARISON: _comparison, _ROBUSTNESS: _robustness}
    written = {name: (folder / name).stat().st_mtime for name in readers if (folder / name).is_file()}
    if not written:
        raise FileNotFoundError(
            f"{folder}: no results found. Expected {', '.join(readers)}, which `igps retrieve`, `igps compare` and "
            "`python -m training.study robustness` write with --out."
        )
    about, notes, unused = _json(folder / MESHES_FILE), dict[str, list[str]](), list[Unused]()
    for name, note in map(dict.values, _rows(folder / "notes.csv")):
        notes.setdefault(name, []).append(note)
    for *descriptor, name, error in map(dict.values, _rows(folder / "failures.csv")):
        unused.append(Unused(name, error, None if descriptor in ([], ["all"]) else descriptor[0]))
    found = readers[max(written, key=lambda name: written[name])](folder)
    bodies = about.get("meshes", [])
    return replace(
        found,
        unused=(*unused, *found.unused),
        notes=notes,
        config=found.config or about.get("signature", {}),
        parts={one["file"]: one["part"] for one in bodies if one.get("part")},
        columns={
            name: {one["file"]: value for one, value in zip(bodies, values, strict=True)}
            for name, values in about.get("columns", {}).items()
        },
        groups=tuple(_json(folder / "groups.json")),
        outliers=tuple(_json(folder / "outliers.json")),
    )


def write_sources(folder: Path, dataset: SignatureDataset) -> None:
    """Write meshes.json: of each body its name in the results, file, part, columns; reading, signature, cache."""
    pipeline, files, names = dataset.pipeline, dataset.bodies, dataset.pipeline.reading.names
    summary = {
        "format": _FORMAT,
        "meshes": [
            {"file": name, "path": str(body.path.resolve()), "part": body.part}
            for name, body in zip(files.names, files, strict=True)
        ],
        "columns": files.columns,
        "reading": {**asdict(pipeline.reading), "names": names and os.path.abspath(names)},
        "signature": asdict(pipeline.config),
        "cache_dir": str(pipeline.cache_dir.resolve()),
    }
    (folder / MESHES_FILE).write_text(json.dumps(summary, indent=1) + "\n")


def read_sources(folder: Path, meshes: Path | None = None) -> SignatureDataset | None:
    """The meshes of a folder of results, None where it does not tell them; `meshes` is where they were moved to."""
    path = folder / MESHES_FILE
    if not path.is_file():
        return None
    try:
        summary: dict[str, Any] = json.loads(path.read_text())
        if summary["format"] != _FORMAT:
            raise ValueError(f"its format is {summary['format']!r}")
        names = tuple(str(one["file"]) for one in summary["meshes"])
        parts = tuple(one.get("part") for one in summary["meshes"])
        if meshes is None:
            paths = tuple(Path(one["path"]) for one in summary["meshes"])
        else:
            paths = tuple(meshes / file_name_of(name, part) for name, part in zip(names, parts, strict=True))
        columns = {str(name): tuple(values) for name, values in summary.get("columns", {}).items()}
        bodies, reading = Bodies(paths, names, None, parts, columns), LoadOptions(**summary["reading"])
        return SignatureDataset(bodies, SignatureConfig(**summary["signature"]), summary["cache_dir"], reading=reading)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected the format {_FORMAT} ({error}). Run the command again.") from error


def _retrieval(folder: Path) -> Results:
    config = dict(_json(folder / "scores.json").get("config", {}))
    system = _system(folder / _RETRIEVAL, str(config.get("descriptor", "descriptor")))
    return Results("retrieve", system.names, system.labels, (system,), config=config)


def _comparison(folder: Path) -> Results:
    rows = json.loads((folder / _COMPARISON).read_text())
    systems, label_of = [], dict[str, str]()
    names: dict[str, None] = {}
    for row in rows:
        path = folder / "distances" / f"{row['descriptor']}.npz"
        if row["n_models"] and path.is_file():
            systems.append(system := _system(path, row["descriptor"], row["seconds_per_mesh"]))
            names.update(dict.fromkeys(system.names))
            label_of.update(zip(system.names, system.labels or (), strict=False))
    labels = tuple(label_of[name] for name in names) if label_of else None
    return Results("compare", tuple(names), labels, tuple(systems), rows=tuple(rows))


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
    lost, config = tuple(unused.values()), summary.get("config", {})
    return Results("robustness", tuple(names), None, robustness=summary, unused=lost, config=config)


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


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _json(path: Path) -> Any:
    """What is in a file; an empty dictionary where there is none."""
    return json.loads(path.read_text()) if path.is_file() else {}

"""Reading of a folder of results for its page, and the file that records its meshes and reading options."""

import csv
import json
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
from igps.mesh.loading import BodyRef
from igps.mesh.options import LoadOptions
from igps.retrieval import rank
from igps.signature.signature import SignatureConfig

MESHES_FILE = "meshes.json"
_FORMAT = "igps-meshes-1"
_RETRIEVAL = "distances.npz"
_COMPARISON = "compare.json"


@dataclass(frozen=True, eq=False)
class System:
    """Distances of one descriptor among the N meshes that it describes."""

    name: str  # of the descriptor
    names: tuple[str, ...]  # of the meshes
    labels: tuple[str, ...] | None  # None if unknown
    distances: Tensor  # (N, N), rows are queries
    # Mean processor time of a description; None if it was not measured
    seconds_per_mesh: float | None = None

    def ranked(self) -> Integers:
        """Return the indices (N, N − 1) of the other meshes, nearest first, ties in the order of the meshes."""
        n = len(self.names)
        order = rank(self.distances)
        is_other = order != torch.arange(n)[:, None]
        return order[is_other].view(n, max(n - 1, 0)).numpy()


@dataclass(frozen=True)
class Unused:
    """A mesh that a descriptor, or every descriptor, could not use."""

    file: str
    error: str
    descriptor: str | None = None  # None for all


@dataclass(frozen=True, eq=False)
class Results:
    """Contents of a page, without its surfaces."""

    command: str  # command that wrote the results
    names: tuple[str, ...]  # of all meshes that were used
    labels: tuple[str, ...] | None  # None if unknown
    systems: tuple[System, ...] = ()
    rows: tuple[Mapping[str, Any], ...] = ()  # table of `igps compare`, one row per descriptor
    unused: tuple[Unused, ...] = ()
    # Notes on the mending of meshes, by name
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    # Parts of bodies that share their file, by name
    parts: Mapping[str, str] = field(default_factory=dict)
    # By column and name of the body
    columns: Mapping[str, Mapping[str, str | None]] = field(default_factory=dict)
    # Results of `igps groups` in the same folder, one row per body
    groups: tuple[Mapping[str, Any], ...] = ()
    outliers: tuple[Mapping[str, Any], ...] = ()  # results of `igps outliers` in the same folder


def read_results(folder: Path) -> Results:
    """Read the results that `igps retrieve` or `compare` wrote to a folder; the latest, if several."""
    readers = {
        _RETRIEVAL: _read_retrieval,
        _COMPARISON: _read_comparison,
    }
    found = [folder / name for name in readers if (folder / name).is_file()]
    if not found:
        raise FileNotFoundError(
            f"{folder}: no results found. Expected {', '.join(readers)}, which `igps retrieve` and "
            "`igps compare` write with --out."
        )
    latest = max(found, key=lambda path: path.stat().st_mtime)
    results = readers[latest.name](folder)
    notes: dict[str, list[str]] = {}
    for row in _read_rows(folder / "notes.csv"):
        name, note = row.values()
        notes.setdefault(name, []).append(note)
    unused = []
    for row in _read_rows(folder / "failures.csv"):
        *descriptor, name, error = row.values()
        concerns_all = descriptor in ([], ["all"])
        unused.append(Unused(name, error, None if concerns_all else descriptor[0]))
    sources = _read_json(folder / MESHES_FILE)
    bodies = sources.get("meshes", [])
    names = [body["file"] for body in bodies]
    columns = {}
    for title, values in sources.get("columns", {}).items():
        columns[title] = dict(zip(names, values, strict=True))
    return replace(
        results,
        unused=tuple(unused),
        notes=notes,
        config=results.config or sources.get("signature", {}),
        parts={body["file"]: body["part"] for body in bodies if body.get("part")},
        columns=columns,
        groups=tuple(_read_json(folder / "groups.json")),
        outliers=tuple(_read_json(folder / "outliers.json")),
    )


def write_sources(folder: Path, dataset: SignatureDataset) -> None:
    """Write meshes.json: names, paths, parts and columns of the bodies, reading options, configuration, and cache."""
    pipeline = dataset.pipeline
    bodies = dataset.bodies
    meshes = []
    for name, body in zip(bodies.names, bodies, strict=True):
        meshes.append(
            {
                "file": name,
                "path": str(body.path.resolve()),
                "part": body.part,
                "number": body.number,
            }
        )
    reading = asdict(pipeline.reading)
    reading["names"] = pipeline.reading.names_anywhere
    summary = {
        "format": _FORMAT,
        "meshes": meshes,
        "columns": bodies.columns,
        "reading": reading,
        "signature": asdict(pipeline.config),
        "cache_dir": str(pipeline.cache_dir.resolve()),
    }
    (folder / MESHES_FILE).write_text(json.dumps(summary, indent=1) + "\n")


def read_sources(folder: Path, meshes: Path | None = None) -> SignatureDataset | None:
    """Return the dataset of a folder of results; None without meshes.json. Meshes that were moved lie in `meshes`.

    Raises:
        ValueError: meshes.json has another format.
    """
    path = folder / MESHES_FILE
    if not path.is_file():
        return None
    try:
        summary: dict[str, Any] = json.loads(path.read_text())
        if summary["format"] != _FORMAT:
            raise ValueError(f"its format is {summary['format']!r}")
        refs = []
        names = []
        for mesh in summary["meshes"]:
            name = str(mesh["file"])
            part = mesh.get("part")
            path = Path(mesh["path"]) if meshes is None else meshes / file_name_of(name, part)
            refs.append(BodyRef(path, part, mesh.get("number")))
            names.append(name)
        columns = {}
        for title, values in summary.get("columns", {}).items():
            columns[str(title)] = tuple(values)
        return SignatureDataset(
            Bodies(tuple(refs), tuple(names), None, columns),
            SignatureConfig(**summary["signature"]),
            summary["cache_dir"],
            reading=LoadOptions(**summary["reading"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: expected the format {_FORMAT} ({error}). Run the command again."
        ) from error


def _read_retrieval(folder: Path) -> Results:
    config = dict(_read_json(folder / "scores.json").get("config", {}))
    name = str(config.get("descriptor", "descriptor"))
    system = _read_system(folder / _RETRIEVAL, name)
    return Results("retrieve", system.names, system.labels, (system,), config=config)


def _read_comparison(folder: Path) -> Results:
    rows = json.loads((folder / _COMPARISON).read_text())
    systems = []
    for row in rows:
        name = row["descriptor"]
        path = folder / "distances" / f"{name}.npz"
        if row["n_models"] and path.is_file():
            systems.append(_read_system(path, name, row["seconds_per_mesh"]))
    names: dict[str, None] = {}  # in the order of their first mention
    label_of: dict[str, str] = {}
    for system in systems:
        names.update(dict.fromkeys(system.names))
        label_of.update(zip(system.names, system.labels or (), strict=False))
    labels = tuple(label_of[name] for name in names) if label_of else None
    return Results("compare", tuple(names), labels, tuple(systems), rows=tuple(rows))


def _read_system(path: Path, name: str, seconds: float | None = None) -> System:
    labels: tuple[str, ...] = ()
    with np.load(path) as archive:
        names = tuple(archive["names"].tolist())
        if "labels" in archive:
            labels = tuple(map(str, archive["labels"].tolist()))
        distances = torch.from_numpy(archive["distances"])
    n = len(names)
    if len(labels) not in (0, n) or distances.shape != (n, n):
        raise ValueError(
            f"{path}: expected distances and labels (or no labels) of {n} meshes, got distances "
            f"{tuple(distances.shape)} and {len(labels)} labels. Run the command again."
        )
    return System(name, names, labels or None, distances, seconds)


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file; an empty list if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _read_json(path: Path) -> Any:
    """Return the contents of a JSON file; an empty dictionary if there is no file."""
    return json.loads(path.read_text()) if path.is_file() else {}

"""`igps robustness`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from igps import baselines
from igps.baselines import Body, System
from igps.cli.reading import labelled_meshes, signatures
from igps.data.dataset import SignatureDataset, n_cores, process_pool
from igps.data.sources import MeshFiles, find_meshes
from igps.geometry.disturbances import DISTURBANCES
from igps.geometry.signature import compute_signature

_POSE = "pose"


@dataclass(frozen=True)
class Movement:
    """How far a description moves.

    Args:
        distances: of each mesh or pair by name, over the median distance between classes.
        notes: why others are missing, by name.
    """

    distances: Mapping[str, float]
    notes: Mapping[str, str]

    @property
    def mean(self) -> float | None:
        """Mean of the distances; None if there are none."""
        return float(np.mean(list(self.distances.values()))) if self.distances else None


def robustness(
    meshes: list[Path],
    descriptors: list[str] | None = None,
    gallery: Path | None = None,
    poses: Path | None = None,
    out: Path | None = None,
    workers: int | None = None,
    **reading: Any,
) -> None:
    """Measure how far the description of each retrieval system moves when a mesh is disturbed, and print a table.

    A movement is the distance between the descriptions of a mesh before and after, in percent of the system's median
    distance between meshes of different classes. It is 0 for what the system does not notice, and 100 where a mesh ends
    as far away as a typical mesh of another class.

    Args:
        meshes: the mesh files to disturb.
        descriptors: names of the systems; all if not given.
        gallery: labelled folder that tells the distance between classes; if not given, each of the meshes is a class.
        poses: folder with meshes of one body, for the movement between any two of them.
        out: folder for robustness.json.
        workers: processes that compute; all cores if not given.
    """
    systems = baselines.systems(descriptors)
    dataset, failures = signatures(meshes, workers=workers, **reading)
    if gallery is None and len(dataset) < 2:
        raise ValueError("meshes: expected at least two, each its own class, or a gallery. Give one of them.")
    found = list(_described(dataset, systems, workers))
    if gallery is None:
        units = {name: _between_meshes(system, [of[None][name] for of in found]) for name, system in systems.items()}
    else:
        units = _between_classes(labelled_meshes(gallery), systems, workers, reading)
    table = {name: _movements(system, name, dataset, found, units[name]) for name, system in systems.items()}
    if poses is not None:
        for name, movement in _between_poses(find_meshes(poses), systems, units, workers, reading).items():
            table[name][_POSE] = movement
    print(format_table(table))
    for failure in failures:
        print(f"not used: {failure.error}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _write(out / "robustness.json", table, units, dataset)
        print(f"written to {out}")


def format_table(table: Mapping[str, Mapping[str, Movement]]) -> str:
    """The mean movements in percent, one line a system and one column a disturbance, and what the columns mean."""
    columns = list(next(iter(table.values())))
    width = max(len(name) for name in table)
    lines = [" " * width + "".join(f"{column:>9}" for column in columns)]
    notes = []
    for name, movements in table.items():
        means = [movements[column].mean for column in columns]
        lines.append(f"{name:<{width}}" + "".join(f"{'-' if x is None else f'{100 * x:.1f}':>9}" for x in means))
        for column in columns:
            missing = movements[column].notes
            if missing:
                first = next(iter(missing.values()))
                notes.append(f"{name}, {column}: {len(missing)} of {_total(movements[column])} missing; {first}")
    lines.append("mean movement in percent of the median distance between classes")
    lines += [f"  {column}: {DISTURBANCES[column].description}" for column in columns if column in DISTURBANCES]
    if _POSE in columns:
        lines.append(f"  {_POSE}: from one pose of a body to another, over all pairs")
    return "\n".join(lines + notes)


def _total(movement: Movement) -> int:
    return len(movement.distances) + len(movement.notes)


Description = NDArray[np.float32] | str
"""What a system says of a body, or why it says nothing."""


@dataclass(frozen=True, eq=False)
class _Job:
    """One mesh, disturbed or not, for all systems."""

    dataset: SignatureDataset
    disturbance: str | None
    systems: Mapping[str, System]


def _describe(job: _Job) -> dict[str, Description]:
    """The description by every system; errors become notes, because one system must not stop the others."""
    try:
        if job.disturbance is None:
            body = Body(job.dataset[0].signature, lambda: job.dataset.mesh(0))
        else:
            mesh = DISTURBANCES[job.disturbance].apply(job.dataset.mesh(0))
            body = Body(compute_signature(mesh, job.dataset.config), lambda: mesh)
    except Exception as error:
        return dict.fromkeys(job.systems, _said(error))
    descriptions: dict[str, Description] = {}
    for name, system in job.systems.items():
        try:
            description = np.asarray(system.describe(body), dtype=np.float32)
            finite = bool(np.isfinite(description).all())
            descriptions[name] = description if finite else "the description has entries that are not finite."
        except Exception as error:
            descriptions[name] = _said(error)
    return descriptions


def _said(error: Exception) -> str:
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


def _described(
    dataset: SignatureDataset, systems: Mapping[str, System], workers: int | None
) -> Iterator[dict[str | None, dict[str, Description]]]:
    """Of each mesh, what all systems say of it undisturbed (None) and after each disturbance."""
    ways: tuple[str | None, ...] = (None, *DISTURBANCES)
    jobs = [_Job(dataset.subset([i]), way, systems) for i in range(len(dataset)) for way in ways]
    n_workers = min(workers or n_cores(), len(jobs))
    with tqdm(total=len(jobs), desc="disturbed meshes") as bar:
        done = []
        for outcome in _map(jobs, n_workers):
            bar.update()
            done.append(outcome)
            if len(done) == len(ways):
                yield dict(zip(ways, done, strict=True))
                done = []


def _map(jobs: Sequence[_Job], n_workers: int) -> Iterator[dict[str, Description]]:
    if n_workers == 1:
        yield from map(_describe, jobs)
        return
    with process_pool(n_workers) as pool:
        yield from pool.map(_describe, jobs)


def _movements(
    system: System,
    name: str,
    dataset: SignatureDataset,
    found: Sequence[Mapping[str | None, Mapping[str, Description]]],
    unit: float,
) -> dict[str, Movement]:
    """The movement by each disturbance."""
    result = {}
    for way in DISTURBANCES:
        distances: dict[str, float] = {}
        notes: dict[str, str] = {}
        for mesh, descriptions in zip(dataset.files.names, found, strict=True):
            before, after = descriptions[None][name], descriptions[way][name]
            if isinstance(before, str) or isinstance(after, str):
                notes[mesh] = before if isinstance(before, str) else str(after)
            else:
                distances[mesh] = _distance(system, before, after)
        result[way] = _movement(distances, notes, unit)
    return result


def _distance(system: System, one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    with torch.inference_mode():
        return float(system.distances(torch.from_numpy(one)[None], torch.from_numpy(other)[None]))


def _between_meshes(system: System, descriptions: Sequence[Description]) -> float:
    """Median distance between any two of the descriptions that are there; NaN without two."""
    there = [description for description in descriptions if not isinstance(description, str)]
    pairs = [_distance(system, one, other) for i, one in enumerate(there) for other in there[i + 1 :]]
    return float(np.median(pairs)) if pairs else np.nan


def _between_classes(
    files: MeshFiles, systems: Mapping[str, System], workers: int | None, reading: Mapping[str, Any]
) -> dict[str, float]:
    """Median distance of each system between meshes of different classes; NaN where there is none."""
    dataset, _ = signatures(files, workers=workers, **reading)
    units = {}
    for result in baselines.compare(dataset, systems, n_workers=workers):
        labels = np.array(result.labels)
        other = labels[:, None] != labels[None, :]
        there = result.distances is not None and other.any()
        units[result.name] = float(np.median(np.asarray(result.distances)[other])) if there else np.nan
    return units


def _between_poses(
    files: MeshFiles,
    systems: Mapping[str, System],
    units: Mapping[str, float],
    workers: int | None,
    reading: Mapping[str, Any],
) -> dict[str, Movement]:
    """The movement of each system between any two meshes of one body; a class is a body where there are classes."""
    files = MeshFiles(files.paths, files.names, files.labels or ("body",) * len(files))
    dataset, unread = signatures(files, workers=workers, **reading)
    movements = {}
    for result in baselines.compare(dataset, systems, n_workers=workers):
        notes = {failure.id: failure.error for failure in (*unread, *result.failures)}
        distances = {}
        for i, label in enumerate(result.labels if result.distances is not None else ()):
            for j in range(i):
                if result.labels[j] == label:
                    pair = f"{result.names[j]} - {result.names[i]}"
                    distances[pair] = float(np.asarray(result.distances)[j, i])
        movements[result.name] = _movement(distances, notes, units[result.name])
    return movements


def _movement(distances: Mapping[str, float], notes: Mapping[str, str], unit: float) -> Movement:
    """The distances over their unit."""
    if not unit > 0:
        reason = "there is no distance between classes to compare with."
        return Movement({}, {**dict.fromkeys(distances, reason), **notes})
    return Movement({name: distance / unit for name, distance in distances.items()}, notes)


def _write(
    path: Path, table: Mapping[str, Mapping[str, Movement]], units: Mapping[str, float], dataset: SignatureDataset
) -> None:
    summary = {
        "disturbances": {name: disturbance.description for name, disturbance in DISTURBANCES.items()},
        "median_between_classes": {name: unit if unit > 0 else None for name, unit in units.items()},
        "movements": {
            name: {
                column: {"mean": movement.mean, "each": dict(movement.distances), "notes": dict(movement.notes)}
                for column, movement in movements.items()
            }
            for name, movements in table.items()
        },
        "config": dataset.config.as_dict(),
    }
    path.write_text(json.dumps(summary, indent=2) + "\n")

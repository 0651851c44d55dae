"""How far descriptions move when a mesh is disturbed, or a body takes another pose."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igps._arrays import Singles
from igps.analysis.comparison import check_descriptors, compare
from igps.cli.reading import signatures, write_notes
from igps.cli.report import check_report
from igps.cli.report import report as write_report
from igps.data.dataset import SignatureDataset
from igps.data.sources import Bodies, find_bodies
from igps.descriptors import NAMES
from igps.descriptors import descriptor as descriptor_of
from igps.nn.descriptor import Descriptor
from igps.report.results import write_sources
from igps.report.tables import write_rows
from training.studies.altered import Answer, Way, describe_altered
from training.studies.disturbances import DISTURBANCES

POSE = "pose"
"""The column of the movement between poses of one body."""

_AS_IT_IS = "as it is"


@dataclass(frozen=True)
class Movement:
    """How far a description moves."""

    distances: Mapping[str, float]  # of each mesh or pair by name, over the median distance between classes
    notes: Mapping[str, str]  # why others are missing, by name

    @property
    def mean(self) -> float | None:
        """Mean of the distances; None if there are none."""
        return float(np.mean(list(self.distances.values()))) if self.distances else None


@dataclass(frozen=True)
class Robustness:
    """How far each descriptor moves."""

    movements: Mapping[str, Mapping[str, Movement]]  # by descriptor, then by disturbance or `POSE`
    units: Mapping[str, float]  # the median distance between classes of each descriptor; NaN where there is none

    def as_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        return {
            "disturbances": {name: disturbance.description for name, disturbance in DISTURBANCES.items()},
            "median_between_classes": {name: unit if unit > 0 else None for name, unit in self.units.items()},
            "movements": {
                name: {
                    column: {"mean": movement.mean, "each": dict(movement.distances), "notes": dict(movement.notes)}
                    for column, movement in movements.items()
                }
                for name, movements in self.movements.items()
            },
        }


def robustness(
    dataset: SignatureDataset,
    descriptors: Sequence[Descriptor],
    *,
    gallery: SignatureDataset | None = None,
    poses: SignatureDataset | None = None,
    n_workers: int | None = None,
) -> Robustness:
    """Disturb each mesh in every way of `DISTURBANCES`, and measure how far its descriptions move.

    A movement is the distance between the descriptions of a mesh before and after, over the descriptor's median
    distance between meshes of different classes.

    Args:
        dataset: the meshes to disturb, their signatures with all that the descriptors need.
        descriptors: to be measured.
        gallery: labelled meshes that tell the distance between classes; if None, each of the meshes is a class.
        poses: meshes whose classes are bodies, for the movement between any two of one body; without classes they are
            all one body.
        n_workers: processes; all cores if None.

    Raises:
        ValueError: fewer than two meshes and no gallery, two descriptors of one name, or signatures that
            lack what one needs.
    """
    check_descriptors(descriptors, dataset)
    if gallery is None and len(dataset) < 2:
        raise ValueError("dataset: expected at least two meshes, each its own class, or a gallery. Give one of them.")
    ways: dict[str, Way | None] = {_AS_IT_IS: None, **{name: one.apply for name, one in DISTURBANCES.items()}}
    found = describe_altered(dataset, ways, descriptors, n_workers=n_workers)
    if gallery is None:
        units = {one.name: _between_meshes(one, [of[_AS_IT_IS][one.name] for of in found]) for one in descriptors}
    else:
        units = _between_classes(gallery, descriptors, n_workers)
    table = {one.name: _movements(one, dataset.bodies.names, found, units[one.name]) for one in descriptors}
    if poses is not None:
        for name, movement in _between_poses(poses, descriptors, units, n_workers).items():
            table[name][POSE] = movement
    return Robustness(table, units)


def _movements(
    descriptor: Descriptor,
    names: Sequence[str],
    found: Sequence[Mapping[str, Mapping[str, Answer]]],
    unit: float,
) -> dict[str, Movement]:
    """The movement by each disturbance."""
    result = {}
    for way in DISTURBANCES:
        distances: dict[str, float] = {}
        notes: dict[str, str] = {}
        for mesh, descriptions in zip(names, found, strict=True):
            before, after = descriptions[_AS_IT_IS][descriptor.name], descriptions[way][descriptor.name]
            if isinstance(before, str) or isinstance(after, str):
                notes[mesh] = before if isinstance(before, str) else str(after)
            else:
                distances[mesh] = _distance(descriptor, before, after)
        result[way] = _movement(distances, notes, unit)
    return result


def _distance(descriptor: Descriptor, one: Singles, other: Singles) -> float:
    with torch.inference_mode():
        return float(descriptor.distances(torch.from_numpy(one)[None], torch.from_numpy(other)[None]))


def _between_meshes(descriptor: Descriptor, descriptions: Sequence[Answer]) -> float:
    """Median distance between any two of the descriptions that are there; NaN without two."""
    there = [description for description in descriptions if not isinstance(description, str)]
    pairs = [_distance(descriptor, one, other) for i, one in enumerate(there) for other in there[i + 1 :]]
    return float(np.median(pairs)) if pairs else np.nan


def _between_classes(
    gallery: SignatureDataset, descriptors: Sequence[Descriptor], n_workers: int | None
) -> dict[str, float]:
    """Median distance of each descriptor between meshes of different classes; NaN where there is none."""
    units = {}
    for result in compare(gallery, descriptors, n_workers=n_workers):
        labels = np.array(result.labels)
        other = labels[:, None] != labels[None, :]
        there = result.distances is not None and other.any()
        units[result.descriptor.name] = float(np.median(np.asarray(result.distances)[other])) if there else np.nan
    return units


def _between_poses(
    poses: SignatureDataset, descriptors: Sequence[Descriptor], units: Mapping[str, float], n_workers: int | None
) -> dict[str, Movement]:
    """The movement of each descriptor between any two meshes of one body."""
    movements = {}
    for result in compare(poses, descriptors, n_workers=n_workers):
        notes = {failure.id: failure.error for failure in result.failures}
        distances = {}
        for i, label in enumerate(result.labels if result.distances is not None else ()):
            for j in range(i):
                if result.labels[j] == label:
                    pair = f"{result.names[j]} - {result.names[i]}"
                    distances[pair] = float(np.asarray(result.distances)[j, i])
        movements[result.descriptor.name] = _movement(distances, notes, units[result.descriptor.name])
    return movements


def _movement(distances: Mapping[str, float], notes: Mapping[str, str], unit: float) -> Movement:
    """The distances over their unit."""
    if not unit > 0:
        reason = "there is no distance between classes to compare with."
        return Movement({}, {**dict.fromkeys(distances, reason), **notes})
    return Movement({name: distance / unit for name, distance in distances.items()}, notes)


def robustness_table(table: Mapping[str, Mapping[str, Movement]]) -> str:
    """The mean movements in percent, one line a descriptor and one column a disturbance, and what the columns mean."""
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
                n_all = len(movements[column].distances) + len(missing)
                notes.append(f"{name}, {column}: {len(missing)} of {n_all} missing; {first}")
    lines.append("mean movement in percent of the median distance between classes")
    lines += [f"  {column}: {DISTURBANCES[column].description}" for column in columns if column in DISTURBANCES]
    if POSE in columns:
        lines.append(f"  {POSE}: from one pose of a body to another, over all pairs")
    return "\n".join(lines + notes)


def robustness_command(
    meshes: list[Path],
    descriptors: list[str] = [*NAMES],  # noqa: B006 (only read)
    gallery: Path | None = None,
    poses: Path | None = None,
    out: Path | None = None,
    report: bool = False,
    n_workers: int | None = None,
    **reading: Any,
) -> dict[str, Any]:
    """Measure how far the description of each descriptor moves when a mesh is disturbed, and print a table.

    A movement is the distance between the descriptions of a mesh before and after, in percent of the descriptor's
    median distance between meshes of different classes. It is 0 for what the descriptor does not notice, and 100 where
    a mesh ends as far away as a typical mesh of another class.

    Args:
        meshes: the mesh files to disturb.
        descriptors: names, or package.module:NAME of your own.
        gallery: labelled folder that tells the distance between classes; if not given, each of the meshes is a class.
        poses: folder with meshes of one body, for the movement between any two of them.
        out: folder for robustness.json, meshes.json that tells where the meshes lie, notes.csv of what was done to
            which mesh, and failures.csv if a mesh could not be used.
        report: make a page of the results in that folder, report.html, see `igps report`
        n_workers: processes that compute; all cores if not given.
    """
    check_report(report, out)
    chosen = [descriptor_of(name) for name in descriptors]
    reading["n_workers"] = n_workers
    dataset, failures = signatures(meshes, chosen, **reading)
    between, of_poses = None, None
    if gallery is not None:
        between, _ = signatures(find_bodies(gallery, labelled=True), chosen, **reading)
    if poses is not None:
        files = find_bodies(poses)
        bodies = Bodies(files.paths, files.names, files.labels or ("body",) * len(files))
        of_poses, unread = signatures(bodies, chosen, **reading)
        failures = [*failures, *unread]
    found = robustness(dataset, chosen, gallery=between, poses=of_poses, n_workers=n_workers)
    print(robustness_table(found.movements))
    for failure in failures:
        print(f"not used: {failure.error}")
    summary = {**found.as_dict(), "config": dataset.config.as_dict()}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "robustness.json").write_text(json.dumps(summary, indent=2) + "\n")
        write_notes(out / "notes.csv", dataset)
        write_rows(out / "failures.csv", ("name", "error"), [(failure.id, failure.error) for failure in failures])
        write_sources(out, dataset)
        print(f"written to {out}")
        if report:
            write_report(out, n_workers=n_workers)
    return summary

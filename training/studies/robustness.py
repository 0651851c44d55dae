"""Movement of descriptions when a mesh is disturbed, or when a body takes another pose."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igps._arrays import Singles
from igps.analysis.comparison import check_descriptors, compare
from igps.cli.reading import signatures, write_mending_notes
from igps.cli.report import check_report_folder
from igps.cli.report import report as write_report
from igps.data.dataset import SignatureDataset
from igps.data.sources import Bodies, find_bodies
from igps.descriptors import NAMES
from igps.descriptors import descriptor as descriptor_of
from igps.nn.descriptor import Descriptor
from igps.report.results import write_sources
from igps.report.tables import write_rows
from training.studies.altered import Alteration, Answer, describe_altered
from training.studies.disturbances import DISTURBANCES

POSE = "pose"
"""Name of the column of the movement between poses of one body."""

_UNCHANGED = "unchanged"


@dataclass(frozen=True)
class Movement:
    """Movements of the descriptions of meshes."""

    distances: Mapping[str, float]  # by mesh or pair, over the median distance between classes
    notes: Mapping[str, str]  # why other meshes or pairs are missing, by name

    @property
    def mean(self) -> float | None:
        """The mean of the distances; None if there are none."""
        return float(np.mean(list(self.distances.values()))) if self.distances else None


@dataclass(frozen=True)
class Robustness:
    """Movements by descriptor."""

    movements: Mapping[str, Mapping[str, Movement]]  # by descriptor, then by disturbance or `POSE`
    units: Mapping[str, float]  # median distance between classes by descriptor; NaN if unknown

    def as_dict(self) -> dict[str, Any]:
        """Return a dict for a JSON file."""
        return {
            "disturbances": {
                name: disturbance.description for name, disturbance in DISTURBANCES.items()
            },
            "median_between_classes": {
                name: unit if unit > 0 else None for name, unit in self.units.items()
            },
            "movements": {
                name: {
                    column: {
                        "mean": movement.mean,
                        "each": dict(movement.distances),
                        "notes": dict(movement.notes),
                    }
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
        dataset: meshes to disturb, with signatures that meet the requirements of the descriptors.
        descriptors: descriptors to measure.
        gallery: labelled meshes by which the distance between classes is measured; if None, each mesh of `dataset` is a
            class.
        poses: meshes for the movement between poses, with bodies as classes; without classes, all are poses of one
            body.
        n_workers: number of processes; all cores if None.

    Raises:
        ValueError: fewer than two meshes without a gallery, two descriptors of the same name, or signatures that do not
            meet the requirements of a descriptor.
    """
    check_descriptors(descriptors, dataset)
    if gallery is None and len(dataset) < 2:
        raise ValueError(
            "dataset: expected at least two meshes, each its own class, or a gallery. Give one of them."
        )
    alterations: dict[str, Alteration | None] = {
        _UNCHANGED: None,
        **{name: kind.apply for name, kind in DISTURBANCES.items()},
    }
    answers = describe_altered(dataset, alterations, descriptors, n_workers=n_workers)
    if gallery is None:
        units = {
            x.name: _between_meshes(x, [row[_UNCHANGED][x.name] for row in answers])
            for x in descriptors
        }
    else:
        units = _between_classes(gallery, descriptors, n_workers)
    table = {
        x.name: _movements(x, dataset.bodies.names, answers, units[x.name]) for x in descriptors
    }
    if poses is not None:
        for name, movement in _between_poses(poses, descriptors, units, n_workers).items():
            table[name][POSE] = movement
    return Robustness(table, units)


def _movements(
    descriptor: Descriptor,
    names: Sequence[str],
    answers: Sequence[Mapping[str, Mapping[str, Answer]]],
    unit: float,
) -> dict[str, Movement]:
    """Return the movement of a descriptor by each disturbance."""
    result = {}
    for disturbance in DISTURBANCES:
        distances: dict[str, float] = {}
        notes: dict[str, str] = {}
        for mesh, descriptions in zip(names, answers, strict=True):
            before, after = (
                descriptions[_UNCHANGED][descriptor.name],
                descriptions[disturbance][descriptor.name],
            )
            if isinstance(before, str) or isinstance(after, str):
                notes[mesh] = before if isinstance(before, str) else str(after)
            else:
                distances[mesh] = _distance(descriptor, before, after)
        result[disturbance] = _movement(distances, notes, unit)
    return result


def _distance(descriptor: Descriptor, first: Singles, second: Singles) -> float:
    with torch.inference_mode():
        return float(
            descriptor.distances(torch.from_numpy(first)[None], torch.from_numpy(second)[None])
        )


def _between_meshes(descriptor: Descriptor, descriptions: Sequence[Answer]) -> float:
    """Return the median distance between descriptions; NaN if fewer than two meshes could be described."""
    described = [description for description in descriptions if not isinstance(description, str)]
    distances = [
        _distance(descriptor, first, second) for first, second in combinations(described, 2)
    ]
    return float(np.median(distances)) if distances else np.nan


def _between_classes(
    gallery: SignatureDataset, descriptors: Sequence[Descriptor], n_workers: int | None
) -> dict[str, float]:
    """Return the median distance of each descriptor between meshes of different classes; NaN if there is none."""
    units = {}
    for result in compare(gallery, descriptors, n_workers=n_workers):
        labels = np.array(result.labels)
        differs = labels[:, None] != labels[None, :]
        is_known = result.distances is not None and differs.any()
        units[result.descriptor.name] = (
            float(np.median(np.asarray(result.distances)[differs])) if is_known else np.nan
        )
    return units


def _between_poses(
    poses: SignatureDataset,
    descriptors: Sequence[Descriptor],
    units: Mapping[str, float],
    n_workers: int | None,
) -> dict[str, Movement]:
    """Return the movement of each descriptor between any two meshes of the same body."""
    movements = {}
    for result in compare(poses, descriptors, n_workers=n_workers):
        notes = {failure.id: failure.error for failure in result.failures}
        distances = {}
        for i, label in enumerate(result.labels if result.distances is not None else ()):
            for j in range(i):
                if result.labels[j] == label:
                    pair = f"{result.names[j]} - {result.names[i]}"
                    distances[pair] = float(np.asarray(result.distances)[j, i])
        movements[result.descriptor.name] = _movement(
            distances, notes, units[result.descriptor.name]
        )
    return movements


def _movement(distances: Mapping[str, float], notes: Mapping[str, str], unit: float) -> Movement:
    """Divide distances by their unit."""
    if not unit > 0:
        reason = "there is no distance between classes to compare with."
        return Movement({}, {**dict.fromkeys(distances, reason), **notes})
    return Movement({name: distance / unit for name, distance in distances.items()}, notes)


def robustness_table(table: Mapping[str, Mapping[str, Movement]]) -> str:
    """Format the mean movements in percent, by descriptor and disturbance, followed by the meaning of the columns."""
    columns = list(next(iter(table.values())))
    width = max(len(name) for name in table)
    lines = [" " * width + "".join(f"{column:>9}" for column in columns)]
    notes = []
    for name, movements in table.items():
        means = [movements[column].mean for column in columns]
        lines.append(
            f"{name:<{width}}"
            + "".join(f"{'-' if x is None else f'{100 * x:.1f}':>9}" for x in means)
        )
        for column in columns:
            missing = movements[column].notes
            if missing:
                first = next(iter(missing.values()))
                n_all = len(movements[column].distances) + len(missing)
                notes.append(f"{name}, {column}: {len(missing)} of {n_all} missing; {first}")
    lines.append("mean movement in percent of the median distance between classes")
    lines += [
        f"  {column}: {DISTURBANCES[column].description}"
        for column in columns
        if column in DISTURBANCES
    ]
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
    median distance between meshes of different classes. It is 0 if the descriptor is invariant, and 100 if the mesh
    moves as far as to a typical mesh of another class.

    Args:
        meshes: the mesh files to disturb.
        descriptors: names, or package.module:NAME of your own.
        gallery: labelled folder by which the distance between classes is measured; if not given, each mesh is a class.
        poses: folder with meshes of one body in several poses.
        out: folder for robustness.json, meshes.json with the paths of the meshes, notes.csv with the changes made to
            them, and failures.csv with the meshes that could not be used.
        report: make a page of the results in that folder, report.html, see `igps report`
        n_workers: number of processes; all cores if not given.
    """
    check_report_folder(report, out)
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
    result = robustness(dataset, chosen, gallery=between, poses=of_poses, n_workers=n_workers)
    print(robustness_table(result.movements))
    for failure in failures:
        print(f"not used: {failure.error}")
    summary = {**result.as_dict(), "config": dataset.config.as_dict()}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "robustness.json").write_text(json.dumps(summary, indent=2) + "\n")
        write_mending_notes(out / "notes.csv", dataset)
        write_rows(
            out / "failures.csv",
            ("name", "error"),
            [(failure.id, failure.error) for failure in failures],
        )
        write_sources(out, dataset)
        print(f"written to {out}")
        if report:
            write_report(out, n_workers=n_workers)
    return summary

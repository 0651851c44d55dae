"""`python -m training.study robustness`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from igps.cli.reading import signatures, write_notes
from igps.cli.report import check_report
from igps.cli.report import report as write_report
from igps.data.sources import Bodies, find_bodies
from igps.descriptors import NAMES
from igps.descriptors import descriptor as descriptor_of
from igps.report.results import write_sources
from igps.report.tables import write_rows
from training.studies.disturbances import DISTURBANCES
from training.studies.robustness import robustness as measure
from training.studies.tables import robustness_table


def robustness(
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
    found = measure(dataset, chosen, gallery=between, poses=of_poses, n_workers=n_workers)
    print(robustness_table(found.movements))
    for failure in failures:
        print(f"not used: {failure.error}")
    descriptions = {name: one.description for name, one in DISTURBANCES.items()}
    summary = {**found.as_dict(), "descriptions": descriptions, "config": dataset.config.as_dict()}
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

"""The command `igps compare`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._text import counted
from igps.cli.shared_options import Mirror, Size

if TYPE_CHECKING:
    from igps.analysis.comparison import Result
    from igps.data.dataset import Failure


def compare(
    root: Path,
    descriptors: list[str] | None = None,
    out: Path | None = None,
    report: bool = False,
    size: Size = "auto",
    mirror: Mirror = "auto",
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Compare descriptors on a labelled collection and print a table of their retrieval scores.

    What plain numbers find is printed below the table.

    Every mesh is compared with all others (leave-one-out) by the distance of each descriptor. A mesh that a descriptor
    cannot describe does not count for its scores; the table lists how many meshes each descriptor describes.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        descriptors: names, or package.module:NAME of your own descriptors; by default all of igps help
            descriptors that describe any body. If a name ends in +size, --size auto adds +size to no other name.
        out: folder for compare.json, distances/NAME.npz, precision_recall.png, meshes.json with the paths of the
            meshes, and failures.csv if there are failures.
        report: also write a page of results to the folder of --out, report.html, see igps report
    """
    from igps._progress import number_bars
    from igps.analysis.comparison import check_names
    from igps.analysis.comparison import compare as compare_descriptors
    from igps.analysis.plain_numbers import plain_scores
    from igps.cli.reading import Folder, signatures, with_side, with_size, write_mending_notes
    from igps.cli.report_command import check_report_folder
    from igps.cli.report_command import report as write_report
    from igps.descriptors import NAMES
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.measures import Measures
    from igps.descriptors.size_and_side import SIZE
    from igps.nn.description import fit_centres
    from igps.report.figures import precision_recall
    from igps.report.results import write_sources
    from igps.report.tables import comparison_table, plain_table
    from igps.retrieval import precision_recall_curve

    check_report_folder(report, out)
    names = [with_side(name, mirror, size) for name in descriptors or NAMES]
    modules = [descriptor_of(name) for name in names]
    if size == "auto" and any(SIZE in module.name for module in modules):
        size = "ignore"
    check_names(
        [module.name.replace(SIZE, "") if size == "keep" else module.name for module in modules]
    )
    number_bars(2 + len(names) + report)  # signatures, descriptions, distances by each, pictures
    dataset, failures = signatures(
        Folder(root, labelled=True),
        modules,
        n_workers=n_workers,
        strict=strict,
        also=Measures.requirements,
        **reading,
    )
    modules = [descriptor_of(with_size(name, size, dataset)) for name in names]
    for module in modules:
        fit_centres(module, dataset)
    results: list[Result] = []
    for result in compare_descriptors(dataset, modules, n_workers=n_workers, strict=strict):
        results.append(result)
        if (
            out is not None
        ):  # after each descriptor, so that an interrupted run keeps its results so far
            _write(out, results, failures)
    print(comparison_table(results))
    best = max(results, key=_first_tier)
    if best.scores is not None:
        print(plain_table(plain_scores(dataset), best.descriptor.name, best.scores))
    if n_failed := len(failures) + sum(len(result.failures) for result in results):
        print(f"{counted(n_failed, 'body')} could not be used or described.")
    if out is not None:
        write_mending_notes(out / "notes.csv", dataset)
        write_sources(out, dataset)
        curves = {
            result.descriptor.name: precision_recall_curve(result.distances, result.labels)
            for result in results
            if result.distances is not None and result.scores is not None
        }
        if curves:
            precision_recall(curves, out / "precision_recall.png")
        print(f"written to {out}")
        if report:
            write_report(out, n_workers=n_workers)
    return [result.row() for result in results]


def _first_tier(result: Result) -> float:
    return 0.0 if result.scores is None else result.scores.mean()["ft"]


def _write(out: Path, results: Sequence[Result], failures: Sequence[Failure]) -> None:
    """Write the rows and failures of all results, and the distances of the last one."""
    import numpy as np

    from igps.report.tables import write_rows

    (out / "distances").mkdir(parents=True, exist_ok=True)
    (out / "compare.json").write_text(
        json.dumps([result.row() for result in results], indent=2) + "\n"
    )
    last = results[-1]
    if last.distances is not None:
        path = out / "distances" / f"{last.descriptor.name}.npz"
        names = np.array(last.names)
        labels = np.array(last.labels)
        np.savez_compressed(path, distances=last.distances.numpy(), names=names, labels=labels)
    rows = [("all", failure.id, failure.error) for failure in failures]
    for result in results:
        rows += [(result.descriptor.name, failure.id, failure.error) for failure in result.failures]
    write_rows(out / "failures.csv", ("descriptor", "name", "error"), rows)

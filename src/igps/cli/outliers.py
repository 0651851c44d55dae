"""`igps outliers`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igps.analysis.groups import squared_distances, vectors_of
from igps.analysis.outliers import measures_of
from igps.analysis.outliers import outliers as find_outliers
from igps.cli.reading import Folder, described, print_failures
from igps.report.answers import outliers_figure, write_answer


def outliers(
    root: Path,
    descriptor: str = "pretrained",
    top: int = 20,
    out: Path | None = None,
    **reading: Any,
) -> list[dict[str, Any]]:
    """List the bodies that are most unlike their class, to look at before the collection is trusted.

    Each is compared with the others of its class: shape, volume, how coarse it is, handles, flat sides, repairs. A
    score is a number of robust standard deviations; above 3.5 it is more than chance. Of a body that lies nearer to
    another class than to its own, that is said.

    Args:
        root: folder with one subfolder per class, or with files and a labels.csv (columns file,label).
        top: how many to list.
        out: folder for outliers.csv and outliers.json with all, and pictures of the first as outliers.svg and .png.
    """
    bodies = described(Folder(root, labelled=True), descriptor, **reading)
    dataset = bodies.dataset
    distances = squared_distances(vectors_of(bodies.descriptor, bodies.descriptions)) ** 0.5
    measures = measures_of(dataset, n_workers=reading.get("n_workers"))
    found = find_outliers(distances, dataset.bodies.labels or (), measures, dataset.all_notes())
    rows: list[dict[str, Any]] = [
        {"body": dataset.bodies.names[one.body], "class": one.label, "score": round(one.score, 3), "reason": one.reason,
         **{f"score_{name}": round(value, 3) for name, value in one.scores.items()}}
        for one in found
    ]  # fmt: skip
    width = max(len(row["body"]) for row in rows[:top])
    print(f"{'score':>7}  {'body':<{width}}  class: why")
    for row in rows[:top]:
        print(f"{row['score']:>7.1f}  {row['body']:<{width}}  {row['class']}: {row['reason']}")
    print(f"{sum(one.is_outlier for one in found)} of {len(rows)} bodies have a score above what chance explains")
    print_failures(bodies.failures, len(dataset))
    if out is not None:
        pictured = [(one, dataset.mesh(one.body)) for one in found[: min(top, 12)]]
        write_answer(out, "outliers", rows, outliers_figure(pictured))
        print(f"written to {out}")
    return rows

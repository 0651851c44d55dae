"""`igps compare`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igps import baselines
from igps.baselines import Result
from igps.cli.reading import labelled_meshes, signatures, write_failures
from igps.cli.retrieval import TITLES
from igps.data.dataset import Failure
from igps.retrieval import precision_recall_curve


def compare(
    root: Path,
    descriptors: list[str] | None = None,
    out: Path | None = None,
    workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> None:
    """Compare retrieval systems on a labelled collection and print a table of their scores.

    Every mesh is compared with all others (leave-one-out) by the distance of each system. A mesh that a system cannot
    describe is left out of its scores; the table tells how many it describes.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        descriptors: names of the systems; all if not given.
        out: folder for compare.json, distances/NAME.npz, precision_recall.png, and failures.csv if there are any.
        workers: processes that compute; all cores if not given.
        strict: stop at the first mesh that cannot be used instead of skipping it
    """
    chosen = baselines.systems(descriptors)
    dataset, failures = signatures(labelled_meshes(root), workers=workers, strict=strict, **reading)
    results: list[Result] = []
    for result in baselines.compare(dataset, chosen, n_workers=workers, strict=strict):
        results.append(result)
        if out is not None:  # after each system, so that a run that is stopped leaves what it has
            _write(out, results, failures)
    print(format_table(results))
    n_failed = len(failures) + sum(len(result.failures) for result in results)
    if n_failed:
        print(f"{n_failed} meshes could not be used or described.")
    if out is not None:
        _write_figure(out, results)
        print(f"written to {out}")


def format_table(results: Sequence[Result]) -> str:
    """The results as a table, one line a system: scores in percent, meshes described, seconds for each."""
    rows = [result.row() for result in results]
    width = max(len(row["descriptor"]) for row in rows)
    lines = [" " * width + "".join(f"{title:>10}" for title in (*TITLES.values(), "meshes", "s/mesh"))]
    for row in rows:
        scores = "".join(f"{'–' if row[key] is None else f'{100 * row[key]:.1f}':>10}" for key in TITLES)
        seconds = "–" if row["seconds_per_mesh"] is None else f"{row['seconds_per_mesh']:.3f}"
        lines.append(f"{row['descriptor']:<{width}}{scores}{row['n_models']:>10}{seconds:>10}")
    lines.append("scores in percent, each mesh against all others that the system describes")
    lines.append("s/mesh: mean processor time of a description, beyond that of the cached signature")
    lines += [f"{result.name}: no scores: {result.error}" for result in results if result.error is not None]
    return "\n".join(lines)


def _write(out: Path, results: Sequence[Result], failures: Sequence[Failure]) -> None:
    """All rows and failures so far, and the distances of the last system."""
    (out / "distances").mkdir(parents=True, exist_ok=True)
    (out / "compare.json").write_text(json.dumps([result.row() for result in results], indent=2) + "\n")
    last = results[-1]
    if last.distances is not None:
        np.savez_compressed(
            out / "distances" / f"{last.name}.npz",
            distances=last.distances.numpy(),
            names=np.array(last.names),
            labels=np.array(last.labels),
        )
    rows = [("all", failure.id, failure.error) for failure in failures]
    for result in results:
        rows += [(result.name, failure.id, failure.error) for failure in result.failures]
    write_failures(out / "failures.csv", ("descriptor", "file", "error"), rows)


def _write_figure(out: Path, results: Sequence[Result]) -> None:
    from igps.figures.comparison import precision_recall

    curves = {
        result.name: precision_recall_curve(result.distances, result.labels)
        for result in results
        if result.distances is not None and result.scores is not None
    }
    if curves:
        precision_recall(curves, out / "precision_recall.png")

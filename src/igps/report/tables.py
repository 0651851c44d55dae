"""Tables of results, as text for a terminal and as CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._text import counted
from igps.data.filling import left_out

if TYPE_CHECKING:
    from igps.analysis.comparison import Result
    from igps.analysis.doctor import Finding
    from igps.analysis.groups import GroupTest
    from igps.retrieval import RetrievalScores

TITLES = {
    "nn": "NN",
    "ft": "FT",
    "st": "ST",
    "e": "E",
    "dcg": "DCG",
    "adr": "ADR",
    "adr_self": "ADR self",
    "map": "mAP",
}
"""Column titles of the scores, by name."""

PAIR_TITLES = {
    "nn": "NN",
    "first_5": "first 5",
    "first_10": "first 10",
    "map": "mAP",
    "median_rank": "median rank",
}
"""Column titles of `RetrievalScores.single_answers`, by name."""


def write_rows(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table as CSV; without rows, delete the file of an earlier run."""
    rows = iter(rows)
    first = next(rows, None)
    if first is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(chain([header, first], rows))


def scores_table(scores: RetrievalScores) -> str:
    """Return a text table of scores in percent: one line for all queries, one per class.

    Where each query has one relevant body, as in classes of two, one line of the scores that suit it.
    """
    if scores.has_single_answers:
        found = scores.single_answers()
        cells = [score_cell(name, found[name]) for name in PAIR_TITLES]
        lines = ["".join(f"{cell:>12}" for cell in row) for row in (PAIR_TITLES.values(), cells)]
        of_queries = "each with one body of its class among those that it asks"
        lines.append(f"percent, {scores.n_queries} queries, {of_queries}; mAP: mean of 1/rank")
        return "\n".join(lines)
    columns = {name: title for name, title in TITLES.items() if name in scores.mean()}
    rows = {
        "all": scores.mean(),
        **{str(label): values for label, values in scores.per_class().items()},
    }
    width = max(len(name) for name in rows)
    lines = [" " * width + "".join(f"{title:>10}" for title in columns.values())]
    lines += [
        f"{name:<{width}}" + "".join(f"{100 * row[key]:>10.1f}" for key in columns)
        for name, row in rows.items()
    ]
    others = "all others" if scores.adr_self is not None else "all that are no queries"
    lines.append(f"percent, {scores.n_queries} queries, each against {others}")
    if scores.n_excluded:
        lines.append(
            f"not used as queries, because they are alone in their class: {scores.n_excluded}"
        )
    return "\n".join(lines)


def score_cell(name: str, value: float | None) -> str:
    """Return a score in percent, or a rank, as it stands in tables; a dash if it is not known."""
    if value is None:
        return "–"
    return f"{value:.0f}" if name == "median_rank" else f"{100 * value:.1f}"


def comparison_table(results: Sequence[Result]) -> str:
    """Return a text table with one line per descriptor: scores in percent, meshes described, seconds per mesh."""
    rows = [result.row() for result in results]
    width = max(len(row["descriptor"]) for row in rows)
    lines = [
        " " * width + "".join(f"{title:>10}" for title in (*TITLES.values(), "meshes", "s/mesh"))
    ]
    for row in rows:
        scores = "".join(f"{score_cell(key, row[key]):>10}" for key in TITLES)
        seconds = "–" if row["seconds_per_mesh"] is None else f"{row['seconds_per_mesh']:.3f}"
        lines.append(f"{row['descriptor']:<{width}}{scores}{row['n_models']:>10}{seconds:>10}")
    lines.append("scores in percent, each mesh against all others that the descriptor describes")
    lines.append("s/mesh: mean processor time of a description, without that of the signature")
    lines += [
        f"{result.descriptor.name}: no scores: {result.error}"
        for result in results
        if result.error is not None
    ]
    return "\n".join(lines)


def findings_table(findings: Sequence[Finding]) -> str:
    """Return a text table with one line per body: vertices, expected time and memory, unit, and remarks.

    A body that cannot be used has the reason instead; masks that hold no body are counted in the last line. For labels
    of volumes, the table also shows voxels, pieces, and the thickness of the thinnest part in voxels.
    """
    listed = [finding for finding in findings if not finding.summary]
    width = max((len(finding.id) for finding in listed), default=0)
    has_voxels = any(finding.voxels for finding in findings)
    header = f"{'voxels':>10}{'pieces':>8}{'thinnest':>10}" if has_voxels else ""
    costs = f"{'vertices':>10}{'after':>9}{'seconds':>9}{'MB':>7}"
    lines = [f"{'':<{width}}{header}{costs}  {'unit':<12}  remarks"]
    for finding in listed:
        voxels = "{:>10}{:>8}{:>10}".format(*_voxel_counts(finding)) if has_voxels else ""
        start = f"{finding.id:<{width}}{voxels}"
        if finding.error is not None:
            lines.append(f"{start}  cannot be used: {finding.error}")
            continue
        cost = f"{finding.seconds or 0:>9.1f}{(finding.memory or 0) / 1e6:>7.0f}"
        unit = f"{finding.unit} ({finding.unit_from})" if finding.unit else "none"
        remarks = "; ".join(finding.remarks) or "none"
        sizes = f"{finding.n_vertices:>10}{finding.n_vertices_after:>9}"
        lines.append(f"{start}{sizes}{cost}  {unit:<12}  {remarks}")
    n_bad = sum(finding.error is not None for finding in listed)
    n_repaired = sum(bool(finding.steps) for finding in findings)
    minutes = sum(finding.seconds or 0 for finding in findings) / 60
    total = f"{counted(len(findings), 'body')}: {n_repaired} repaired, {n_bad} cannot be used"
    lines.append(f"{total}; about {minutes:.1f} core-minutes")
    nothing = left_out(finding.summary for finding in findings)
    return "\n".join([*lines, nothing] if nothing else lines)


def _voxel_counts(finding: Finding) -> tuple[object, ...]:
    voxels = finding.voxels
    return ("", "", "") if voxels is None else (voxels.n_voxels, voxels.n_pieces, voxels.thinnest)


def groups_table(tests: Sequence[GroupTest]) -> str:
    """Return a text table with one line per body: p-values and q-values, effect, area under the curve, group sizes."""
    width = max(len("body"), *(len(test.body) for test in tests))
    row = "{:>13}{:>13}{:>10}{:>10}{:>8}{:>17}{:>7}  {}".format
    titles = ("PERMANOVA p", "PERMANOVA q", "kernel p", "kernel q", "effect", "95 %", "AUC", "n")
    lines = [f"{'body':<{width}}" + row(*titles)]
    for test in tests:
        sizes = ", ".join(f"{count} {name}" for name, count in test.sizes.items())
        if test.refused is not None:
            lines.append(f"{test.body:<{width}}  not tested ({sizes}): {test.refused}")
            continue
        numbers = (test.permanova_p, test.permanova_q, test.kernel_p, test.kernel_q)
        cells = [*(f"{p:.4f}" for p in numbers), f"{test.effect:.3f}"]
        cells += [f"{test.effect_low:.3f} to {test.effect_high:.3f}", f"{test.auc:.2f}", sizes]
        lines.append(f"{test.body:<{width}}" + row(*cells))
    lines.append(
        "p: by permutation; q: false discovery rate over the bodies; effect: share of squared distances; n: bodies"
    )
    tested = [test for test in tests if test.refused is None]
    if any((test.effect or 0) < 0 or (test.auc is not None and test.auc < 0.5) for test in tested):
        lines.append(
            "an effect below 0, or an AUC below 0.5, is as good as 0 and 0.5: chance goes both ways"
        )
    return "\n".join(lines)

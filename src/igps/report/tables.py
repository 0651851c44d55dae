"""Tables of results, as text for a terminal and as CSV files."""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterable, Mapping, Sequence
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


def text_table(
    titles: Sequence[str], rows: Iterable[Sequence[object]], left: Collection[str] = ()
) -> str:
    """Return a table for a terminal. Columns are aligned right, those with the titles `left` on the left."""
    cells = [list(titles), *([str(cell) for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for row in cells:
        padded = [
            cell.ljust(width) if title in left else cell.rjust(width)
            for cell, width, title in zip(row, widths, titles, strict=True)
        ]
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def scores_table(scores: RetrievalScores) -> str:
    """Return a text table of scores in percent: one line for all queries, one per class.

    Where each query has one relevant body, as in classes of two, one line of the scores that suit it.
    """
    if scores.has_single_answers:
        found = scores.single_answers()
        cells = [score_cell(name, found[name]) for name in PAIR_TITLES]
        table = text_table(list(PAIR_TITLES.values()), [cells])
        of_queries = "each with one body of its class among those that it asks"
        return f"{table}\npercent, {scores.n_queries} queries, {of_queries}; mAP: mean of 1/rank"
    by_class = {"all": scores.mean(), **scores.per_class()}
    names = [name for name in TITLES if name in scores.mean()]
    lines = [_table_of_scores(by_class, names)]
    others = "all others" if scores.adr_self is not None else "all that are no queries"
    lines.append(f"percent, {scores.n_queries} queries, each against {others}")
    if scores.n_excluded:
        lines.append(
            f"not used as queries, because they are alone in their class: {scores.n_excluded}"
        )
    return "\n".join(lines)


def _table_of_scores(rows: Mapping[Any, Mapping[str, float]], names: Sequence[str]) -> str:
    """Return a text table of scores in percent, with a line for each row and a column for each name."""
    titles = [TITLES[name] for name in names]
    cells = []
    for label, scores in rows.items():
        cells.append([label, *(score_cell(name, scores[name]) for name in names)])
    return text_table(["", *titles], cells, left=[""])


def score_cell(name: str, value: float | None) -> str:
    """Return a score in percent, or a rank, as it stands in tables; a dash if it is not known."""
    if value is None:
        return "–"
    if name == "median_rank":
        return f"{value:.0f}"
    return f"{100 * value:.1f}"


def plain_table(rows: Mapping[str, RetrievalScores], descriptor: str, own: RetrievalScores) -> str:
    """Return a table of what plain numbers find, and a sentence on which of them are ahead of a descriptor in FT."""
    if not rows:
        return ""
    names = ("nn", "map") if own.has_single_answers else ("nn", "ft", "dcg")
    means = {name: scores.mean() for name, scores in rows.items()}
    lines = [f"plain numbers beside {descriptor}, percent", _table_of_scores(means, names)]
    first_tier = own.mean()["ft"]
    ahead = [name for name, mean in means.items() if mean["ft"] >= first_tier]
    if ahead:
        verb = "finds" if len(ahead) == 1 else "find"
        lines.append(
            f"{', '.join(ahead)} {verb} these classes as well as {descriptor} or better: the classes differ in plain "
            "numbers, and the result says little about form"
        )
    return "\n".join(lines)


def comparison_table(results: Sequence[Result]) -> str:
    """Return a text table with one line per descriptor: scores in percent, meshes described, seconds per mesh."""
    table = []
    for result in results:
        row = result.row()
        seconds = row["seconds_per_mesh"]
        shown = "–" if seconds is None else f"{seconds:.3f}"
        scores = [score_cell(name, row[name]) for name in TITLES]
        table.append([row["descriptor"], *scores, row["n_models"], shown])
    lines = [text_table(["", *TITLES.values(), "meshes", "s/mesh"], table, left=[""])]
    lines.append("scores in percent, each mesh against all others that the descriptor describes")
    lines.append("s/mesh: mean processor time of a description, without that of the signature")
    for result in results:
        if result.error is not None:
            lines.append(f"{result.descriptor.name}: no scores: {result.error}")
    return "\n".join(lines)


def findings_table(findings: Sequence[Finding]) -> str:
    """Return a text table with one line per body: vertices, expected time and memory, unit, and remarks.

    A body that cannot be used has the reason instead; masks that hold no body are counted in the last line. For labels
    of volumes, the table also shows voxels, pieces, and the thickness of the thinnest part in voxels.
    """
    listed = [finding for finding in findings if not finding.summary]
    of_voxels = ["voxels", "pieces", "thinnest"] if any(one.voxels for one in findings) else []
    titles = ["", *of_voxels, "vertices", "after", "seconds", "MB", "unit", "remarks"]
    rows = []
    for finding in listed:
        voxels = finding.voxels
        row: list[object] = [finding.id]
        if voxels is not None:
            row += [voxels.n_voxels, voxels.n_pieces, voxels.thinnest]
        elif of_voxels:
            row += ["", "", ""]
        if finding.error is not None:
            row += ["", "", "", "", "", f"cannot be used: {finding.error}"]
        else:
            row += [
                finding.n_vertices,
                finding.n_vertices_after,
                f"{finding.seconds or 0:.1f}",
                f"{(finding.memory or 0) / 1e6:.0f}",
                f"{finding.unit} ({finding.unit_from})" if finding.unit else "none",
                "; ".join(finding.remarks) or "none",
            ]
        rows.append(row)
    n_bad = sum(finding.error is not None for finding in listed)
    n_repaired = sum(bool(finding.steps) for finding in findings)
    minutes = sum(finding.seconds or 0 for finding in findings) / 60
    total = f"{counted(len(findings), 'body')}: {n_repaired} repaired, {n_bad} cannot be used"
    lines = [text_table(titles, rows, left=["", "unit", "remarks"])]
    lines.append(f"{total}; about {minutes:.1f} core-minutes")
    nothing = left_out(finding.summary for finding in findings)
    return "\n".join([*lines, nothing] if nothing else lines)


def groups_table(tests: Sequence[GroupTest]) -> str:
    """Return a text table with one line per body: p-values and q-values, effect, area under the curve, group sizes."""
    titles = ("PERMANOVA p", "PERMANOVA q", "kernel p", "kernel q", "effect", "95 %", "AUC", "n")
    rows = []
    for test in tests:
        sizes = ", ".join(f"{count} {name}" for name, count in test.sizes.items())
        if test.refused is not None:
            rows.append([test.body, *[""] * 7, f"not tested ({sizes}): {test.refused}"])
            continue
        rows.append(
            [
                test.body,
                f"{test.permanova_p:.4f}",
                f"{test.permanova_q:.4f}",
                f"{test.kernel_p:.4f}",
                f"{test.kernel_q:.4f}",
                f"{test.effect:.3f}",
                f"{test.effect_low:.3f} to {test.effect_high:.3f}",
                f"{test.auc:.2f}",
                sizes,
            ]
        )
    lines = [text_table(("body", *titles), rows, left=("body", "n"))]
    lines.append(
        "p: by permutation; q: false discovery rate over the bodies; effect: share of squared distances; n: bodies"
    )
    effects = [test.effect for test in tests if test.effect is not None]
    areas = [test.auc for test in tests if test.auc is not None]
    if any(effect < 0 for effect in effects) or any(area < 0.5 for area in areas):
        lines.append(
            "an effect below 0, or an AUC below 0.5, is as good as 0 and 0.5: chance goes both ways"
        )
    return "\n".join(lines)

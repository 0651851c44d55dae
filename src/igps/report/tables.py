"""Results as tables: of text, for a terminal, and as files."""

import csv
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from igps.analysis.comparison import Result
from igps.analysis.doctor import Finding
from igps.analysis.groups import GroupTest
from igps.retrieval import RetrievalScores

TITLES = dict(nn="NN", ft="FT", st="ST", e="E", dcg="DCG", adr="ADR", adr_self="ADR self", map="mAP")  # noqa: C408
"""Column titles of the scores, by name."""


def write_rows(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table as CSV, or remove the one of an earlier run where there are no rows."""
    rows = iter(rows)
    first = next(rows, None)
    if first is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(chain([header, first], rows))


def scores_table(scores: RetrievalScores) -> str:
    """The scores in percent: one line over all queries, one per class."""
    columns = {name: title for name, title in TITLES.items() if name in scores.mean()}
    rows = {"all": scores.mean(), **{str(label): values for label, values in scores.per_class().items()}}
    width = max(len(name) for name in rows)
    lines = [" " * width + "".join(f"{title:>10}" for title in columns.values())]
    lines += [f"{name:<{width}}" + "".join(f"{100 * row[key]:>10.1f}" for key in columns) for name, row in rows.items()]
    lines.append(f"percent, {scores.n_queries} queries, each against all others")
    if scores.n_excluded:
        lines.append(f"not scored as queries, each alone in its class: {scores.n_excluded}")
    return "\n".join(lines)


def comparison_table(results: Sequence[Result]) -> str:
    """One line a descriptor: scores in percent, meshes described, seconds for each."""
    rows = [result.row() for result in results]
    width = max(len(row["descriptor"]) for row in rows)
    lines = [" " * width + "".join(f"{title:>10}" for title in (*TITLES.values(), "meshes", "s/mesh"))]
    for row in rows:
        scores = "".join(f"{'–' if row[key] is None else f'{100 * row[key]:.1f}':>10}" for key in TITLES)
        seconds = "–" if row["seconds_per_mesh"] is None else f"{row['seconds_per_mesh']:.3f}"
        lines.append(f"{row['descriptor']:<{width}}{scores}{row['n_models']:>10}{seconds:>10}")
    lines.append("scores in percent, each mesh against all others that the descriptor describes")
    lines.append("s/mesh: mean processor time of a description, beyond that of the cached signature")
    lines += [f"{result.descriptor.name}: no scores: {result.error}" for result in results if result.error is not None]
    return "\n".join(lines)


def findings_table(findings: Sequence[Finding]) -> str:
    """One line a body: what is done to it, vertices, expected time and memory; or why it cannot be used.

    Where labels of volumes are among them, also their voxels, pieces, and the thickness of the thinnest part in voxels.
    """
    width = max(len(finding.id) for finding in findings)
    of_voxels = any(finding.voxels for finding in findings)
    header = f"{'voxels':>10}{'pieces':>8}{'thinnest':>10}" if of_voxels else ""
    lines = [f"{'':<{width}}{header}{'vertices':>10}{'after':>9}{'seconds':>9}{'MB':>7}  what is done"]
    for one in findings:
        counts = ("", "", "") if one.voxels is None else (one.voxels.n_voxels, one.voxels.n_pieces, one.voxels.thinnest)
        told = f"{one.id:<{width}}" + ("{:>10}{:>8}{:>10}".format(*counts) if of_voxels else "")
        if one.error is not None:
            lines.append(f"{told}  cannot be used: {one.error}")
            continue
        done = ", ".join(one.steps) or ("; ".join(one.notes) if one.voxels else "") or "nothing"
        cost = f"{one.seconds or 0:>9.1f}{(one.memory or 0) / 1e6:>7.0f}"
        lines.append(f"{told}{one.n_vertices:>10}{one.n_vertices_after:>9}{cost}  {done}")
    n_bad, n_mended = sum(one.error is not None for one in findings), sum(bool(one.steps) for one in findings)
    minutes = sum(one.seconds or 0 for one in findings) / 60
    lines.append(f"{len(findings)} bodies: {n_mended} mended, {n_bad} cannot be used; about {minutes:.1f} core-minutes")
    return "\n".join(lines)


def groups_table(tests: Sequence[GroupTest]) -> str:
    """One line a body: sizes of the groups, probabilities and false discovery rates, effect, area under the curve."""
    width = max(len("body"), *(len(one.body) for one in tests))
    row = "{:>13}{:>9}{:>10}{:>9}{:>8}{:>17}{:>7}  {}".format
    titles = ("PERMANOVA p", "q", "kernel p", "q", "effect", "95 %", "AUC", "groups")
    lines = [f"{'body':<{width}}" + row(*titles)]
    for one in tests:
        sizes = ", ".join(f"{count} {name}" for name, count in one.sizes.items())
        if one.refused is not None:
            lines.append(f"{one.body:<{width}}  not tested ({sizes}): {one.refused}")
            continue
        numbers = (one.permanova_p, one.permanova_q, one.kernel_p, one.kernel_q)
        cells = [*(f"{p:.4f}" for p in numbers), f"{one.effect:.3f}"]
        cells += [f"{one.effect_low:.3f} to {one.effect_high:.3f}", f"{one.auc:.2f}", sizes]
        lines.append(f"{one.body:<{width}}" + row(*cells))
    lines.append("p: by permutation; q: false discovery rate over the bodies; effect: share of squared distances")
    return "\n".join(lines)

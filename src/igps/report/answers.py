"""Pictures of answers for a paper, each as SVG and PNG with its numbers beside it as CSV and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.cluster.hierarchy import dendrogram

from igps._arrays import Floats
from igps.analysis.clusters import STABLE, Clusters
from igps.analysis.groups import GroupTest
from igps.analysis.map import BodyMap
from igps.analysis.outliers import Outlier
from igps.mesh.mesh import Mesh
from igps.report.drawing import PALETTE, draw_body, new_figure, paint, save_figure, seen_from_the_front, shortened
from igps.report.page_data import finite
from igps.report.tables import write_rows
from igps.retrieval import PrecisionRecallCurve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVEL = 0.05
"""Of the false discovery rate below which a body is marked."""
_FOUND, _OTHER = PALETTE[0], "#777777"


def write_answer(out: Path, name: str, rows: Sequence[Mapping[str, Any]], figure: Figure | None = None) -> None:
    """Write NAME.csv, a line a row, NAME.json with the same, and the picture, if any, as NAME.svg and NAME.png."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(finite(list(rows)), indent=2) + "\n")
    write_rows(out / f"{name}.csv", rows[0] if rows else (), (row.values() for row in rows))
    if figure is not None:
        save_figure(figure, out / f"{name}.svg")
        save_figure(figure, out / f"{name}.png", dpi=150)


def groups_figure(tests: Sequence[GroupTest]) -> Figure | None:
    """The effect of each body that was tested with its interval, the largest on top; None where none was."""
    tested = sorted((one for one in tests if one.effect is not None), key=lambda one: one.effect or 0)
    if not tested:
        return None
    figure = new_figure(6.5, 1.2 + 0.24 * len(tested))
    axes = figure.add_subplot()
    effects, lows, highs = (np.array([getattr(one, name) for one in tested]) for name in _INTERVAL)
    for place, one in enumerate(tested):
        colour = _FOUND if (one.permanova_q or 0) <= LEVEL else _OTHER
        axes.plot([lows[place], highs[place]], [place, place], color=colour, linewidth=1.6)
        axes.plot(effects[place], place, "o" if colour == _FOUND else "s", color=colour, markersize=5)
    axes.axvline(0, color="#BBBBBB", linewidth=0.8, zorder=0)
    axes.set_yticks(range(len(tested)), [shortened(one.body) for one in tested])
    axes.set_xlabel("share of squared distances that the groups explain, 95 % interval")
    axes.set_title(f"round, orange: false discovery rate at most {LEVEL:.0%}; square, grey: above", fontsize=9)
    return figure


def outliers_figure(pictured: Sequence[tuple[Outlier, str, Mesh]]) -> Figure:
    """Bodies with their scores, names and reasons, four in a row."""
    n_rows = -(-len(pictured) // 4)
    figure = new_figure(9, 2.6 * n_rows)
    all_axes = list(figure.subplots(n_rows, 4, squeeze=False).flat)
    for axes in all_axes:
        axes.set_axis_off()
    for axes, (one, name, mesh) in zip(all_axes, pictured, strict=False):
        draw_body(axes, mesh)
        title = "\n".join(wrap(f"{one.score:.1f}  {shortened(name)}", 38) + wrap(one.reason, 38))
        axes.set_title(title, fontsize=6, color=_FOUND if one.is_outlier else "#000000")
    return figure


def explanation_figure(painted: Sequence[tuple[str, Mesh, Floats]]) -> Figure:
    """Named bodies from the front and from behind, in red what each face (F,) has of the difference, blue if less."""
    figure = new_figure(7, 3.4 * len(painted))
    all_axes = figure.subplots(len(painted), 2, squeeze=False)
    for row, (name, mesh, values) in zip(all_axes, painted, strict=True):
        largest = np.quantile(np.abs(values), 0.98) or 1.0
        shares = np.clip(values / largest, -1, 1)[:, None]
        colours = np.where(shares > 0, _WHITE + shares * (_RED - _WHITE), _WHITE - shares * (_BLUE - _WHITE))
        turned = seen_from_the_front(mesh.vertices)
        for axes, turn, side in zip(row, ([1, 1, 1], [-1, 1, -1]), ("front", "back"), strict=True):
            paint(axes, turned * turn, mesh.faces, colours)
            axes.set_title(f"{shortened(name)}, {side}", fontsize=7)
    return figure


def map_figure(found: BodyMap, values: Sequence[str] | Sequence[float], title: str) -> Figure:
    """Bodies as points: of words, each has a colour and a mark; of numbers, a scale of colours."""
    figure = new_figure(7, 5.5)
    axes = figure.add_subplot()
    x, y = found.points.T
    if isinstance(values[0], str):
        names, drawn = sorted(set(map(str, values))), []
        for number, name in enumerate(names):
            own = [value == name for value in values]
            mark, colour = _MARKS[number // len(PALETTE) % len(_MARKS)], PALETTE[number % len(PALETTE)]
            drawn.append(axes.scatter(x[own], y[own], s=20, label=name, linewidths=0.8, marker=mark, color=colour))
        if any(names):  # by hand: Matplotlib leaves out what begins with an underscore
            figure.legend(
                drawn,
                list(map(shortened, names)),
                loc="outside right upper",
                title=title,
                fontsize=7,
                ncols=1 + len(names) // 30,
            )
    else:
        figure.colorbar(axes.scatter(x, y, s=20, c=values, cmap="viridis"), label=title)
    axes.set(aspect="equal", xticks=[], yticks=[], xlabel=f"stress {found.stress:.2f}")
    return figure


def clusters_figure(found: Clusters, names: Sequence[str]) -> Figure:
    """The tree, with the cluster of each body and its stability in brackets."""
    figure = new_figure(7, max(2.0, 0.6 + 0.13 * len(names)))
    axes = figure.add_subplot()
    leaves = dendrogram(found.tree, orientation="left", ax=axes, link_color_func=lambda _: _OTHER)["leaves"]
    clusters = found.labels[leaves]
    names = [shortened(names[i]) for i in leaves]
    stability = ["–" if np.isnan(one) else f"{one:.2f}" for one in found.stability]
    told = [f"{name}  {one + 1} ({stability[one]})" for name, one in zip(names, clusters, strict=True)]
    axes.set_yticks(5 + 10 * np.arange(len(leaves)), told, fontsize=5)
    for label, one in zip(axes.get_yticklabels(), clusters, strict=True):
        label.set(color=PALETTE[one % len(PALETTE)], weight="bold" if found.stability[one] >= STABLE else "normal")
    axes.set_xlabel(f"distance; behind each name its cluster and its stability, bold from {STABLE}", fontsize=7)
    return figure


def precision_recall(curves: Mapping[str, PrecisionRecallCurve], out: Path) -> None:
    """Draw the precision of systems at equal levels of recall, both in percent, as a PNG file."""
    figure = new_figure(8.5, 5.2)
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(curves.items()):
        colour, line = PALETTE[i % len(PALETTE)], _STYLES[i // len(PALETTE) % len(_STYLES)]
        recall, precision = 100 * curve.recall.numpy(), 100 * curve.precision.numpy()
        mark = _MARKERS[i % len(_MARKERS)]
        axes.plot(recall, precision, label=name, color=colour, linestyle=line, linewidth=1.4, marker=mark, markersize=4)
    axes.set(xlim=(0, 102), ylim=(0, 102))
    axes.set_xlabel("recall: share of the query's class that is found (%)")
    axes.set_ylabel("precision: share of the query's class among the found (%)")
    fewest, *_, most = sorted(2 * [curve.n_queries for curve in curves.values()])
    axes.set_title(f"leave-one-out, mean over {most if fewest == most else f'{fewest} to {most}'} queries")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    figure.legend(loc="outside right upper", frameon=False, title="system")
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, out, dpi=130)


# Of precision and recall, in the second and third round of colours
_STYLES, _MARKERS = ("-", "--", ":"), ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h")
_MARKS = ("o", "s", "^", "x", "+", "D")
_WHITE, _RED, _BLUE = (np.array(one) for one in ((0.9, 0.9, 0.9), (0.84, 0.25, 0.0), (0.0, 0.35, 0.7)))
_INTERVAL = ("effect", "effect_low", "effect_high")

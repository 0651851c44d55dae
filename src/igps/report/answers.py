"""Pictures of answers for a paper, each as SVG and PNG with its numbers beside it as CSV and JSON."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from igps.analysis.groups import GroupTest
from igps.report.drawing import PALETTE, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVEL = 0.05
"""Of the false discovery rate below which a body is marked."""
_FOUND, _OTHER = PALETTE[0], "#777777"


def write_answer(out: Path, name: str, rows: Sequence[Mapping[str, Any]], figure: Figure | None = None) -> None:
    """Write NAME.csv, a line a row, NAME.json with the same, and the picture as NAME.svg and NAME.png.

    Args:
        out: the folder.
        name: of the files.
        rows: of one table.
        figure: without one, or without rows, there is no picture.
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(list(rows), indent=2) + "\n")
    with (out / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)
    if figure is None:
        return
    for kind in ("svg", "png"):
        figure.savefig(out / f"{name}.{kind}", dpi=150)


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
    axes.set_yticks(range(len(tested)), [one.body for one in tested])
    axes.set_xlabel("share of squared distances that the groups explain, 95 % interval")
    axes.set_title(f"round, orange: false discovery rate at most {LEVEL:.0%}; square, grey: above", fontsize=9)
    return figure


_INTERVAL = ("effect", "effect_low", "effect_high")

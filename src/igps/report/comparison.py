"""Pictures of systems side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from igps.report.drawing import PALETTE, new_figure
from igps.retrieval import PrecisionRecallCurve

# The second and third round of colours
_STYLES = ("-", "--", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h")


def precision_recall(curves: Mapping[str, PrecisionRecallCurve], out: Path) -> None:
    """Draw the precision of systems at equal levels of recall, both in percent, as a PNG file.

    Args:
        curves: of each system by name, in the order of the legend.
        out: the file.
    """
    figure = new_figure(8.5, 5.2)
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(curves.items()):
        colour, line = PALETTE[i % len(PALETTE)], _STYLES[i // len(PALETTE) % len(_STYLES)]
        recall, precision = 100 * curve.recall.numpy(), 100 * curve.precision.numpy()
        (drawn,) = axes.plot(recall, precision, label=name, color=colour, linestyle=line, linewidth=1.4)
        drawn.set(marker=_MARKERS[i % len(_MARKERS)], markersize=4)
    axes.set(xlim=(0, 102), ylim=(0, 102))
    axes.set_xlabel("recall: share of the query's class that is found (%)")
    axes.set_ylabel("precision: share of the query's class among the found (%)")
    fewest, *_, most = sorted(2 * [curve.n_queries for curve in curves.values()])
    axes.set_title(f"leave-one-out, mean over {most if fewest == most else f'{fewest} to {most}'} queries")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    figure.legend(loc="outside right upper", frameon=False, title="system")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)

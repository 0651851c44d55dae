"""Pictures of systems side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from igps.report.drawing import PALETTE, new_figure
from igps.retrieval import PrecisionRecallCurve

# Told apart by every kind of colour vision (Okabe and Ito 2008), without their yellow, which is too light for a line.
# The second and third round of colours.
_STYLES = ("-", "--", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h")


def precision_recall(curves: Mapping[str, PrecisionRecallCurve], out: Path) -> None:
    """Draw the precision of systems at equal levels of recall, both in percent.

    Args:
        curves: of each system by name, in the order of the legend.
        out: the PNG file.
    """
    figure = new_figure(8.5, 5.2)
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(curves.items()):
        axes.plot(
            100 * curve.recall.numpy(),
            100 * curve.precision.numpy(),
            label=name,
            color=PALETTE[i % len(PALETTE)],
            linestyle=_STYLES[i // len(PALETTE) % len(_STYLES)],
            marker=_MARKERS[i % len(_MARKERS)],
            markersize=4,
            linewidth=1.4,
        )
    axes.set(xlim=(0, 102), ylim=(0, 102))
    axes.set_xlabel("recall: share of the query's class that is found (%)")
    axes.set_ylabel("precision: share of the query's class among the found (%)")
    fewest, *_, most = sorted(2 * [curve.n_queries for curve in curves.values()])
    axes.set_title(f"leave-one-out, mean over {most if fewest == most else f'{fewest} to {most}'} queries")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    figure.legend(loc="outside right upper", frameon=False, title="system")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)

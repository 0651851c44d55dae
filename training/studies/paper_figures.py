"""Drawings of the figures of Rustamov 2010: histograms of poses, a weld, and the barycentroid potential on a slice."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps.mesh.mesh import Mesh
from igps.mesh.surface import longest_side
from igps.report.drawing import GREY, PALETTE, new_figure, paint
from training.studies.weld import TUBE_FACES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLES = ("-", "--", "-.", ":")
_ORANGE = (0.84, 0.37, 0.0)
_DPI = 100
# Reported by Rustamov 2010 for Homer with welded feet: change in percent, and the share of pairs that change less.
_REPORTED = ((3, "99.6 %"), (14, "all"))


def draw_pose_curves(
    histograms: Mapping[str, NDArray[np.floating]], centres: NDArray[np.floating], out: Path
) -> None:
    """Draw the distributions of interior distances: a curve for each body, a colour for each class.

    Args:
        histograms: by class, (N, B) histograms of its bodies, each of sum 1.
        centres: (B,) ascending centres of the bins; the last bin also counts larger distances.
        out: the PNG file.
    """
    figure = new_figure(7.5, 4.2)
    axes = figure.add_subplot()
    for i, (name, curves) in enumerate(histograms.items()):
        colour, style = PALETTE[i % len(PALETTE)], _STYLES[i % len(_STYLES)]
        lines = axes.plot(
            centres,
            100 * np.asarray(curves).T,
            color=colour,
            linestyle=style,
            linewidth=0.8,
            alpha=0.8,
        )
        lines[0].set_label(f"{name} ({len(curves)} bodies)")
    axes.set(xlim=(0, float(2 * centres[-1] - centres[-2])))
    axes.set_ylim(bottom=0)
    axes.set_xlabel("interior distance d̂ (commute time, no unit); the last bin counts all beyond")
    axes.set_ylabel(f"pairs of interior points in a bin of {centres[1] - centres[0]:.3g} (%)")
    axes.set_title("One curve a body: all pairs of points of its interior by their distance")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    legend = axes.legend(frameon=False, title="class")
    for handle in legend.get_lines():
        handle.set(linewidth=2, alpha=1)
    _save(figure, out)


def draw_weld_change(mesh: Mesh, welded: Mesh, change: NDArray[np.floating], out: Path) -> None:
    """Draw how a weld changes the interior distances, and where the weld is.

    Args:
        mesh: the body before the weld.
        welded: the body after `training.studies.weld.weld`, with the tube as its last faces.
        change: (pairs,) relative changes of distances.
        out: the PNG file.
    """
    figure = new_figure(9.4, 3.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.7, 1, 1))
    percent = 100 * np.asarray(change)
    end = max(np.ceil(percent.max()), _REPORTED[-1][0] + 1)
    left.hist(
        percent,
        bins=np.linspace(0, end, 61),
        weights=np.full(len(percent), 100 / len(percent)),
        color=PALETTE[1],
    )
    for (value, reported), style in zip(_REPORTED, ("--", ":"), strict=True):
        share = 100 * np.mean(percent < value)
        label = f"{value} %: {share:.1f} % of the pairs are left of this line (Rustamov 2010, for Homer: {reported})"
        left.axvline(value, color="black", linestyle=style, linewidth=1.2, label=label)
    left.set(yscale="log", xlim=(0, end))
    left.set_xlabel("change of the interior distance, |after − before| / before (%)")
    left.set_ylabel("pairs of interior points (%)")
    left.set_title(f"{len(percent):,} pairs, largest change {percent.max():.0f} %")
    figure.legend(loc="outside lower left", frameon=False, fontsize=8)
    tube = welded.faces[-TUBE_FACES:]
    ends = np.unique(tube)

    vertices = upright(mesh.vertices)
    paint(middle, vertices, mesh.faces, GREY)
    middle.plot(
        *vertices[ends, :2].mean(axis=0),
        "o",
        markersize=16,
        markerfacecolor="none",
        color=_ORANGE,
        mew=1.6,
    )
    middle.set_title("the body; circled: the weld", fontsize=9)

    _zoom(right, welded, tube)
    first, last = (
        welded.vertices[tube[1::2, i]] for i in (0, 2)
    )  # the ends of the three edges along the tube
    length = float(np.linalg.norm(first - last, axis=1).mean() / longest_side(welded.vertices))
    right.set_title(
        f"the tube (orange, {TUBE_FACES} triangles),\n{length:.1%} of the body's extent", fontsize=9
    )
    _save(figure, out)


def draw_potential_slice(
    axes_of_slice: tuple[Floats, Floats],
    potential: NDArray[np.floating],
    outline: Floats,
    barycentroid: Floats,
    out: Path,
) -> None:
    """Draw the barycentroid potential on a plane through a body.

    Args:
        axes_of_slice: (X,) and (Y,) coordinates of the grid, length.
        potential: (X, Y), no unit; NaN outside the body.
        outline: (S, 2, 2) ends of the segments in which the plane cuts the surface.
        barycentroid: (2,) position of the least potential.
        out: the PNG file.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.ticker import MaxNLocator

    x, y = axes_of_slice
    low, high = outline.min(axis=(0, 1)), outline.max(axis=(0, 1))
    margin = 0.04 * (high - low).max()
    width, height = 5 * (high - low) / (high - low).max()
    figure = new_figure(max(width, 2.6) + 2.2, max(height, 2) + 1.6)
    panel = figure.add_subplot(aspect="equal")
    levels = MaxNLocator(16).tick_values(float(np.nanmin(potential)), float(np.nanmax(potential)))
    inside = np.ma.masked_invalid(potential.T)
    filled = panel.contourf(x, y, inside, levels=levels, cmap="cividis")
    panel.contour(x, y, inside, levels=levels, colors="white", linewidths=0.5)
    panel.add_collection(LineCollection(list(outline), colors="black", linewidths=1.2))
    panel.plot(
        *barycentroid,
        "*",
        markersize=14,
        color="white",
        mec="black",
        linestyle="none",
        label="barycentroid",
    )
    panel.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    panel.set_xlabel("length (unit of the mesh)")
    panel.set_ylabel("length (unit of the mesh)")
    panel.set_title(
        f"Slice through the barycentroid;\na white line every {levels[1] - levels[0]:.2g}",
        fontsize=10,
    )
    figure.colorbar(filled, ax=panel, label="barycentroid potential U (no unit)")
    figure.legend(loc="outside lower center", frameon=False)
    _save(figure, out)


def upright(vertices: Floats) -> Floats:
    """Rotate vertices (V, 3): the longest principal axis up, the next right, their largest components positive."""
    axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    up, right = (axis * np.sign(axis[np.argmax(np.abs(axis))]) for axis in axes[:2])
    return vertices @ np.stack([right, up, np.cross(right, up)], axis=1)


def _zoom(axis: Axes, welded: Mesh, tube: Integers) -> None:
    """Draw the surroundings of the tube as seen from outside the body; the tube lies across the picture."""
    a, b = welded.vertices[tube[:, 0]].mean(axis=0), welded.vertices[tube[:, 2]].mean(axis=0)
    middle = (a + b) / 2
    across = (b - a) / np.linalg.norm(b - a)
    away = middle - welded.vertices.mean(axis=0)
    away -= (away @ across) * across
    away /= np.linalg.norm(away)
    frame = np.stack([across, np.cross(away, across), away], axis=1)
    points = (welded.vertices - middle) @ frame
    reach = 2.5 * np.linalg.norm(points[np.unique(tube)], axis=1).max()
    paint(axis, points, welded.faces, GREY)
    for both_sides in (tube, tube[:, ::-1]):
        paint(axis, points, both_sides, _ORANGE)
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach))


def _save(figure: Figure, out: Path) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=_DPI)

"""Figures of analyses for publications, as SVG and PNG, with their numbers as CSV and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.cluster.hierarchy import dendrogram

from igps._arrays import Booleans, Floats
from igps.analysis.clusters import STABLE, Clusters
from igps.analysis.groups import GroupTest
from igps.analysis.map import BodyMap
from igps.analysis.outliers import Outlier
from igps.analysis.superposition import Movement
from igps.data.dataset import SignatureDataset
from igps.mesh.loading import each_raw_body
from igps.mesh.mesh import Mesh
from igps.report.drawing import (
    GREY,
    PALETTE,
    new_figure,
    save_figure,
    shortened,
    thumbnail,
    titles_of,
)
from igps.report.exports import write_places
from igps.report.page_data import finite
from igps.report.tables import write_rows
from igps.report.views import common_views, draw_view, reach_of
from igps.retrieval import PrecisionRecallCurve
from igps.signature.voxels import grid_axes, inside_grid, interior_samples

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Painted:
    """A body with values on its surface."""

    name: str
    mesh: Mesh
    values: Floats  # (V,) at its vertices
    is_held: Booleans | None = None  # (V,) where the values count; they are pale elsewhere
    inside: Callable[[Floats], Floats] | None = None  # the values (P,) at points (P, 3) inside


class _Slice(NamedTuple):
    """A plane through a body."""

    values: Floats  # (X, Y), NaN outside of the body
    extent: tuple[float, ...]  # of both axes of the plane: first and last
    title: str  # where it lies


LEVEL = 0.05
"""Largest false discovery rate of bodies that are marked as significant."""
_SLICE_RESOLUTION = 128  # pixels along the longest side of a body
_N_ABREAST = 4  # outliers in a row
_SIGNIFICANT = PALETTE[0]
_OTHER = "#777777"
# Curves of precision and recall beyond the first round of colours differ by line style and marker
_STYLES = ("-", "--", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h")
_MAP_MARKERS = ("o", "s", "^", "x", "+", "D")
_BLUE: Floats = np.array([0.0, 0.35, 0.7])
_WHITE: Floats = np.array([0.9, 0.9, 0.9])
_RED: Floats = np.array([0.84, 0.25, 0.0])
_PALE = 0.3  # strength of the colours where values do not count


def write_analysis(
    out: Path, name: str, rows: Sequence[Mapping[str, Any]], figure: Figure | None = None
) -> None:
    """Write rows as NAME.csv and NAME.json, and the figure, if any, as NAME.svg and NAME.png."""
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(finite(list(rows)), indent=2)
    (out / f"{name}.json").write_text(text + "\n")
    header = rows[0] if rows else ()
    write_rows(out / f"{name}.csv", header, (row.values() for row in rows))
    if figure is not None:
        save_both(figure, out / name)


def save_both(figure: Figure, stem: Path) -> None:
    """Save a figure as STEM.svg and STEM.png."""
    save_figure(figure, stem.with_name(f"{stem.name}.svg"))
    save_figure(figure, stem.with_name(f"{stem.name}.png"), dpi=150)


def write_movement(out: Path, names: Sequence[str], movement: Movement) -> None:
    """Write how far each place of two bodies moved, as explain_KIND.csv, and both bodies with the shares of places.

    The bodies, explain_1 and explain_2, are superposed; a share, in percent, takes the place of the B-factor.
    """
    rows = []
    rotations = (np.eye(3), movement.superposition.rotation)
    shifts = (np.zeros(3), movement.superposition.shift)
    for side, (name, places) in enumerate(zip(names, movement.correspondence.places, strict=True)):
        displacements = movement.displacements[side].tolist()
        shares = movement.shares(side)
        columns = (places.names, displacements, shares.tolist())
        for place, displacement, share in zip(*columns, strict=True):
            rows.append(
                {
                    "name": name,
                    "place": place,
                    "displacement": displacement,
                    "share": share,
                }
            )
        path = out / f"explain_{side + 1}{places.suffix}"
        places.save(path, 100 * shares, rotations[side], shifts[side])
    write_analysis(out, f"explain_{movement.correspondence.kind}", rows)


def groups_figure(tests: Sequence[GroupTest]) -> Figure | None:
    """Plot the effects of all tested bodies with their intervals, the largest on top; return None if there are none."""
    tested = [test for test in tests if test.effect is not None]
    if not tested:
        return None
    tested.sort(key=lambda test: test.effect or 0)
    figure = new_figure(6.5, 1.2 + 0.24 * len(tested))
    axes = figure.add_subplot()
    for y, test in enumerate(tested):
        is_significant = (test.permanova_q or 0) <= LEVEL
        colour = _SIGNIFICANT if is_significant else _OTHER
        marker = "o" if is_significant else "s"
        numbers = np.array([test.effect, test.effect_low, test.effect_high], dtype=float)
        axes.plot(numbers[1:], [y, y], color=colour, linewidth=1.6)
        axes.plot(numbers[0], y, marker, color=colour, markersize=5)
    axes.axvline(0, color="#BBBBBB", linewidth=0.8, zorder=0)
    axes.set_yticks(range(len(tested)), [shortened(test.body) for test in tested])
    axes.set_xlabel("share of squared distances that the groups explain, 95 % interval")
    axes.set_title(
        f"round, orange: false discovery rate at most {LEVEL:.0%}; square, grey: above", fontsize=9
    )
    return figure


def outliers_figure(pictured: Sequence[tuple[Outlier, str, Mesh]]) -> Figure:
    """Draw bodies with their scores, names and reasons; those of a class from the same side."""
    n_rows = math.ceil(len(pictured) / _N_ABREAST)
    figure = new_figure(9, 2.6 * n_rows)
    all_axes = list(figure.subplots(n_rows, _N_ABREAST, squeeze=False).flat)
    for axes in all_axes:
        axes.set_axis_off()
    titles = titles_of([name for _, name, _ in pictured])
    first_of_class: dict[str, Mesh] = {}
    for axes, title, (outlier, _, mesh) in zip(all_axes, titles, pictured, strict=False):
        small = thumbnail(mesh)
        first = first_of_class.setdefault(outlier.label, small)
        drawn = [small] if first is small else [first, small]
        views, bodies = common_views(drawn)
        draw_view(axes, views[0], small, bodies[-1], GREY)
        lines = wrap(f"{outlier.score:.1f}  {title}", 38)
        lines += wrap(outlier.reason, 38)
        colour = _SIGNIFICANT if outlier.is_outlier else "#000000"
        axes.set_title("\n".join(lines), fontsize=6, color=colour)
    return figure


def painted_figure(
    painted: Sequence[Painted], legend: str, superposed: Sequence[Floats] | None = None
) -> Figure:
    """Draw bodies from the same six sides and in the same scale, coloured by values: red positive, blue negative.

    For `superposed` see `common_views`.
    """
    views, bodies = common_views([body.mesh for body in painted], superposed)
    reach = reach_of(views, bodies)
    everything = np.concatenate([body.values for body in painted])
    scale = _scale_of(everything)
    figure = new_figure(12, 2.4 * len(painted) + 0.6)
    figure.set_layout_engine("constrained", rect=(0, 0, 0.93, 1))
    all_axes = figure.subplots(len(painted), len(views), squeeze=False)
    titles = titles_of([body.name for body in painted])
    for row, body, title, vertices in zip(all_axes, painted, titles, bodies, strict=True):
        colours = scale.to_rgba(body.values)[:, :3]
        if body.is_held is not None:
            pale = _WHITE + _PALE * (colours - _WHITE)
            colours = np.where(body.is_held[:, None], colours, pale)
        for axes, view in zip(row, views, strict=True):
            draw_view(axes, view, body.mesh, vertices, colours, reach)
            axes.set_title(view.title, fontsize=7)
        row[0].set_title(f"{title}\n", fontsize=7, loc="left")
    beside = figure.add_axes((0.94, 0.2, 0.01, 0.6))
    _add_bar(figure, scale, legend, cax=beside)
    if everything.min() >= 0:
        beside.set_ylim(bottom=0)
    return figure


def _scale_of(values: Floats) -> ScalarMappable:
    """Return colours from blue (negative) over white (0) to red; a few extreme values share the last colour."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    sizes = np.abs(values)
    largest = float(np.quantile(sizes, 0.98)) or float(sizes.max()) or 1.0
    colour_map = LinearSegmentedColormap.from_list("shares", [_BLUE, _WHITE, _RED])
    return ScalarMappable(Normalize(-largest, largest), colour_map)


def _add_bar(figure: Figure, scale: ScalarMappable, legend: str, **place: Any) -> None:
    """Add the bar of colours, with a legend, at a place that `Figure.colorbar` understands."""
    bar = figure.colorbar(scale, **place)
    bar.ax.tick_params(labelsize=6)
    bar.set_label(legend, fontsize=7)


def write_painted(
    out: Path, names: Sequence[str], painted: Sequence[Painted], dataset: SignatureDataset
) -> None:
    """Write the values of painted bodies of a dataset as out/NAME.ply and others, see `write_places`."""
    for stem, body in zip(names, painted, strict=True):
        values = {"value": body.values}
        if body.is_held is not None:
            values["significant"] = body.is_held.astype(np.float64)
        number = dataset.bodies.number(body.name)
        ref = dataset.bodies[number]
        voxels = None
        if ref.path.is_file():
            for _, raw in each_raw_body(ref.path, dataset.reading, parts=[ref.part]):
                voxels = None if raw.voxels is None else raw.voxels()
        write_places(out / stem, body.mesh, values, voxels, body.inside)


def slices_figure(painted: Sequence[Painted], legend: str) -> Figure:
    """Draw three slices of each body through the place of its largest value inside: red positive, blue negative."""
    figure = new_figure(7.5, 2.6 * len(painted))
    all_axes = figure.subplots(len(painted), 3, squeeze=False)
    slices = [_slices(body) for body in painted]
    everything = np.concatenate([plane.values.ravel() for own in slices for plane in own])
    scale = _scale_of(everything[~np.isnan(everything)])
    titles = titles_of([body.name for body in painted])
    for row, title, body, own in zip(all_axes, titles, painted, slices, strict=True):
        for axes, plane in zip(row, own, strict=True):
            axes.imshow(
                plane.values.T,
                scale.cmap,
                scale.norm,
                origin="lower",
                extent=plane.extent,
            )
            axes.set_title(f"{plane.title} {body.mesh.unit or ''}", fontsize=7)
            axes.set_axis_off()
        row[0].set_title(f"{title}\n\n", fontsize=7, loc="left")
    _add_bar(figure, scale, legend, ax=all_axes, shrink=0.6)
    return figure


def _slices(body: Painted) -> list[_Slice]:
    """Return the three slices through the place of the largest value inside a body."""
    assert body.inside is not None
    points = interior_samples(body.mesh)
    middle = points[body.inside(points).argmax()]
    slices = []
    for axis, letter in enumerate("xyz"):
        x, y, z = grid_axes(body.mesh, _SLICE_RESOLUTION)
        lines = [x, y, z]
        lines[axis] = middle[axis : axis + 1]
        is_inside = inside_grid(body.mesh, (lines[0], lines[1], lines[2]))
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
        values = np.full(is_inside.shape, np.nan)
        values[is_inside] = body.inside(grid[is_inside])
        extent = []
        for across in (*lines[:axis], *lines[axis + 1 :]):
            extent += [float(across[0]), float(across[-1])]
        slices.append(_Slice(values.squeeze(axis), tuple(extent), f"{letter} = {middle[axis]:.4g}"))
    return slices


def map_figure(body_map: BodyMap, values: Sequence[str] | Sequence[float], title: str) -> Figure:
    """Plot a map of bodies, with a colour and marker for each category, or a colour bar for numeric values."""
    figure = new_figure(7, 5.5)
    axes = figure.add_subplot()
    x, y = body_map.points.T
    if isinstance(values[0], str):
        names = sorted(set(map(str, values)))
        handles = []
        for number, name in enumerate(names):
            own = [value == name for value in values]
            n_rounds, place = divmod(number, len(PALETTE))
            handles.append(
                axes.scatter(
                    x[own],
                    y[own],
                    s=20,
                    label=name,
                    linewidths=0.8,
                    marker=_MAP_MARKERS[n_rounds % len(_MAP_MARKERS)],
                    color=PALETTE[place],
                )
            )
        if any(names):
            figure.legend(
                # Given, because Matplotlib skips labels that begin with an underscore
                handles,
                list(map(shortened, names)),
                loc="outside right upper",
                title=title,
                fontsize=7,
                ncols=1 + len(names) // 30,
            )
    else:
        points = axes.scatter(x, y, s=20, c=values, cmap="viridis")
        figure.colorbar(points, label=title)
    axes.set(
        aspect="equal",
        xticks=[],
        yticks=[],
        xlabel=f"stress {body_map.stress:.2f}",
    )
    return figure


def clusters_figure(clustering: Clusters, names: Sequence[str]) -> Figure:
    """Plot the tree of bodies, each labelled with its cluster and the stability of the cluster in brackets."""
    figure = new_figure(7, max(2.0, 0.6 + 0.13 * len(names)))
    axes = figure.add_subplot()
    drawn = dendrogram(
        clustering.tree, orientation="left", ax=axes, link_color_func=lambda _: _OTHER
    )
    leaves = drawn["leaves"]
    clusters = clustering.labels[leaves]
    labels = []
    for leaf, cluster in zip(leaves, clusters, strict=True):
        stability = clustering.stability[cluster]
        shown = "–" if np.isnan(stability) else f"{stability:.2f}"
        labels.append(f"{shortened(names[leaf])}  {cluster + 1} ({shown})")
    axes.set_yticks(5 + 10 * np.arange(len(leaves)), labels, fontsize=5)
    for label, cluster in zip(axes.get_yticklabels(), clusters, strict=True):
        is_stable = clustering.stability[cluster] >= STABLE
        colour = PALETTE[cluster % len(PALETTE)]
        label.set(color=colour, weight="bold" if is_stable else "normal")
    axes.set_xlabel(
        f"distance; after each name: cluster (stability), bold for at least {STABLE}", fontsize=7
    )
    return figure


def precision_recall(curves: Mapping[str, PrecisionRecallCurve], out: Path) -> None:
    """Plot the precision of descriptors at equal levels of recall, both in percent, to a PNG file."""
    figure = new_figure(8.5, 5.2)
    axes = figure.add_subplot()
    for number, (name, curve) in enumerate(curves.items()):
        n_rounds, place = divmod(number, len(PALETTE))
        axes.plot(
            100 * curve.recall.numpy(),
            100 * curve.precision.numpy(),
            label=name,
            color=PALETTE[place],
            linestyle=_STYLES[n_rounds % len(_STYLES)],
            linewidth=1.4,
            marker=_MARKERS[number % len(_MARKERS)],
            markersize=4,
        )
    axes.set(xlim=(0, 102), ylim=(0, 102))
    axes.set_xlabel("recall: share of the query's class that is retrieved (%)")
    axes.set_ylabel("precision: share of the query's class among the retrieved (%)")
    n_queries = sorted({curve.n_queries for curve in curves.values()})
    shown = f"{n_queries[0]}"
    if len(n_queries) > 1:
        shown = f"{n_queries[0]} to {n_queries[-1]}"
    axes.set_title(f"leave-one-out, mean over {shown} queries")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    figure.legend(loc="outside right upper", frameon=False, title="system")
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, out, dpi=130)

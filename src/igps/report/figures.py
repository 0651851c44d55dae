"""Figures of analyses for publications, as SVG and PNG, with their numbers as CSV and JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

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
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Painted:
    """A body with values on its surface."""

    name: str
    mesh: Mesh
    values: Floats  # (V,) at its vertices
    is_held: Booleans | None = None  # (V,) where the values count; they are pale elsewhere
    inside: Callable[[Floats], Floats] | None = None  # the values (P,) at points (P, 3) inside


LEVEL = 0.05
"""Largest false discovery rate of bodies that are marked as significant."""
_SLICE_RESOLUTION = 128  # pixels along the longest side of a body
_SIGNIFICANT = PALETTE[0]
_OTHER = "#777777"


def write_analysis(
    out: Path, name: str, rows: Sequence[Mapping[str, Any]], figure: Figure | None = None
) -> None:
    """Write rows as NAME.csv and NAME.json, and the figure, if any, as NAME.svg and NAME.png."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(finite(list(rows)), indent=2) + "\n")
    write_rows(out / f"{name}.csv", rows[0] if rows else (), (row.values() for row in rows))
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
        shares = movement.shares(side)
        columns = (places.names, movement.displacements[side].tolist(), shares.tolist())
        for place, displacement, share in zip(*columns, strict=True):
            rows.append(
                {"name": name, "place": place, "displacement": displacement, "share": share}
            )
        path = out / f"explain_{side + 1}{places.suffix}"
        places.save(path, 100 * shares, rotations[side], shifts[side])
    write_analysis(out, f"explain_{movement.correspondence.kind}", rows)


def groups_figure(tests: Sequence[GroupTest]) -> Figure | None:
    """Plot the effects of all tested bodies with their intervals, the largest on top; return None if there are none."""
    tested = sorted(
        (test for test in tests if test.effect is not None), key=lambda test: test.effect or 0
    )
    if not tested:
        return None
    figure = new_figure(6.5, 1.2 + 0.24 * len(tested))
    axes = figure.add_subplot()
    intervals = np.array(
        [(test.effect, test.effect_low, test.effect_high) for test in tested], dtype=float
    )
    for y, (test, (effect, low, high)) in enumerate(zip(tested, intervals, strict=True)):
        colour = _SIGNIFICANT if (test.permanova_q or 0) <= LEVEL else _OTHER
        axes.plot([low, high], [y, y], color=colour, linewidth=1.6)
        axes.plot(effect, y, "o" if colour == _SIGNIFICANT else "s", color=colour, markersize=5)
    axes.axvline(0, color="#BBBBBB", linewidth=0.8, zorder=0)
    axes.set_yticks(range(len(tested)), [shortened(test.body) for test in tested])
    axes.set_xlabel("share of squared distances that the groups explain, 95 % interval")
    axes.set_title(
        f"round, orange: false discovery rate at most {LEVEL:.0%}; square, grey: above", fontsize=9
    )
    return figure


def outliers_figure(pictured: Sequence[tuple[Outlier, str, Mesh]]) -> Figure:
    """Draw bodies with their scores, names and reasons, four in a row; those of a class from the same side."""
    n_rows = -(-len(pictured) // 4)
    figure = new_figure(9, 2.6 * n_rows)
    all_axes = list(figure.subplots(n_rows, 4, squeeze=False).flat)
    for axes in all_axes:
        axes.set_axis_off()
    names = titles_of([name for _, name, _ in pictured])
    first_of_class: dict[str, Mesh] = {}
    for axes, name, (outlier, _, mesh) in zip(all_axes, names, pictured, strict=False):
        small = thumbnail(mesh)
        like = first_of_class.setdefault(outlier.label, small)
        views, bodies = common_views([small] if like is small else [like, small])
        draw_view(axes, views[0], small, bodies[-1], GREY)
        title = "\n".join(wrap(f"{outlier.score:.1f}  {name}", 38) + wrap(outlier.reason, 38))
        axes.set_title(title, fontsize=6, color=_SIGNIFICANT if outlier.is_outlier else "#000000")
    return figure


def painted_figure(
    painted: Sequence[Painted], legend: str, superposed: Sequence[Floats] | None = None
) -> Figure:
    """Draw bodies from the same six sides and in the same scale, coloured by values: red positive, blue negative.

    For `superposed` see `common_views`.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    views, bodies = common_views([body.mesh for body in painted], superposed)
    reach = reach_of(views, bodies)
    everything = np.abs(np.concatenate([body.values for body in painted]))
    largest = float(np.quantile(everything, 0.98)) or float(everything.max()) or 1.0
    lowest = min(float(body.values.min()) for body in painted)
    figure = new_figure(12, 2.4 * len(painted) + 0.6)
    figure.set_layout_engine("constrained", rect=(0, 0, 0.93, 1))
    all_axes = figure.subplots(len(painted), len(views), squeeze=False)
    colour_map = LinearSegmentedColormap.from_list("shares", [_BLUE, _WHITE, _RED])
    scale = ScalarMappable(Normalize(-largest, largest), colour_map)
    names = titles_of([body.name for body in painted])
    for row, body, name, vertices in zip(all_axes, painted, names, bodies, strict=True):
        colours = scale.to_rgba(body.values)[:, :3]
        if body.is_held is not None:
            pale = _WHITE + _PALE * (colours - _WHITE)
            colours = np.where(body.is_held[:, None], colours, pale)
        for axes, view in zip(row, views, strict=True):
            draw_view(axes, view, body.mesh, vertices, colours, reach)
            axes.set_title(view.title, fontsize=7)
        row[0].set_title(f"{name}\n", fontsize=7, loc="left")
    bar = figure.colorbar(scale, cax=figure.add_axes((0.94, 0.2, 0.01, 0.6)))
    bar.ax.set_ylim(-largest if lowest < 0 else 0, largest)
    bar.ax.tick_params(labelsize=6)
    bar.set_label(legend, fontsize=7)
    return figure


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
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("shares", [_BLUE, _WHITE, _RED])
    figure = new_figure(7.5, 2.6 * len(painted))
    all_axes = figure.subplots(len(painted), 3, squeeze=False)
    slices = [_slices(body) for body in painted]
    everything = np.concatenate([values[~np.isnan(values)] for own in slices for values, *_ in own])
    largest = float(np.quantile(np.abs(everything), 0.98)) or 1.0
    names = titles_of([body.name for body in painted])
    for row, name, body, own in zip(all_axes, names, painted, slices, strict=True):
        for axes, (values, extent, title) in zip(row, own, strict=True):
            drawn = axes.imshow(
                values.T, colours, vmin=-largest, vmax=largest, origin="lower", extent=extent
            )
            axes.set_title(f"{title} {body.mesh.unit or ''}", fontsize=7)
            axes.set_axis_off()
        row[0].set_title(f"{name}\n\n", fontsize=7, loc="left")
    bar = figure.colorbar(drawn, ax=all_axes, shrink=0.6)
    bar.ax.tick_params(labelsize=6)
    bar.set_label(legend, fontsize=7)
    return figure


def _slices(body: Painted) -> list[tuple[Floats, tuple[float, ...], str]]:
    """Return the values (X, Y) of three slices, NaN outside of the body, where they lie, and their places in words."""
    assert body.inside is not None
    points = interior_samples(body.mesh)
    middle = points[body.inside(points).argmax()]
    slices = []
    for i, axis in enumerate("xyz"):
        lines = list(grid_axes(body.mesh, _SLICE_RESOLUTION))
        lines[i] = middle[i : i + 1]
        is_inside = inside_grid(body.mesh, (lines[0], lines[1], lines[2]))
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
        values = np.full(is_inside.shape, np.nan)
        values[is_inside] = body.inside(grid[is_inside])
        across = [line for k, line in enumerate(lines) if k != i]
        extent = tuple(float(line[end]) for line in across for end in (0, -1))
        slices.append((values.squeeze(i), extent, f"{axis} = {middle[i]:.4g}"))
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
            marker = _MAP_MARKERS[number // len(PALETTE) % len(_MAP_MARKERS)]
            colour = PALETTE[number % len(PALETTE)]
            handles.append(
                axes.scatter(
                    x[own], y[own], s=20, label=name, linewidths=0.8, marker=marker, color=colour
                )
            )
        if any(
            names
        ):  # with explicit handles, because Matplotlib skips labels that begin with an underscore
            labels = list(map(shortened, names))
            n_columns = 1 + len(names) // 30
            figure.legend(
                handles, labels, loc="outside right upper", title=title, fontsize=7, ncols=n_columns
            )
    else:
        figure.colorbar(axes.scatter(x, y, s=20, c=values, cmap="viridis"), label=title)
    axes.set(aspect="equal", xticks=[], yticks=[], xlabel=f"stress {body_map.stress:.2f}")
    return figure


def clusters_figure(clustering: Clusters, names: Sequence[str]) -> Figure:
    """Plot the tree of bodies, each labelled with its cluster and the stability of the cluster in brackets."""
    figure = new_figure(7, max(2.0, 0.6 + 0.13 * len(names)))
    axes = figure.add_subplot()
    leaves = dendrogram(
        clustering.tree, orientation="left", ax=axes, link_color_func=lambda _: _OTHER
    )["leaves"]
    clusters = clustering.labels[leaves]
    names = [shortened(names[i]) for i in leaves]
    stability = ["–" if np.isnan(value) else f"{value:.2f}" for value in clustering.stability]
    labels = [
        f"{name}  {cluster + 1} ({stability[cluster]})"
        for name, cluster in zip(names, clusters, strict=True)
    ]
    axes.set_yticks(5 + 10 * np.arange(len(leaves)), labels, fontsize=5)
    for label, cluster in zip(axes.get_yticklabels(), clusters, strict=True):
        weight = "bold" if clustering.stability[cluster] >= STABLE else "normal"
        label.set(color=PALETTE[cluster % len(PALETTE)], weight=weight)
    axes.set_xlabel(
        f"distance; after each name: cluster (stability), bold for at least {STABLE}", fontsize=7
    )
    return figure


def precision_recall(curves: Mapping[str, PrecisionRecallCurve], out: Path) -> None:
    """Plot the precision of descriptors at equal levels of recall, both in percent, to a PNG file."""
    figure = new_figure(8.5, 5.2)
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(curves.items()):
        colour = PALETTE[i % len(PALETTE)]
        line = _STYLES[i // len(PALETTE) % len(_STYLES)]
        recall = 100 * curve.recall.numpy()
        precision = 100 * curve.precision.numpy()
        marker = _MARKERS[i % len(_MARKERS)]
        axes.plot(
            recall,
            precision,
            label=name,
            color=colour,
            linestyle=line,
            linewidth=1.4,
            marker=marker,
            markersize=4,
        )
    axes.set(xlim=(0, 102), ylim=(0, 102))
    axes.set_xlabel("recall: share of the query's class that is retrieved (%)")
    axes.set_ylabel("precision: share of the query's class among the retrieved (%)")
    n_queries = [curve.n_queries for curve in curves.values()]
    low = min(n_queries)
    high = max(n_queries)
    axes.set_title(
        f"leave-one-out, mean over {high if low == high else f'{low} to {high}'} queries"
    )
    axes.grid(color="#DDDDDD", linewidth=0.6)
    figure.legend(loc="outside right upper", frameon=False, title="system")
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, out, dpi=130)


# Curves of precision and recall beyond the first round of colours differ by line style and marker
_STYLES = ("-", "--", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h")
_MAP_MARKERS = ("o", "s", "^", "x", "+", "D")
_BLUE, _WHITE, _RED = np.array([[0.0, 0.35, 0.7], [0.9, 0.9, 0.9], [0.84, 0.25, 0.0]])
_PALE = 0.3  # strength of the colours where values do not count

"""Pictures of bodies: colours, a figure without a window, a shaded surface, and ranked results as PNG."""

from __future__ import annotations

import contextlib
import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions
from igps.mesh.simplification import simplify
from igps.mesh.surface import area_vectors, unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""They stay apart for every kind of colour vision (Okabe and Ito 2008)."""
GREY = (0.86, 0.88, 0.92)
_RELEVANT, _IRRELEVANT, _QUERY = PALETTE[1], PALETTE[0], "#444444"
# A thumbnail shows no more detail than this, and drawing takes time with every face.
_THUMBNAIL_VERTICES = 800
_MOST_LETTERS = 60


def paint(axis: Axes, vertices: Floats, faces: Integers, colour: Any) -> None:
    """Draw a surface, lit from the upper right, as seen from +z, in a colour (3,) or one of each face (F, 3)."""
    from matplotlib.collections import PolyCollection

    normals = unit(area_vectors(vertices, faces))
    front = np.nonzero(normals[:, 2] > 0)[0]
    front = front[np.argsort(vertices[faces[front], 2].mean(axis=1))]  # the painter's algorithm: far faces first
    light = normals[front] @ np.array([0.35, 0.45, 0.82])
    of_faces = np.broadcast_to(colour, (len(faces), 3))[front]
    colours = np.clip(0.35 + 0.6 * light, 0, 1)[:, None] * of_faces
    polygons = list(vertices[faces[front], :2])
    axis.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=colours, linewidths=0.3))
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    (x, y), reach = (low + high) / 2, 0.54 * (high - low).max()
    axis.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach), aspect="equal", xticks=[], yticks=[])


def axes_of(points: Floats) -> Floats:
    """(3, 3) columns x, y, z of a right-handed frame: y along the longest principal axis, x along the next.

    The slender end is down and the wider side left, so that poses of one body are seen alike.
    """
    centred = points - points.mean(axis=0)
    axes: Floats = np.linalg.svd(centred, full_matrices=False)[2][:2]
    slender = np.where(((centred @ axes.T) ** 3).mean(axis=0) < 0, -1, 1)
    up, right = -slender[0] * axes[0], slender[1] * axes[1]
    return np.stack([right, up, np.cross(right, up)], axis=1)


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches that is no part of pyplot's state, which is the user's."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: float | None = None) -> None:
    """Save a figure by the suffix of the path, the same each time; a $ in the name of a body begins no formula."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)
    with rc_context({"svg.hashsalt": "igps"}):
        figure.savefig(path, dpi=dpi or "figure", metadata={"Date": None} if path.suffix == ".svg" else None)


def shortened(name: str) -> str:
    """A name as it is drawn: the middle of a long one is left out, which would leave no room for the picture."""
    return name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS // 2]}…{name[1 - _MOST_LETTERS // 2 :]}"


def ranked_results(root: Path, ranking: Path, out: Path, *, top: int = 8, progress: bool = False) -> None:
    """Save a PNG file with a row per class: its first mesh as the query, then the `top` meshes ranked nearest to it.

    `ranking` is the ranking.csv that `igps retrieve` wrote of the meshes below `root`.
    """
    results: dict[str, list[tuple[str, float, bool]]] = {}
    with ranking.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            found = results.setdefault(row["query"], [])
            if len(found) < top:
                found.append((row["model"], float(row["distance"]), row["relevant"] == "1"))
    # A class is a folder in the layouts that this figure is drawn for.
    first = {name.split("/")[0]: name for name in sorted(results, reverse=True)}
    queries = [first[label] for label in sorted(first)]
    figure = new_figure(1.25 * (top + 1), 1.45 * len(queries) + 0.6)
    axes = figure.subplots(len(queries), top + 1, squeeze=False)
    rows = zip(axes, queries, strict=True)
    for row_axes, query in tqdm(rows, desc="ranked results", total=len(queries), disable=not progress):
        shown = [(query, f"query {query}", _QUERY)]
        for model, distance, relevant in results[query]:
            shown.append((model, f"{model}\n{distance:#.3g}", _RELEVANT if relevant else _IRRELEVANT))
        for axis, (name, title, colour) in zip(row_axes, shown, strict=False):
            draw_body(axis, load_mesh(root / name, LoadOptions(allow_open=True)))
            axis.set_title(title, fontsize=5.5, pad=2)
            for side in axis.spines.values():
                side.set(color=colour, linewidth=1.6, linestyle="--" if colour == _IRRELEVANT else "-")
    figure.suptitle(
        "Query (left) and its nearest meshes with their chi-square distance; "
        "blue: same class, orange and dashed: another",
        fontsize=9,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, out, dpi=110)


def draw_body(axis: Axes, mesh: Mesh) -> None:
    """Draw a mesh, shaded and seen along its thinnest principal axis."""
    with contextlib.suppress(MeshError):  # drawn in full, it only takes longer
        mesh = simplify(mesh, _THUMBNAIL_VERTICES)
    paint(axis, seen_from_the_front(mesh.vertices), mesh.faces, GREY)


def seen_from_the_front(vertices: Floats) -> Floats:
    """The same, turned so that the thinnest principal axis is z, the longest y, and the slender end up."""
    return vertices @ (axes_of(vertices) * [-1, -1, 1])

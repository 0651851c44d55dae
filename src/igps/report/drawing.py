"""Drawing with Matplotlib: colours, figures without a window, shaded surfaces, and a figure of ranked results."""

from __future__ import annotations

import contextlib
import csv
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from igps._arrays import Floats, Integers
from igps._progress import Progress
from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.simplification import simplify
from igps.mesh.surface import area_vectors, sums, undirected_edges, unit, vertex_normals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours that remain distinct for colour-blind readers (Okabe and Ito 2008)."""
_DPI = 200  # of surfaces within an SVG file
GREY = (0.86, 0.88, 0.92)
_RELEVANT = PALETTE[1]
_IRRELEVANT = PALETTE[0]
_QUERY = "#444444"
# Enough for the detail of a thumbnail; drawing time grows with the number of faces
_THUMBNAIL_VERTICES = 800
_THUMBNAIL_PIXELS = 128
_MAX_NAME_LENGTH = 60  # characters
_LIGHT: Floats = np.array([0.35, 0.45, 0.82])
# Cosine between the normals of a face and a vertex; with less, their edge stays sharp
_MIN_SMOOTH = 0.75
_MARGIN = 1.08  # of a picture, over the size of the body
_STEP = 0.7  # pixels between the points in place of a face, so that no pixel stays empty
_FAIR_STEPS = (0.5, -0.53) * 20  # of Taubin's smoothing, which shrinks nothing


def paint(
    axis: Axes, vertices: Floats, faces: Integers, colour: Any, reach: float | None = None
) -> None:
    """Draw a surface as seen from +z and lit from the upper right.

    Args:
        axis: where to draw.
        vertices, faces: the surface; only faces that point to the viewer are drawn.
        colour: one colour (3,), or colours of vertices (V, 3).
        reach: distance from the middle of the picture to its edges; by default the surface fills it.
    """
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    own = unit(area_vectors(vertices, faces))
    front = np.nonzero(own[:, 2] > 0)[0]
    depths = vertices[faces[front], 2].mean(axis=1)
    front = front[np.argsort(depths)]  # the painter's algorithm: far faces first
    shown = faces[front]
    normals = vertex_normals(vertices, faces)[shown]
    cosines = np.einsum("fkc,fc->fk", normals, own[front])
    is_crease = cosines < _MIN_SMOOTH
    normals = np.where(is_crease[..., None], own[front][:, None], normals)
    light = np.clip(0.35 + 0.6 * normals @ _LIGHT, 0, 1)
    unlit = np.broadcast_to(colour, vertices.shape)[shown]
    corners = vertices[shown].reshape(-1, 3)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    surface = TriMesh(Triangulation(corners[:, 0], corners[:, 1], triangles), rasterized=True)
    surface.set_facecolor((light[..., None] * unlit).reshape(-1, 3))
    axis.add_collection(surface)
    low = vertices[:, :2].min(axis=0)
    high = vertices[:, :2].max(axis=0)
    x, y = (low + high) / 2
    if reach is None:
        reach = _MARGIN / 2 * (high - low).max()
    axis.set(
        xlim=(x - reach, x + reach),
        ylim=(y - reach, y + reach),
        aspect="equal",
        xticks=[],
        yticks=[],
    )


def shaded(vertices: Floats, faces: Integers, n_pixels: int) -> Floats:
    """Return a picture (n, n, 4) of a surface as `paint` shows it in grey, transparent around it, without Matplotlib.

    Points close together take the place of each face. Those that are nearest to the viewer give the pixels their light.
    """
    flat = vertices[:, :2]
    low = flat.min(axis=0)
    high = flat.max(axis=0)
    pixels = (n_pixels - 1) / (_MARGIN * (high - low).max())
    points = vertices * pixels
    points[:, :2] += (n_pixels - 1) / 2 - pixels * (low + high) / 2
    faces = faces[area_vectors(vertices, faces)[:, 2] > 0]
    light = np.clip(0.35 + 0.6 * vertex_normals(vertices, faces) @ _LIGHT, 0, 1)
    values = np.column_stack([points, light])[faces]
    sides = np.abs(values - np.roll(values, 1, axis=1))[..., :2].max(axis=(1, 2))
    n_steps = np.ceil(sides / _STEP).astype(int) + 1
    parts = []
    for n in np.unique(n_steps):
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        weights = np.stack([i, j, n - i - j], axis=1) / n
        parts.append(np.einsum("pk,fkc->fpc", weights, values[n_steps == n]).reshape(-1, 4))
    x, y, depth, light = np.concatenate([np.empty((0, 4)), *parts]).T
    far_to_near = np.argsort(depth)
    column = np.rint(x[far_to_near]).astype(int)
    row = n_pixels - 1 - np.rint(y[far_to_near]).astype(int)
    picture = np.zeros((n_pixels, n_pixels, 4))
    picture[row, column, :3] = light[far_to_near, None] * GREY
    picture[row, column, 3] = 1
    return picture


def faired(vertices: Floats, faces: Integers) -> Floats:
    """Return vertices (V, 3) without the terraces of voxels, for drawing only (Taubin 1995)."""
    edges, _ = undirected_edges(faces, len(vertices))
    here = edges.ravel()
    there = edges[:, ::-1].ravel()
    counts = np.bincount(here, minlength=len(vertices))
    for step in _FAIR_STEPS:
        means = sums(here, vertices[there], len(vertices)) / counts[:, None]
        vertices = vertices + step * (means - vertices)
    return vertices


def axes_of(points: Floats) -> Floats:
    """Return a right-handed frame (3, 3) of points, columns x, y, z: y is the longest principal axis, x the next.

    The slender end points down and the wide side to the left, so that similar bodies are drawn in the same orientation.
    """
    centred = points - points.mean(axis=0)
    axes: Floats = np.linalg.svd(centred, full_matrices=False)[2][:2]
    signs = np.where(((centred @ axes.T) ** 3).mean(axis=0) < 0, -1, 1)
    up = -signs[0] * axes[0]
    right = signs[1] * axes[1]
    return np.stack([right, up, np.cross(right, up)], axis=1)


def new_figure(width: float, height: float) -> Figure:
    """Return a figure of a size in inches, independent of the state of pyplot, which belongs to the user."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: float | None = None) -> None:
    """Save a figure reproducibly, in the format of the suffix."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)  # a $ in the name of a body does not start a formula
    with rc_context(
        {"svg.hashsalt": "igps"}
    ):  # otherwise, the identifiers in an SVG file are random
        figure.savefig(
            path, dpi=dpi or _DPI, metadata={"Date": None} if path.suffix == ".svg" else None
        )


def shortened(name: str) -> str:
    """Return a name for a figure: the middle of a long name, which would leave no room for the plot, is left out."""
    half = _MAX_NAME_LENGTH // 2
    return name if len(name) <= _MAX_NAME_LENGTH else f"{name[:half]}…{name[1 - half :]}"


def titles_of(names: Sequence[str]) -> list[str]:
    """Return the names of bodies for figures: without the folders that all share, and not too long."""
    folders = {os.path.dirname(name) for name in names}
    shared = os.path.commonpath(folders) if all(folders) else ""
    start = len(shared.rstrip("/")) + 1 if shared else 0
    return [shortened(name[start:]) for name in names]


def file_names(names: Sequence[str]) -> list[str]:
    """Return the titles of bodies as names of files, without an ending."""
    return [re.sub(r"[^\w.-]+", "_", title) for title in titles_of(names)]


def ranked_results(
    root: Path, ranking: Path, out: Path, *, top: int = 8, progress: bool = False
) -> None:
    """Save a figure with one row per class: its first mesh as the query, followed by the meshes nearest to it.

    The meshes lie in `root`, in one subfolder per class; `ranking` is ranking.csv that `igps retrieve` wrote for them.
    """
    results: dict[str, list[tuple[str, float, bool]]] = {}
    with ranking.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            nearest = results.setdefault(row["query"], [])
            if len(nearest) < top:
                nearest.append((row["model"], float(row["distance"]), row["relevant"] == "1"))
    first = {name.split("/")[0]: name for name in sorted(results, reverse=True)}
    queries = [first[label] for label in sorted(first)]
    pictures: dict[str, Floats] = {}
    figure = new_figure(1.25 * (top + 1), 1.45 * len(queries) + 0.6)
    axes = figure.subplots(len(queries), top + 1, squeeze=False)
    rows = zip(axes, queries, strict=True)
    for row_axes, query in Progress(
        rows, desc="ranked results", total=len(queries), disable=not progress
    ):
        shown = [(query, f"query {query}", _QUERY)]
        for model, distance, relevant in results[query]:
            shown.append(
                (model, f"{model}\n{distance:#.3g}", _RELEVANT if relevant else _IRRELEVANT)
            )
        for axis, (name, title, colour) in zip(row_axes, shown, strict=False):
            if name not in pictures:
                mesh = load_mesh(root / name, LoadOptions(allow_open=True))
                pictures[name] = shaded(front_view(mesh.vertices), mesh.faces, _THUMBNAIL_PIXELS)
            axis.imshow(pictures[name])
            axis.set(xticks=[], yticks=[])
            axis.set_title(title, fontsize=5.5, pad=2)
            for side in axis.spines.values():
                side.set(
                    color=colour, linewidth=1.6, linestyle="--" if colour == _IRRELEVANT else "-"
                )
    figure.suptitle(
        "Query (left) and its nearest meshes with their distances; blue: same class; orange, dashed: another class",
        fontsize=9,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, out, dpi=110)


def thumbnail(mesh: Mesh) -> Mesh:
    """Return a simplified mesh for a small picture; the mesh itself if it cannot be simplified."""
    with contextlib.suppress(MeshError):
        mesh = simplify(mesh, _THUMBNAIL_VERTICES)
    return mesh


def front_view(vertices: Floats) -> Floats:
    """Rotate vertices so that z is the thinnest principal axis and y the longest, with the slender end up."""
    return vertices @ (axes_of(vertices) * [-1, -1, 1])

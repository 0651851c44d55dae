"""Drawing with Matplotlib: colours, figures without a window, and shaded surfaces."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.simplification import simplify
from igps.mesh.surface import area_vectors, sums, undirected_edges, unit, vertex_normals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours that remain distinct for colour-blind readers (Okabe and Ito 2008)."""
_DPI = 200  # of surfaces within an SVG file
GREY = (0.86, 0.88, 0.92)
# Enough for the detail of a thumbnail; drawing time grows with the number of faces
_THUMBNAIL_VERTICES = 800
_MAX_NAME_LENGTH = 60  # characters
_LIGHT: Floats = np.array([0.35, 0.45, 0.82])
# Cosine between the normals of a face and a vertex; with less, their edge stays sharp
_MIN_SMOOTH = 0.75
_MARGIN = 1.08  # of a picture, over the size of the body
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
    front = np.flatnonzero(own[:, 2] > 0)
    depths = vertices[faces[front], 2].mean(axis=1)
    front = front[np.argsort(depths)]  # the painter's algorithm: far faces first
    shown = faces[front]
    own = own[front]
    normals = vertex_normals(vertices, faces)[shown]
    cosines = np.einsum("fkc,fc->fk", normals, own)
    is_crease = cosines < _MIN_SMOOTH
    normals = np.where(is_crease[..., None], own[:, None], normals)
    light = np.clip(0.35 + 0.6 * normals @ _LIGHT, 0, 1)
    unlit = np.broadcast_to(colour, vertices.shape)[shown]
    lit = light[..., None] * unlit
    corners = vertices[shown].reshape(-1, 3)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    triangulation = Triangulation(corners[:, 0], corners[:, 1], triangles)
    surface = TriMesh(triangulation, rasterized=True)
    surface.set_facecolor(lit.reshape(-1, 3))
    axis.add_collection(surface)
    plane = vertices[:, :2]
    low = plane.min(axis=0)
    high = plane.max(axis=0)
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


def faired(vertices: Floats, faces: Integers) -> Floats:
    """Return vertices (V, 3) without the terraces of voxels, for drawing only (Taubin 1995)."""
    edges, _ = undirected_edges(faces)
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
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    axes = axes[:2]
    along = centred @ axes.T
    has_slender_end_ahead = (along**3).mean(axis=0) >= 0
    up = np.where(has_slender_end_ahead[0], -axes[0], axes[0])
    right = np.where(has_slender_end_ahead[1], axes[1], -axes[1])
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
    metadata = {"Date": None} if path.suffix == ".svg" else None
    # Without it, the identifiers in an SVG file are random
    with rc_context({"svg.hashsalt": "igps"}):
        figure.savefig(path, dpi=dpi or _DPI, metadata=metadata)


def shortened(name: str) -> str:
    """Return a name for a figure: the middle of a long name, which would leave no room for the plot, is left out."""
    if len(name) <= _MAX_NAME_LENGTH:
        return name
    half = _MAX_NAME_LENGTH // 2
    return f"{name[:half]}…{name[1 - half :]}"


def titles_of(names: Sequence[str]) -> list[str]:
    """Return the names of bodies for figures: without the folders that all share, and not too long."""
    folders = {os.path.dirname(name) for name in names}
    shared = os.path.commonpath(folders) if all(folders) else ""
    start = len(shared.rstrip("/")) + 1 if shared else 0
    return [shortened(name[start:]) for name in names]


def file_names(names: Sequence[str]) -> list[str]:
    """Return the titles of bodies as names of files, without an ending."""
    return [re.sub(r"[^\w.-]+", "_", title) for title in titles_of(names)]


def thumbnail(mesh: Mesh) -> Mesh:
    """Return a simplified mesh for a small picture; the mesh itself if it cannot be simplified."""
    with contextlib.suppress(MeshError):
        mesh = simplify(mesh, _THUMBNAIL_VERTICES)
    return mesh

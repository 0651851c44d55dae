"""What the pictures share: colours, a figure without a window, and a shaded surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from igps.mesh.surface import area_vectors, unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Colour = tuple[float, float, float]

GREY: Colour = (0.86, 0.88, 0.92)
BLUE: Colour = (0.55, 0.72, 0.95)
PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""They stay apart for every kind of colour vision (Okabe and Ito 2008)."""


def paint(axis: Axes, vertices: NDArray[np.float64], faces: NDArray[np.int64], colour: Any) -> None:
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


def axes_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) columns x, y, z of a right-handed frame: y along the longest principal axis, x along the next.

    The slender end is down and the wider side left, so that poses of one body are seen alike.
    """
    centred = points - points.mean(axis=0)
    axes: NDArray[np.float64] = np.linalg.svd(centred, full_matrices=False)[2][:2]
    slender = np.where(((centred @ axes.T) ** 3).mean(axis=0) < 0, -1, 1)
    up, right = -slender[0] * axes[0], slender[1] * axes[1]
    return np.stack([right, up, np.cross(right, up)], axis=1)


def new_figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)  # draws to a file without touching the user's pyplot state
    return figure

"""From which sides bodies are seen: the sides of the patient if these are known, otherwise those of the first body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from igps._arrays import Floats
from igps.analysis.alignment import rigid_motion
from igps.mesh.mesh import Mesh
from igps.report.drawing import axes_of, faired, paint

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LETTERS = (("L", "R"), ("P", "A"), ("I", "S"))  # of the negative and the positive end of x, y, z
_EDGES = ((0.04, 0.5), (0.96, 0.5), (0.5, 0.03), (0.5, 0.97))  # left, right, lower, upper
_SIDES = {
    "R": "from the right",
    "L": "from the left",
    "A": "from the front",
    "P": "from behind",
    "S": "from above",
    "I": "from below",
}
# Directions to the viewer and upwards, in the axes of the patient (RAS). As in radiology, the patient's right side is
# on the left of the pictures from the front and from below.
_DIRECTIONS: Floats = np.array(
    [
        [[0, 1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, 1]],
        [[0, 0, 1], [0, 1, 0]],
        [[0, 0, -1], [0, 1, 0]],
    ],
    dtype=np.float64,
)
# The patient's axes in a frame whose third axis points to the viewer and whose second points up, seen from the front
_FRONT: Floats = np.array([[-1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])


@dataclass(frozen=True, eq=False)
class View:
    """A side from which a body is seen."""

    title: str
    axes: Floats  # (3, 3) columns point to the right of the picture, upwards, and to the viewer
    letters: tuple[str, ...]  # of the patient at the left, right, lower and upper edge, or none


def letter_of(direction: Floats) -> str:
    """Return the letter of the patient's side to which a vector in RAS points, such as "L"."""
    axis = int(np.argmax(np.abs(direction)))
    return _LETTERS[axis][int(direction[axis] > 0)]


def patient_views() -> list[View]:
    """Return the views from the front, the left, behind, the right, above and below, in RAS."""
    views = []
    for toward, up in _DIRECTIONS:
        right = np.cross(up, toward)
        letters = tuple(letter_of(edge) for edge in (-right, right, -up, up))
        axes = np.stack([right, up, toward], axis=1)
        views.append(View(_SIDES[letter_of(toward)], axes, letters))
    return views


def numbered_views(axes: Floats) -> list[View]:
    """Return the six views of a body whose frame is not known, "view 1" along its axes (3, 3) of `axes_of`."""
    views = []
    for number, view in enumerate(patient_views(), 1):
        views.append(View(f"view {number}", axes @ _FRONT @ view.axes, ()))
    return views


def common_views(
    meshes: Sequence[Mesh], superposed: Sequence[Floats] | None = None
) -> tuple[list[View], list[Floats]]:
    """Return views from the same sides for bodies that are compared, and the vertices (V, 3) of each to draw.

    In the frame of the patient, bodies lie as they are, without the terraces of voxels. Others are first moved onto the
    first body, without mirroring.
    """
    if all(mesh.frame == "RAS" for mesh in meshes):
        return patient_views(), [faired(mesh.vertices, mesh.faces) for mesh in meshes]
    first = meshes[0]
    if superposed is not None:
        return numbered_views(axes_of(first.vertices)), list(superposed)
    moved = [first.vertices]
    for mesh in meshes[1:]:
        motion = rigid_motion(mesh, first)
        moved.append(motion.of(mesh.vertices))
    return numbered_views(axes_of(first.vertices)), moved


def draw_view(
    axis: Axes, view: View, mesh: Mesh, vertices: Floats, colour: Any, reach: float | None = None
) -> None:
    """Draw a body from a side, with the letters of the patient at the edges and a bar of known length.

    Args:
        axis: where to draw.
        view: the side.
        mesh: the body, which gives the faces and the unit of length.
        vertices: (V, 3) its vertices by `common_views`.
        colour: see `paint`.
        reach: see `paint`; bodies drawn with the same are in the same scale. By default the body fills the picture.
    """
    if reach is None:
        reach = reach_of([view], [vertices])
    paint(axis, vertices @ view.axes, mesh.faces, colour, reach)
    for letter, (x, y) in zip(view.letters, _EDGES, strict=False):
        axis.text(
            x,
            y,
            letter,
            transform=axis.transAxes,
            ha="center",
            va="center",
            fontsize=7,
            gid="side",
        )
    _draw_bar(axis, mesh.unit)


def _draw_bar(axis: Axes, unit: str | None) -> None:
    """Draw a bar whose length is 1, 2 or 5 times a power of ten, about a third of the picture."""
    left, right = axis.get_xlim()
    bottom, top = axis.get_ylim()
    width = right - left
    longest = 0.35 * width
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(step * power for step in (1, 2, 5) if step * power <= longest)
    x = left + 0.05 * width
    y = bottom + 0.04 * (top - bottom)
    axis.plot([x, x + length], [y, y], color="black", linewidth=1.2, solid_capstyle="butt")
    middle = x + length / 2
    text = f"{length:g} {unit or '(no unit)'}"
    axis.text(middle, y, text, ha="center", va="bottom", fontsize=5)


def reach_of(views: Sequence[View], bodies: Sequence[Floats]) -> float:
    """Return the distance from the middle of a picture to its edges that shows each of the bodies in each view."""
    sides = []
    for view in views:
        for vertices in bodies:
            width_and_height = np.ptp(vertices @ view.axes, axis=0)[:2]
            sides.append(width_and_height.max())
    return float(0.6 * max(sides))  # with room for the letters

"""A picture of generated shapes, saved as PNG."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from igps.report.drawing import new_figure, paint
from igps.shapes import ArticulatedShapes
from training.graded import GradedShape, GradedShapes


def contact_sheet(
    shapes: ArticulatedShapes | GradedShapes, path: str | Path, n_shown: int = 1
) -> None:
    """Save a picture of the first shapes of every class, all in the same orientation.

    Args:
        shapes: the generated benchmark.
        path: the PNG file.
        n_shown: number of shapes of each class.

    Raises:
        ValueError: `n_shown` is out of range.
    """
    n_per_class = len(shapes) // shapes.n_classes
    if not 1 <= n_shown <= n_per_class:
        raise ValueError(
            f"n_shown: expected 1 to {n_per_class}, the shapes of a class, got {n_shown}. Choose another number."
        )
    chosen = [c * n_per_class + i for c in range(shapes.n_classes) for i in range(n_shown)]
    columns = min(len(chosen), max(4, math.ceil(math.sqrt(1.6 * len(chosen)))))
    rows = math.ceil(len(chosen) / columns)
    figure = new_figure(1.7 * columns, 1.85 * rows)
    view = Rotation.from_euler(
        "zx", (-35, -70), degrees=True
    ).as_matrix()  # from the left, in front and above
    for place, index in enumerate(chosen, 1):
        shape = shapes[index]
        motion = shape.motion if isinstance(shape, GradedShape) else shape.rotation
        axis = figure.add_subplot(rows, columns, place)
        # A motion that mirrors turns the faces inside out
        faces = shape.faces if np.linalg.det(motion) > 0 else shape.faces[:, ::-1]
        paint(axis, shape.vertices @ motion @ view.T, faces, (0.55, 0.72, 0.95))
        axis.set_axis_off()
        axis.set_title(shape.name if n_shown > 1 else shape.label, fontsize=5, pad=1)
    figure.savefig(path, dpi=110)

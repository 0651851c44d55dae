"""The picture of how-to/where-inside.md: three generated bodies, their images, and what the numbers tell.

python -m docs.inside_picture docs/pictures/inside.png
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jsonargparse import auto_cli

from igps._arrays import Booleans, Floats
from igps.analysis.inside import CLASSES
from igps.analysis.inside_objects import inside
from igps.cli import errors_as_messages
from igps.report.drawing import PALETTE, new_figure, save_figure

SHAPE = (48, 40, 32)
Example = Callable[[Floats, Floats, Floats], tuple[Booleans, Floats]]
"""A function of coordinates of voxels to a label and an image."""


def tumour(x: Floats, y: Floats, z: Floats) -> tuple[Booleans, Floats]:
    """Return a lump with a bright rim and a dark core."""
    wave = 1 + 0.12 * np.sin(x / 4) * np.cos(y / 5)
    radius = np.sqrt((x / 15) ** 2 + (y / 12) ** 2 + (z / 11) ** 2) * wave
    return radius < 1, 40 + 60 * np.exp(-(((radius - 0.9) / 0.2) ** 2))


def cell(x: Floats, y: Floats, z: Floats) -> tuple[Booleans, Floats]:
    """Return a long cell with protein at one of its ends."""
    label = (x / 20) ** 2 + (y / 11) ** 2 + (z / 9) ** 2 < 1
    return label, 20 + 80 / (1 + np.exp(-(x - 9) / 2))


def hippocampus(x: Floats, y: Floats, z: Floats) -> tuple[Booleans, Floats]:
    """Return a bent tube that is bright in the middle of its length and of its thickness."""
    angle = np.arctan2(y + 8, x)
    from_line = np.sqrt((np.hypot(x, y + 8) - 16) ** 2 + z**2)
    thickness = 4.5 + 2 * np.cos(angle)
    label = (from_line < thickness) & (y > -8)
    return label, 100 - 30 * np.abs(angle - np.pi / 2) - 3 * from_line


QUESTIONS: dict[str, Example] = {
    "Is the tumour bright at its rim?": tumour,
    "Where in the cell is the protein?": cell,
    "Where in the hippocampus is it bright?": hippocampus,
}


def picture(out: Path) -> None:
    """Draw a slice of each image with the outline of the body, and its contrasts.

    Args:
        out: PNG file.
    """
    x, y, z = (np.indices(SHAPE).T - (np.array(SHAPE) - 1) / 2).T
    figure = new_figure(9, 5.2)
    all_axes = figure.subplots(2, len(QUESTIONS))
    for column, (question, example) in enumerate(QUESTIONS.items()):
        label, image = example(x, y, z)
        (row,) = inside(image, label, spacing=(1, 1, 1))
        middle = SHAPE[2] // 2
        above, below = all_axes[:, column]
        shown = np.where(label, image, np.nan)[:, :, middle]
        above.imshow(shown.T, origin="lower", cmap="magma")
        above.contour(label[:, :, middle].T, levels=[0.5], colors="#888888", linewidths=0.8)
        above.set_title(question, fontsize=9)
        above.set_axis_off()
        contrasts = [row[f"image.{name}.contrast"] for name in CLASSES]
        below.barh(range(len(CLASSES)), contrasts, color=PALETTE[0])
        below.set_yticks(range(len(CLASSES)), CLASSES, fontsize=8)
        below.invert_yaxis()
        below.axvline(0, color="#BBBBBB", linewidth=0.8)
        below.set_xlim(-2.2, 2.2)
        correlation = row["image.axis1.correlation"]
        below.set_xlabel(f"contrast; axis1.correlation {correlation:.2f}", fontsize=8)
    save_figure(figure, out, dpi=90)


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(picture)

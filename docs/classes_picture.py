"""A picture of one shape of each class that `pretrained` was fitted to: python -m docs.classes_picture OUT.png

It takes minutes, and needs pillow beside the library.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation
from training.shapes import GradedShapes

from igps.report.drawing import new_figure, paint

CONFIG = Path(__file__).parents[1] / "configs" / "pretrain.yaml"
WIDTH = 1400  # pixels
BLUE = (0.55, 0.72, 0.95)


def contact_sheet(shapes: GradedShapes, path: Path) -> None:
    """Save a picture of the first shape of every class, all in the same orientation."""
    n = shapes.n_classes
    n_columns = min(n, max(4, math.ceil(math.sqrt(1.6 * n))))
    n_rows = math.ceil(n / n_columns)
    figure = new_figure(1.7 * n_columns, 1.85 * n_rows)
    # From the left, in front and above.
    view = Rotation.from_euler("zx", (-35, -70), degrees=True).as_matrix()
    for number in range(n):
        shape = shapes[number * len(shapes) // n]
        panel = figure.add_subplot(n_rows, n_columns, number + 1)
        # A motion that mirrors turns the faces inside out.
        is_mirrored = np.linalg.det(shape.motion) < 0
        faces = shape.faces[:, ::-1] if is_mirrored else shape.faces
        paint(panel, shape.vertices @ shape.motion @ view.T, faces, BLUE)
        panel.set_axis_off()
        panel.set_title(shape.label, fontsize=5, pad=1)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    fitted_to = yaml.safe_load(CONFIG.read_text())
    arguments = [fitted_to[name] for name in ("n_classes", "n_bodies", "n_poses", "seed")]
    out = Path(sys.argv[1])
    contact_sheet(GradedShapes(*arguments), out)
    picture = Image.open(out).convert("RGB")
    height = round(WIDTH * picture.height / picture.width)
    picture = picture.resize((WIDTH, height), Image.Resampling.LANCZOS)
    picture.quantize(64, dither=Image.Dither.NONE).save(out, optimize=True)
    print(f"{out}: {out.stat().st_size // 1000} kB")

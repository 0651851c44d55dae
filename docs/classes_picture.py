"""A picture of one shape of each class that `pretrained` was fitted to: python -m docs.classes_picture OUT.png

It takes minutes, and needs pillow beside the library.
"""

from __future__ import annotations

import sys
from pathlib import Path

import yaml
from PIL import Image
from training.graded import GradedShapes
from training.studies.contact_sheet import contact_sheet

WIDTH = 1400  # pixels

fitted_to = yaml.safe_load(Path("configs/pretrain.yaml").read_text())
shapes = GradedShapes(*(fitted_to[name] for name in ("n_classes", "n_bodies", "n_poses", "seed")))
out = Path(sys.argv[1])
contact_sheet(shapes, out)
picture = Image.open(out).convert("RGB")
picture = picture.resize(
    (WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.LANCZOS
)
picture.quantize(64, dither=Image.Dither.NONE).save(out, optimize=True)
print(f"{out}: {out.stat().st_size // 1000} kB")

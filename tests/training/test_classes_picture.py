"""The picture of the generated classes shows each class, right side out."""

import numpy as np
import pytest
import trimesh
from docs import classes_picture
from docs.classes_picture import contact_sheet
from matplotlib.image import imread
from training.shapes import GradedShapes


def test_every_class_is_drawn_right_side_out(tmp_path, monkeypatch):
    shapes = GradedShapes(n_classes=5, n_bodies=1, n_poses=1, seed=1, n_vertices=(1500, 1500))
    made = list(shapes)
    is_mirrored = {bool(np.linalg.det(shape.motion) < 0) for shape in made}
    assert is_mirrored == {True, False}
    drawn = []
    paint = classes_picture.paint

    def record(panel, vertices, faces, colour):
        drawn.append(trimesh.Trimesh(vertices, faces, process=False))
        paint(panel, vertices, faces, colour)

    monkeypatch.setattr(classes_picture, "paint", record)
    contact_sheet(shapes, tmp_path / "sheet.png")
    for body, shape in zip(drawn, made, strict=True):
        volume = trimesh.Trimesh(shape.vertices, shape.faces, process=False).volume
        assert volume > 0
        assert body.volume == pytest.approx(volume)
    picture = imread(tmp_path / "sheet.png")[:, :, :3]
    bluish = (picture[:, :, 2] - picture[:, :, 0] > 0.1).sum(axis=0)
    width = bluish.size // 4
    for i in range(4):
        assert bluish[i * width : (i + 1) * width].sum() > 1000

"""The picture of several descriptors side by side."""

import numpy as np
import torch
from matplotlib.image import imread

from igps.report import figures
from igps.retrieval import precision_recall_curve


def test_curves_are_drawn_in_percent_and_told_apart(tmp_path, figures_of):
    made = figures_of(figures)
    labels = [0, 0, 0, 1, 1, 1]
    draws = np.random.default_rng(0).random((12, 6, 6))
    curves = {
        f"descriptor {i}": precision_recall_curve(torch.from_numpy(draw), labels)
        for i, draw in enumerate(draws)
    }
    figures.precision_recall(curves, tmp_path / "deep" / "curves.png")
    (axes,) = made[0].axes
    assert len(axes.lines) == 12
    for line, (name, curve) in zip(
        axes.lines,
        curves.items(),
        strict=True,
    ):
        assert line.get_label() == name
        np.testing.assert_allclose(line.get_xdata(), 100 * curve.recall)
        np.testing.assert_allclose(line.get_ydata(), 100 * curve.precision)
    looks = {(line.get_color(), line.get_linestyle()) for line in axes.lines}
    assert len(looks) == 12
    assert "%" in axes.get_xlabel()
    assert "%" in axes.get_ylabel()
    assert [text.get_text() for text in made[0].legends[0].get_texts()] == list(curves)
    assert imread(tmp_path / "deep" / "curves.png").std() > 0.05

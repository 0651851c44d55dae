import numpy as np
import pytest
import trimesh

from igps.report.drawing import axes_of


def test_turned_body_is_drawn_alike():
    body = trimesh.creation.cone(radius=0.4, height=2.0, sections=24)
    turned = body.vertices @ trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3].T
    straight = body.vertices @ axes_of(body.vertices)
    back = turned @ axes_of(turned)
    np.testing.assert_allclose(np.ptp(back, axis=0)[1], np.ptp(straight, axis=0)[1], rtol=1e-6)
    for view in (straight, back):
        tip = view[np.argmax(np.linalg.norm(view - view.mean(axis=0), axis=1))]
        assert tip[1] == pytest.approx(view[:, 1].min())  # the slender end is down


def test_view_is_no_mirror_image():
    points = np.random.default_rng(0).random((50, 3)) * [1, 2, 3]
    assert np.linalg.det(axes_of(points)) == pytest.approx(1)

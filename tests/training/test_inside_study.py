"""The study of where a signal lies: what is known of its bodies and values."""

import numpy as np
import pytest
import trimesh
from docs.benchmarks.inside import at_rest, rejections
from numpy.random import default_rng
from scipy.spatial.transform import Rotation
from training.shapes.bodies import Pose

from igps.analysis.inside import column_names


def test_points_of_a_moved_body_are_moved_back():
    ball = trimesh.creation.icosphere(subdivisions=2)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    bent = ball.vertices @ turn.T + [1.0, 2.0, 3.0]
    pose = Pose(
        np.asarray(ball.vertices),
        bent,
        np.asarray(ball.faces),
        0.0,
    )
    points = default_rng(0).uniform(-0.5, 0.5, (50, 3))
    np.testing.assert_allclose(at_rest(points @ turn.T + [1.0, 2.0, 3.0], pose), points, atol=1e-9)


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_groups_are_told_apart_only_if_they_differ(shift):
    rows = default_rng(1).normal(size=(24, len(column_names(["x"]))))
    rows[12:] += shift
    assert rejections(rows, 12, 0, has_numbers=True) == [bool(shift)] * 4

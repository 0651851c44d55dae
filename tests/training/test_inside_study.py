"""The study of where a signal lies: what is known of its bodies and values."""

import numpy as np
import pytest
import trimesh
from docs.benchmarks.inside import at_rest, equal_histogram, nearest_share, rejections
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
    found = at_rest(points @ turn.T + [1.0, 2.0, 3.0], pose)
    np.testing.assert_allclose(found, points, atol=1e-9)


def test_values_of_all_bodies_have_the_same_histogram():
    random = default_rng(0)
    first = random.normal(size=300)
    second = random.gamma(1.0, size=300) * 1000
    values = equal_histogram(first)
    found = np.sort(values)
    expected = np.sort(equal_histogram(second))
    np.testing.assert_allclose(found, expected)
    np.testing.assert_array_equal(values.argsort(), first.argsort())


def test_the_share_of_neighbours_is_counted_among_other_rows():
    rows = np.array([[0.0, 5], [0.1, 5], [1.0, 5], [1.1, 5]])
    assert nearest_share(rows, ["a", "a", "b", "b"]) == 1
    assert nearest_share(rows, ["a", "b", "b", "b"]) == 0.5


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_groups_are_told_apart_only_if_they_differ(shift):
    rows = default_rng(1).normal(size=(24, len(column_names(["x"]))))
    rows[12:] += shift
    found = rejections(rows, 12, 0, has_numbers=True)
    assert found == [bool(shift)] * 4

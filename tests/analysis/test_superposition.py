"""Corresponding points are superposed by the part that moves as one, whatever the others do."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from igps.analysis.superposition import superposition


def test_the_largest_rigid_part_is_superposed():
    """Of 100 points, 60 move as one, and 40 by another motion."""
    random = np.random.default_rng(0)
    points = random.normal(size=(100, 3))
    turn = Rotation.from_rotvec([0.3, -1.1, 0.4])
    others = turn.inv().apply(points - [5.0, -2.0, 1.0])
    away = np.arange(100) >= 60
    moved = Rotation.from_rotvec([0.0, 0.9, 0.0]).apply(points[away])
    others[away] = turn.inv().apply(moved - [5.0, -2.0, 1.0])
    found = superposition(points, others)
    assert_allclose(found.rotation, turn.as_matrix(), atol=1e-5)
    assert_allclose(found.shift, [5.0, -2.0, 1.0], atol=1e-5)
    steps = np.linalg.norm(moved - points[away], axis=1)
    assert_allclose(found.distances[away], steps, atol=1e-4)
    assert found.distances[~away].max() < 1e-4


def test_equal_errors_of_all_points_are_those_of_least_squares():
    random = np.random.default_rng(1)
    points = random.normal(size=(50, 3))
    others = points + 0.01 * random.normal(size=(50, 3))
    found = superposition(points, others)
    turn, _ = Rotation.align_vectors(
        points - points.mean(axis=0),
        others - others.mean(axis=0),
    )
    angle = (Rotation.from_matrix(found.rotation) * turn.inv()).magnitude()
    assert angle < 0.005
    assert np.median(found.distances) == pytest.approx(0.01 * np.sqrt(2.37), rel=0.2)

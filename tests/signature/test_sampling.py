"""Random points of a surface: evenly distributed, reproducible, and interpolated linearly."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.stats import chisquare, kstest

from conftest import FACES, TETRAHEDRON
from igps.mesh.mesh import Mesh
from igps.mesh.surface import face_areas
from igps.signature.sampling import surface_points


def test_faces_are_drawn_by_their_area():
    mesh = Mesh(TETRAHEDRON * [1, 2, 5], FACES)
    counts = np.bincount(
        surface_points(mesh, 20_000, seed=0).face,
        minlength=4,
    )
    area = face_areas(mesh.vertices, mesh.faces)
    assert chisquare(counts, 20_000 * area / area.sum()).pvalue > 0.01
    assert chisquare(counts, np.full(4, 5000)).pvalue < 1e-9


def test_points_are_even_within_a_face():
    """Each barycentric coordinate w of an even distribution has P(w < x) = 1 − (1 − x)²."""
    weights = surface_points(Mesh(TETRAHEDRON, FACES), 20_000, seed=1).weights
    assert weights.min() >= 0
    assert_allclose(weights.sum(axis=1), 1)
    for coordinate in weights.T:
        assert kstest(coordinate, lambda x: 1 - (1 - x) ** 2).pvalue > 0.01


def test_linear_functions_are_interpolated_exactly(blob):
    points = surface_points(blob, 500, seed=2)
    slopes = np.random.default_rng(0).normal(size=(3, 4))
    assert_allclose(
        points.interpolate(blob.vertices @ slopes), points.positions @ slopes, atol=1e-12
    )
    corners = blob.vertices[blob.faces[points.face]]
    normals = np.cross(
        corners[:, 1] - corners[:, 0],
        corners[:, 2] - corners[:, 0],
    )
    assert_allclose(
        np.einsum("ij,ij->i", points.positions - corners[:, 0], normals),
        0,
        atol=1e-12,
    )


def test_the_seed_alone_decides(blob):
    one, same, other = (surface_points(blob, 50, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.positions, same.positions)
    assert np.abs(one.positions - other.positions).max() > 0.1

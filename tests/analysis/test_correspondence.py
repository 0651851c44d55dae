"""The curvatures and thickness that explanations compare are those of closed forms, deviations those of SciPy."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import mahalanobis

from conftest import as_mesh
from igps.analysis.dissimilarity import REQUIREMENTS, local_shape, squared_deviations
from igps.data.collation import collate
from igps.signature.signature import SignatureConfig, compute_signature

RADIUS, HALF_LENGTH = 1.0, 1.6


def spheroid(subdivisions, n_samples):
    """Return the signature of a spheroid along the z axis."""
    body = trimesh.creation.icosphere(subdivisions=subdivisions)
    body.vertices *= [RADIUS, RADIUS, HALF_LENGTH]
    config = SignatureConfig(n_eigenpairs=10, resolution=16, n_surface_samples=n_samples)
    config = REQUIREMENTS.apply_to(config)
    return compute_signature(as_mesh(body), config)


def test_curvatures_and_thickness_of_a_spheroid():
    """A ball inside that touches at a point is centred on the axis, where the normal meets it."""
    body = spheroid(subdivisions=5, n_samples=6000)
    measured = local_shape(collate([body])[0])
    x, y, z = body.surface.points.T
    slant = np.sqrt((x**2 + y**2) / RADIUS**4 + z**2 / HALF_LENGTH**4)
    of_circles = 1 / (RADIUS**2 * slant)
    of_meridians = 1 / (RADIUS**2 * HALF_LENGTH**2 * slant**3)
    unit = np.sqrt(body.area)
    exact = np.sort(0.04 * unit * np.stack([of_circles, of_meridians], axis=1), axis=1)
    errors = measured[:, :2] / exact - 1
    assert np.sqrt(np.square(errors).mean(axis=0)).max() < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.02
    assert measured[:, :2].mean(axis=1) == pytest.approx(exact.mean(axis=1), rel=0.1)
    # Normals of flat faces
    assert np.exp(measured[:, 2]) * unit * of_circles == pytest.approx(1, rel=0.25)


def test_a_rough_surface_is_no_thinner():
    """Neighbours a little below the tangent plane make no ball small."""
    body = spheroid(subdivisions=4, n_samples=2000)
    points = body.surface.points
    step = 0.001 * np.sqrt(body.area) * np.random.default_rng(0).normal(size=points.shape)
    rough = replace(body, surface=replace(body.surface, points=points + step))
    thickness = [local_shape(collate([each])[0])[:, 2] for each in (body, rough)]
    assert thickness[1] == pytest.approx(thickness[0], abs=0.6)


def test_deviations_are_mahalanobis_distances_from_the_corresponding_samples():
    """To the covariance at a place, a hundredth of that of the whole body is added."""
    random = np.random.default_rng(0)
    own = random.normal(size=(20, 3))
    others = random.normal(size=(50, 3)) @ random.normal(size=(3, 3))
    nearest = random.integers(50, size=(20, 10))
    expected = []
    for row, indices in zip(own, nearest, strict=True):
        covariance = np.cov(others[indices].T, ddof=0) + 0.01 * np.cov(others.T, ddof=0)
        mean = others[indices].mean(axis=0)
        expected.append(mahalanobis(row, mean, np.linalg.inv(covariance)) ** 2)
    assert squared_deviations(own, others, nearest) == pytest.approx(np.array(expected), rel=1e-6)

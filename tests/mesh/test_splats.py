"""Discs around the points of a cloud."""

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from scipy.spatial import cKDTree

from igps.mesh.watertight import splats


def sphere(n):
    points = np.random.default_rng(0).normal(size=(n, 3))
    return points / norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("with_normals", [True, False])
def test_each_point_has_a_hexagon_across_the_surface(with_normals):
    """Centred on it, in the plane of its normal, which on a sphere is the radius."""
    points = sphere(2000)
    vertices, faces, _ = splats(points, points if with_normals else None, 32, "cloud")
    assert vertices.shape == (12_000, 3)
    assert faces.shape == (8_000, 3)
    rims = vertices.reshape(-1, 6, 3)
    assert rims.mean(axis=1) == pytest.approx(points, abs=1e-12)
    tilt = np.abs(np.einsum("nki,ni->nk", rims - points[:, None], points)).max(axis=1)
    size = norm(rims[:, 0] - points, axis=1)
    assert np.quantile(tilt / size, 0.9) < (1e-12 if with_normals else 0.2)
    hexagons = trimesh.Trimesh(vertices, faces, process=False).area_faces.reshape(-1, 4).sum(axis=1)
    assert hexagons == pytest.approx(1.5 * 3**0.5 * size**2)


def test_only_large_clouds_are_thinned():
    """Two scans of one surface in one file: all of it counts, until there are too many points."""
    points = np.concatenate([sphere(500), sphere(500) + 1e-4])
    assert len(splats(points, points, 32, "cloud")[0]) == 6 * 1000
    points = np.concatenate([sphere(110_000), sphere(110_000) + 1e-4])
    cell = 2.0 / (4 * 32)
    thinned = splats(points, points, 32, "cloud")[0].reshape(-1, 6, 3).mean(axis=1)
    assert len(thinned) < 60_000  # the sphere goes through about 4π / cell² cells
    # What is left is of the cloud, and near to all that went.
    away, _ = cKDTree(thinned).query(points)
    assert away.max() < 1.01 * cell * 3**0.5

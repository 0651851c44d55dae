import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from one_body import of_mesh
from scipy.special import eval_legendre
from shortest_paths import geodesic_distances

from igps.descriptors.literature.geodesic_spectral import GeodesicSpectral, affinity_eigenvalues
from own_descriptors import changed


def sphere_eigenvalues(count):
    """Of exp(−θ²/2π²) on the sphere over its area: ½ ∫ exp(−θ²/2π²) Pₗ(cos θ) sin θ dθ, 2l + 1 times (Funk, Hecke)."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    angle = (nodes + 1) * np.pi / 2
    kernel = np.exp(-(angle**2) / (2 * np.pi**2)) * np.sin(angle) * weights * np.pi / 4
    values = []
    for degree in range(12):
        value = (kernel * eval_legendre(degree, np.cos(angle))).sum()
        values += [value] * (2 * degree + 1)
    return np.sort(values)[::-1][:count]


def test_eigenvalues_of_great_circles(sphere):
    # Vertices of an icosphere are nearly uniform, so that the matrix is a quadrature of the integral operator.
    points = sphere.vertices[:642]  # the vertices of the next coarser icosphere
    distances = np.arccos(np.clip(points @ points.T, -1, 1))
    expected = sphere_eigenvalues(16)
    assert expected[0] > 5 * expected[1] > 0
    assert expected[1] == pytest.approx(expected[3])
    assert_allclose(affinity_eigenvalues(distances, 16), expected, atol=1e-3)


def test_description_of_the_sphere(sphere):
    descriptor = changed(GeodesicSpectral(), n_eigenvalues=9, n_samples=300, max_vertices=2562)
    described = descriptor.describe_body(of_mesh(sphere))
    assert described.shape == (9,)
    assert described.dtype == np.float32
    assert_allclose(described, np.sqrt(np.abs(sphere_eigenvalues(9))), atol=0.02)


def test_eigenvalues_of_two_and_of_equidistant_points():
    # exp(−½) everywhere but on the diagonal: (1 + (n − 1) e^−½) / n once, (1 − e^−½) / n otherwise.
    distances = 3.0 * (1 - np.eye(5))
    expected = np.array([1 + 4 * np.exp(-0.5)] + [1 - np.exp(-0.5)] * 4) / 5
    assert_allclose(affinity_eigenvalues(distances, 5), expected)


def test_trace_is_one(blob):
    descriptor = changed(GeodesicSpectral(), n_eigenvalues=60, n_samples=60)
    described = descriptor.describe_body(of_mesh(blob)).astype(float)
    distances = geodesic_distances(blob, np.arange(60))[:, :60]
    assert affinity_eigenvalues(distances, 60).sum() == pytest.approx(1)
    # The description takes absolute values; those below zero are few and small.
    assert 1 < (described**2).sum() < 1.1
    assert (np.diff(described[:10]) <= 0).all()


def test_distances_are_chi_square():
    a = np.array([[0.9, 0.3]], dtype=np.float32)
    b = np.array([[0.5, 0.1]], dtype=np.float32)
    expected = (0.4**2 / 1.4 + 0.2**2 / 0.4) / 2
    descriptor = changed(GeodesicSpectral(), n_eigenvalues=2)
    found = descriptor.distances(torch.from_numpy(a), torch.from_numpy(b)).item()
    assert found == pytest.approx(expected, rel=1e-5)


def test_more_samples_than_vertices_are_refused(blob):
    with pytest.raises(ValueError, match="642"):
        changed(GeodesicSpectral(), n_samples=700).describe_body(of_mesh(blob))

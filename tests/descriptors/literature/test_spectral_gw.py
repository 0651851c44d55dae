import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from one_body import of_signature
from scipy.optimize import linprog
from scipy.special import eval_legendre
from scipy.stats import wasserstein_distance

from igps.descriptors.literature.spectral_gw import (
    SpectralGromovWasserstein,
    heat_kernels,
    quantiles,
    time_weight,
)
from igps.signature.signature import SignatureConfig, compute_signature
from own_descriptors import changed


@pytest.fixture(scope="module")
def round_signature(sphere):
    config = SignatureConfig(n_eigenpairs=120, n_surface_samples=400, resolution=12, min_samples=0)
    return compute_signature(sphere, config)


@pytest.fixture(scope="module")
def blob_signature(blob):
    return compute_signature(
        blob, SignatureConfig(n_eigenpairs=100, n_surface_samples=400, resolution=12, min_samples=0)
    )


def sphere_kernel(cosine, time):
    """4π k of the unit sphere: Σ (2l + 1) exp(−l (l + 1) t) Pₗ(cos θ), time in units of A/8π = ½."""
    total = np.zeros_like(cosine)
    for degree in range(30):
        decay = np.exp(-degree * (degree + 1) * time / 2)
        total += (2 * degree + 1) * decay * eval_legendre(degree, cosine)
    return total


def test_heat_kernel_of_the_sphere(round_signature):
    times = (0.25, 1.0, 4.0)
    kernels = heat_kernels(round_signature, times, n_samples=400)
    points = round_signature.surface.points
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = np.clip(points @ points.T, -1, 1)
    for time, kernel in zip(times, kernels, strict=True):
        assert kernel.shape == (400, 400)
        largest = sphere_kernel(np.ones(1), time)[0]
        assert_allclose(kernel, sphere_kernel(cosine, time), atol=0.02 * largest)


def test_quantile_means_by_hand():
    assert_allclose(quantiles([3.0, 1.0], 4), [1, 1, 3, 3])
    assert_allclose(
        quantiles([4.0, 1.0, 1.0], 2),
        [1, 3],
    )  # 1 on [½, ⅔], 4 on [⅔, 1]
    assert_allclose(quantiles([[5.0, 2.0]], 1), [3.5])


def test_quantiles_give_the_wasserstein_distance():
    generator = np.random.default_rng(0)
    first = generator.gamma(2.0, size=300)
    second = generator.normal(size=120)
    exact = wasserstein_distance(first, second)
    for n_quantiles in (10, 600):  # 600 is a multiple of both sizes
        estimate = np.abs(quantiles(first, n_quantiles) - quantiles(second, n_quantiles)).mean()
        assert estimate <= exact + 1e-12
        assert estimate == pytest.approx(exact, rel=0.05 if n_quantiles == 10 else 1e-9)


def test_distances_are_wasserstein_distances_of_exponent_two(round_signature, blob_signature):
    # The linear programme of optimal transport, over all couplings of the pairs of few points.
    times = (0.5, 2.0)
    descriptor = changed(SpectralGromovWasserstein(), times=times, n_samples=4, n_quantiles=16)
    signatures = (round_signature, blob_signature)
    described = [
        torch.from_numpy(descriptor.describe_body(of_signature(s)))[None] for s in signatures
    ]
    expected = []
    kernels = [heat_kernels(s, times, 4, 100) for s in signatures]
    for time, first, second in zip(times, *kernels, strict=True):
        cost = np.subtract.outer(first.ravel(), second.ravel()) ** 2
        rows = np.kron(np.eye(16), np.ones(16))
        columns = np.kron(np.ones(16), np.eye(16))
        marginals = np.concatenate([rows, columns])
        optimum = linprog(cost.ravel(), A_eq=marginals, b_eq=np.full(32, 1 / 16)).fun
        expected.append(time_weight(time) * np.sqrt(optimum))
    assert descriptor.distances(*described).item() == pytest.approx(max(expected), rel=1e-4)
    assert max(expected) > 1.5 * min(expected)


def test_time_weight_peaks_at_one():
    times = np.geomspace(0.1, 10, 101)
    weights = [time_weight(time) for time in times]
    assert times[int(np.argmax(weights))] == pytest.approx(1)
    assert time_weight(1.0) == pytest.approx(np.exp(-1) ** 4)
    assert time_weight(2.0) == pytest.approx(np.exp(-2.5) ** 2)


def test_few_samples_and_the_draw(blob_signature):
    few = changed(SpectralGromovWasserstein(), n_samples=3)
    assert few.describe_body(of_signature(blob_signature)).shape == (5, 200)
    a, b, c = (
        changed(SpectralGromovWasserstein(), n_samples=50, seed=seed).describe_body(
            of_signature(blob_signature)
        )
        for seed in (0, 0, 1)
    )
    assert_array_equal(a, b)
    assert (a != c).any()


def test_some_samples_stand_for_all(blob_signature):
    # Steps along the order of form: whatever the first one, no part of the body is left out or taken twice.
    few = [
        changed(SpectralGromovWasserstein(), n_samples=100, n_quantiles=20, seed=seed)
        for seed in range(4)
    ]
    whole = changed(SpectralGromovWasserstein(), n_samples=400, n_quantiles=20)
    of_all = whole.describe_body(of_signature(blob_signature))
    for descriptor in few:
        described = descriptor.describe_body(of_signature(blob_signature))
        assert np.abs(described - of_all).max() < 0.05 * np.abs(of_all).max()

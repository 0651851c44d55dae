from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from one_body import of_signature
from scipy.optimize import linprog
from scipy.special import eval_legendre
from scipy.stats import wasserstein_distance

from igps.descriptors.literature.spectral_gw import (
    SpectralGromovWasserstein,
    gromov_wasserstein,
    heat_kernels,
    quantiles,
    time_weight,
)
from igps.mesh.mesh import Mesh
from igps.signature.signature import Samples, Signature, SignatureConfig, compute_signature

BOUNDS = ("trace", "signature", "pairs")


def with_surface(signature: Signature, points: np.ndarray, eigenfunctions: np.ndarray) -> Signature:
    return Signature(
        signature.eigenvalues,
        signature.interior,
        Samples(points, eigenfunctions.astype(np.float32)),
        signature.area,
        signature.volume,
        signature.config,
    )


@pytest.fixture(scope="module")
def round_signature(sphere: Mesh) -> Signature:
    config = SignatureConfig(n_eigenpairs=120, n_surface_samples=400, resolution=12, min_samples=0)
    return compute_signature(sphere, config)


@pytest.fixture(scope="module")
def blob_signature(blob: Mesh) -> Signature:
    return compute_signature(
        blob, SignatureConfig(n_eigenpairs=100, n_surface_samples=400, resolution=12, min_samples=0)
    )


def sphere_kernel(cosine: np.ndarray, time: float) -> np.ndarray:
    """4π k of the unit sphere: Σ (2l + 1) exp(−l (l + 1) t) Pₗ(cos θ), time in units of A/8π = ½."""
    return sum(
        (2 * degree + 1) * np.exp(-degree * (degree + 1) * time / 2) * eval_legendre(degree, cosine)
        for degree in range(30)
    )


def test_heat_kernel_of_the_sphere(round_signature):
    times = (0.25, 1.0, 4.0)
    kernels = heat_kernels(round_signature, "surface", times, n_samples=400)
    points = round_signature.surface.points
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = np.clip(points @ points.T, -1, 1)
    for time, kernel in zip(times, kernels, strict=True):
        assert kernel.shape == (400, 400)
        np.testing.assert_allclose(
            kernel, sphere_kernel(cosine, time), atol=0.02 * sphere_kernel(np.ones(1), time)[0]
        )


def test_signature_bound_on_the_sphere_is_the_heat_kernel_signature(round_signature):
    # Every point of the sphere has the same signature √(4π k_2t(x, x)).
    for bound in ("trace", "signature"):
        described = SpectralGromovWasserstein(
            bound=bound, times=(1.0,), n_quantiles=20
        ).describe_body(of_signature(round_signature))
        expected = time_weight(1.0) * np.sqrt(sphere_kernel(np.ones(1), 2.0))
        assert described.shape == (1, 1 if bound == "trace" else 20)
        np.testing.assert_allclose(described, np.full(described.shape, expected), rtol=0.06)


def test_interior_kernel_of_the_ball(round_signature):
    # Mean value interpolation keeps constants, and at the centre of a ball all but these vanish.
    kernel = heat_kernels(round_signature, "interior", (1.0,), n_samples=10**6)[0]
    points = round_signature.interior.points
    assert len(kernel) == len(points)
    radius = np.linalg.norm(points, axis=1)
    centre = int(np.argmin(radius))
    outermost = int(np.argmax(radius))
    assert kernel[centre, centre] == pytest.approx(1, abs=0.05)
    assert 1.5 < kernel[outermost, outermost] < sphere_kernel(np.ones(1), 1.0)[0]


def test_quantile_means_by_hand():
    np.testing.assert_allclose(quantiles([3.0, 1.0], 4), [1, 1, 3, 3])
    np.testing.assert_allclose(quantiles([4.0, 1.0, 1.0], 2), [1, 3])  # 1 on [½, ⅔], 4 on [⅔, 1]
    np.testing.assert_allclose(quantiles([[5.0, 2.0]], 1), [3.5])


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
    # The linear programme of optimal transport, over all couplings of few points.
    times = (0.5, 2.0)
    descriptor = SpectralGromovWasserstein(
        bound="signature", times=times, n_samples=12, n_quantiles=12
    )
    signatures = (round_signature, blob_signature)
    described = [
        torch.from_numpy(descriptor.describe_body(of_signature(s)))[None] for s in signatures
    ]
    expected = []
    for time, first, second in zip(
        times, *(heat_kernels(s, "surface", times, 12) for s in signatures), strict=True
    ):
        norms = [np.sqrt(np.square(kernel).mean(axis=1)) for kernel in (first, second)]
        cost = np.subtract.outer(*norms) ** 2
        marginals = np.concatenate(
            [np.kron(np.eye(12), np.ones(12)), np.kron(np.ones(12), np.eye(12))]
        )
        optimum = linprog(cost.ravel(), A_eq=marginals, b_eq=np.full(24, 1 / 12)).fun
        expected.append(time_weight(time) * np.sqrt(optimum))
    assert descriptor.distances(*described).item() == pytest.approx(max(expected), rel=1e-4)
    assert max(expected) > 1.5 * min(expected)


def test_time_weight_peaks_at_one():
    times = np.geomspace(0.1, 10, 101)
    weights = [time_weight(time) for time in times]
    assert times[int(np.argmax(weights))] == pytest.approx(1)
    assert time_weight(1.0) == pytest.approx(np.exp(-1) ** 4)
    assert time_weight(2.0) == pytest.approx(np.exp(-2.5) ** 2)


@pytest.mark.parametrize("where", ["surface", "interior"])
def test_lower_bounds_and_their_order(where, round_signature, blob_signature):
    pytest.importorskip("ot", reason="Gromov-Wasserstein needs POT")
    above = gromov_wasserstein(round_signature, blob_signature, samples=where, n_samples=30)
    below = {}
    for bound in BOUNDS:
        descriptor = SpectralGromovWasserstein(samples=where, bound=bound, n_samples=30)
        described = [
            torch.from_numpy(descriptor.describe_body(of_signature(s)))[None]
            for s in (round_signature, blob_signature)
        ]
        below[bound] = descriptor.distances(*described).item()
    # The trace says less than the signature and than the pairs (Mémoli 2009, 2011).
    assert 0 < below["trace"] <= below["signature"] * (1 + 1e-6) <= above * (1 + 1e-5)
    assert below["trace"] <= below["pairs"] * (1 + 1e-6) <= above * (1 + 1e-5)
    assert above < 10 * max(below.values())


def test_gromov_wasserstein_by_brute_force():
    # Three points against three: the best of the six permutations bounds the best coupling from above.
    pytest.importorskip("ot", reason="Gromov-Wasserstein needs POT")
    generator = np.random.default_rng(3)
    empty = Samples(np.zeros((1, 3)), np.zeros((1, 4), dtype=np.float32))
    shapes = [
        Signature(
            np.array([1.0, 2.0, 3.0, 4.0]),
            empty,
            Samples(np.zeros((3, 3)), generator.normal(size=(3, 4)).astype(np.float32)),
            area=8 * np.pi,
            volume=1.0,
            config=SignatureConfig(),
        )
        for _ in range(2)
    ]
    first, second = (heat_kernels(s, "surface", (1.0,), 3)[0] for s in shapes)
    orders = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    best = min(np.sqrt(np.square(first - second[np.ix_(order, order)]).mean()) for order in orders)
    found = gromov_wasserstein(*shapes, times=(1.0,), n_samples=3)
    assert 0 < found <= time_weight(1.0) * best * (1 + 1e-6)
    # Between a shape and its relabelled self there is nothing.
    relabelled = with_surface(
        shapes[0], shapes[0].surface.points, -shapes[0].surface.eigenfunctions[[2, 0, 1]]
    )
    assert gromov_wasserstein(shapes[0], relabelled, n_samples=3) < 1e-6


def test_gromov_wasserstein_names_the_extra(blob_signature, monkeypatch):
    monkeypatch.setitem(sys.modules, "ot", None)
    with pytest.raises(ImportError, match=r"interior-gps\[transport\]"):
        gromov_wasserstein(blob_signature, blob_signature)


@pytest.mark.parametrize("bound", BOUNDS)
def test_signs_multiplets_and_scale(bound, blob_signature):
    descriptor = SpectralGromovWasserstein(bound=bound)
    described = descriptor.describe_body(of_signature(blob_signature))
    assert described.dtype == np.float32
    assert np.isfinite(described).all()
    signs = np.where(np.arange(100) % 3, 1, -1)
    surface = blob_signature.surface
    turned = with_surface(blob_signature, surface.points, surface.eigenfunctions * signs)
    np.testing.assert_array_equal(descriptor.describe_body(of_signature(turned)), described)
    scaled = Signature(
        blob_signature.eigenvalues / 9,
        blob_signature.interior,
        Samples(3 * surface.points, surface.eigenfunctions / 3),
        9 * blob_signature.area,
        27 * blob_signature.volume,
        blob_signature.config,
    )
    np.testing.assert_allclose(
        descriptor.describe_body(of_signature(scaled)),
        described,
        rtol=1e-5,
        atol=1e-6 * described.max(),
    )


def test_few_samples_and_the_draw(blob_signature):
    few = SpectralGromovWasserstein(samples="interior", n_samples=3)
    assert few.describe_body(of_signature(blob_signature)).shape == (5, 200)
    a, b, c = (
        SpectralGromovWasserstein(n_samples=50, seed=seed).describe_body(
            of_signature(blob_signature)
        )
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


def test_parameters_are_checked(blob_signature):
    wrong: list[dict] = [
        {"samples": "edges"},
        {"bound": "upper"},
        {"times": ()},
        {"times": (1.0, 0.0)},
        {"times": (np.nan,)},
        {"n_samples": 0},
        {"n_quantiles": 0},
    ]
    for parameters in wrong:
        with pytest.raises(ValueError, match=next(iter(parameters))):
            SpectralGromovWasserstein(**parameters)
    with pytest.raises(ValueError, match="times"):
        heat_kernels(blob_signature, "surface", (-1.0,), 10)


def test_some_samples_stand_for_all(blob_signature):
    # Steps along the order of form: whatever the first one, no part of the body is left out or taken twice.
    few = [SpectralGromovWasserstein(n_samples=100, n_quantiles=20, seed=seed) for seed in range(4)]
    of_all = SpectralGromovWasserstein(n_samples=400, n_quantiles=20).describe_body(
        of_signature(blob_signature)
    )
    for descriptor in few:
        described = descriptor.describe_body(of_signature(blob_signature))
        assert np.abs(described - of_all).max() < 0.05 * np.abs(of_all).max()
    kernels = [
        heat_kernels(blob_signature, "surface", (1.0,), n, seed=s)[0]
        for n, s in ((400, 0), (400, 1), (300, 1))
    ]
    np.testing.assert_array_equal(kernels[0], kernels[1])
    assert len(np.unique(np.diag(kernels[2]))) == 300

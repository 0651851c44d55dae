"""The systems of the comparison: what all promise, and oracles for interior, gps, d2 and shape_dna."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from igps.baselines import Body, System, systems
from igps.baselines.d2 import D2, _angles
from igps.baselines.gps import GPS
from igps.baselines.interior import Interior
from igps.baselines.shape_dna import ShapeDNA
from igps.geometry.mesh import Mesh
from igps.geometry.signature import Samples, Signature, SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=60, resolution=24, min_samples=400, n_surface_samples=600)
ROTATION = trimesh.transformations.euler_matrix(0.4, 1.1, -0.7)[:3, :3]


def rod() -> NDArray[np.float64]:
    """Vertices of a rod along x, thicker at one end: the faces are those of `sphere_faces`."""
    x, y, z = unit_sphere().vertices.T
    radius = 0.25 + 0.06 * x
    ring = np.maximum(np.hypot(y, z), 1e-12)
    # Caps as on a capsule, a tube between them.
    profile = np.sqrt(np.clip(1 - np.abs(x) ** 6, 0, 1))
    return np.stack([1.6 * np.sign(x) * np.abs(x) ** 1.2, radius * profile * y / ring, radius * profile * z / ring], 1)


@cache
def unit_sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4)


def bent(vertices: NDArray[np.float64], angle: float = 1.6) -> NDArray[np.float64]:
    """Bent around an arc that keeps the lengths along the axis."""
    x, y, z = vertices.T
    radius = 2 * 1.6 / angle
    return np.stack([(radius + y) * np.sin(x / radius), (radius + y) * np.cos(x / radius), z], 1)


def disc(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    return unit_sphere().vertices * [1.0, 0.8, 0.3]


@cache
def body(kind: str) -> Body:
    """A rod; the same moved, scaled and bent; and another body."""
    change: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
        "rod": lambda v: v,
        "motion": lambda v: (v * [1, 1, -1]) @ ROTATION.T + [3.0, -2.0, 5.0],
        "scale": lambda v: 7.3 * v,
        "pose": bent,
        "other": disc,
    }
    # Mesh turns what a reflection has turned inside out.
    mesh = Mesh(change[kind](rod()), np.asarray(unit_sphere().faces), name=kind)
    return Body(compute_signature(mesh, CONFIG), lambda: mesh)


@cache
def description(name: str, kind: str) -> torch.Tensor:
    return torch.from_numpy(systems()[name].describe(body(kind)))[None]


def test_systems_are_named_and_told_apart() -> None:
    everything = systems()
    assert list(everything)[:4] == ["interior", "gps", "d2", "shape_dna"]
    assert len({type(system) for system in everything.values()}) == len(everything)
    for name, system in everything.items():
        assert re.fullmatch("[a-z][a-z0-9_]*", name), "a name is typed in a shell, and names a file"
        assert re.search(r"(19|20)\d\d", system.source)
        assert set(system.invariant_to) <= {"motion", "scale", "pose"}


@pytest.mark.parametrize("name", systems())
def test_descriptions_are_finite_numbers_of_one_shape_and_repeat(name: str) -> None:
    system: System = systems()[name]
    first, other = system.describe(body("rod")), system.describe(body("other"))
    assert first.dtype == other.dtype == np.float32
    assert first.shape == other.shape
    assert first.ndim >= 1
    assert np.isfinite(first).all()
    assert np.isfinite(other).all()
    again = pickle.loads(pickle.dumps(system)).describe(body("rod"))
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("name", systems())
def test_distances_are_a_matrix_of_what_pairs_give(name: str) -> None:
    distance = systems()[name].distances
    queries = torch.cat([description(name, kind) for kind in ("rod", "other")])
    gallery = torch.cat([description(name, kind) for kind in ("other", "pose", "rod")])
    matrix = distance(queries, gallery)
    assert matrix.shape == (2, 3)
    assert (matrix >= 0).all()
    scale = float(matrix.max())
    assert scale > 0
    assert abs(float(matrix[0, 2])) < 1e-3 * scale
    assert abs(float(matrix[1, 0])) < 1e-3 * scale
    for i in range(2):
        for j in range(3):
            pair = distance(queries[i : i + 1], gallery[j : j + 1])
            torch.testing.assert_close(pair, matrix[i : i + 1, j : j + 1], rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize(
    ("name", "change"), [(name, change) for name, system in systems().items() for change in system.invariant_to]
)
def test_descriptions_stay_under_what_the_system_claims(name: str, change: str) -> None:
    system = systems()[name]
    changed = float(system.distances(description(name, "rod"), description(name, change)))
    other = float(system.distances(description(name, "rod"), description(name, "other")))
    # Rounding alone may let a system simplify a mesh or choose its samples otherwise.
    assert changed < {"scale": 0.05, "motion": 0.2, "pose": 0.35}[change] * other


def test_d2_sees_the_pose() -> None:
    d2 = D2()
    assert "pose" not in d2.invariant_to
    changed = float(d2.distances(description("d2", "rod"), description("d2", "pose")))
    assert changed > 0.05 * float(d2.distances(description("d2", "rod"), description("d2", "other")))


@pytest.mark.parametrize(("system", "samples"), [(Interior(), "interior"), (GPS(), "surface")])
def test_paper_histograms_are_those_of_the_layout(system: System, samples: str) -> None:
    """4 classes of [0, 1.5], and 64 bins of [0, 4] with a linear kernel, of φ/√λ at the samples of that name."""
    signature = body("rod").signature
    embedding = getattr(signature, samples).eigenfunctions / np.sqrt(signature.eigenvalues)
    level = np.minimum((np.linalg.norm(embedding, axis=1) / 1.5 * 4).astype(int), 3)
    i, j = np.triu_indices(len(embedding), 1)
    position = np.clip(pdist(embedding) / 4.0 * 64 - 0.5, 0, 63)
    below = np.minimum(position.astype(int), 62)
    expected = np.zeros((4, 4, 64))
    classes = np.minimum(level[i], level[j]), np.maximum(level[i], level[j])
    np.add.at(expected, (*classes, below), below + 1 - position)
    np.add.at(expected, (*classes, below + 1), position - below)
    expected = expected[np.triu_indices(4)] / len(i)
    np.testing.assert_allclose(system.describe(body("rod")), expected, atol=2e-6)


def of_points(points: NDArray[np.float64], area: float = 1.0, eigenvalues: NDArray[np.float64] | None = None) -> Body:
    """A body of which the samples of the surface, the area and the eigenvalues are known, and nothing else."""
    samples = Samples(points, np.zeros((len(points), 1), dtype=np.float32))
    values = np.ones(1) if eigenvalues is None else eigenvalues
    signature = Signature(values, samples, samples, area, 1.0, CONFIG)

    def unread() -> Mesh:
        raise AssertionError("the signature must do")

    return Body(signature, unread)


@pytest.fixture(scope="module")
def round_body(sphere: Mesh) -> Body:
    config = SignatureConfig(n_eigenpairs=30, resolution=8, min_samples=0, n_surface_samples=4000)
    return Body(compute_signature(sphere, config), lambda: sphere)


def test_d2_of_a_sphere_has_the_density_of_its_chords(round_body: Body) -> None:
    """On the unit sphere the length of a random chord has the density l/2 on [0, 2]: l²/4 is its distribution."""
    n_bins, reach = 40, 2 / np.sqrt(4 * np.pi)
    histogram = D2(n_bins=n_bins, reach=reach).describe(round_body)
    edges = np.linspace(0, 1, n_bins + 1)
    np.testing.assert_allclose(np.cumsum(histogram), edges[1:] ** 2, atol=0.01)
    # In the range that all shapes share, the sphere ends where its diameter does.
    wide = D2().describe(round_body)
    assert wide[int(64 * reach / 2.0) + 1 :].sum() == 0
    assert wide.sum() == pytest.approx(1, abs=1e-6)


def test_d1_of_a_sphere_is_its_radius(round_body: Body) -> None:
    histogram = D2(function="d1", n_bins=10, reach=1.0).describe(round_body)
    assert histogram[2] == pytest.approx(1)  # 1 / √(4π) = 0.282


def test_a3_of_a_sphere_has_the_moments_of_its_angles() -> None:
    """Chords from a point of a sphere have cosine-weighted directions u, so that E[u·v] = E[u]² = (2/3)² and
    E[(u·v)²] = Σ E[uᵢ²]² = 1/4 + 1/16 + 1/16."""
    points = np.random.default_rng(3).standard_normal((4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cosine = np.cos(_angles(points, 200_000, np.random.default_rng(0)))
    assert cosine.mean() == pytest.approx(4 / 9, abs=0.01)
    assert np.square(cosine).mean() == pytest.approx(3 / 8, abs=0.01)


def test_a3_takes_distinct_samples_and_its_range_is_half_a_turn() -> None:
    """Of three points in a line the angle is 0 at either end and π in the middle."""
    points = np.array([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]])
    histogram = D2(function="a3", n_bins=5, n_triples=30_000).describe(of_points(points))
    np.testing.assert_allclose(histogram, [2 / 3, 0, 0, 0, 1 / 3], atol=0.02)


def test_d2_counts_each_pair_once_and_what_lies_beyond_in_the_last_bin() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [50, 0, 0]])
    histogram = D2(n_bins=4, reach=2.0).describe(of_points(points, area=4.0))
    # Lengths over √4: 0.5, 2.5, 25, 2, 24.5, 22.5.
    np.testing.assert_allclose(histogram, [0, 1 / 6, 0, 5 / 6], atol=1e-6)


def test_d2_distance_is_half_the_l1_norm() -> None:
    one, two = torch.tensor([[0.5, 0.5, 0.0]]), torch.tensor([[0.0, 0.25, 0.75], [0.5, 0.5, 0.0]])
    torch.testing.assert_close(D2().distances(one, two), torch.tensor([[0.75, 0.0]]))


def test_shape_dna_of_a_sphere_is_known(round_body: Body) -> None:
    """l(l+1) with multiplicity 2l+1, and the area 4π."""
    expected = 4 * np.pi * np.repeat([2, 6, 12], [3, 5, 7])
    np.testing.assert_allclose(ShapeDNA(n_eigenvalues=15).describe(round_body), expected, rtol=0.01)


@pytest.mark.parametrize("area", [0.3, 12.0])
def test_slope_makes_weyl_spectra_alike(area: float) -> None:
    """λₖ = 4πk / area: divided by the slope, the number k remains, whatever the area says."""
    k = np.arange(1, 41)
    spectrum = of_points(np.zeros((1, 3)), area=1.0, eigenvalues=4 * np.pi * k / area)
    np.testing.assert_allclose(ShapeDNA(30, "slope").describe(spectrum), k[:30], rtol=1e-6)


def test_slope_is_that_of_least_squares() -> None:
    k = np.arange(1, 21)
    values = np.sort(3 * k + np.random.default_rng(0).random(20))
    slope = np.linalg.lstsq(k[:, None], values, rcond=None)[0][0]
    result = ShapeDNA(20, "slope").describe(of_points(np.zeros((1, 3)), eigenvalues=values))
    np.testing.assert_allclose(result, values / slope, rtol=1e-6)


def test_shape_dna_distance_is_euclidean() -> None:
    one, two = torch.tensor([[1.0, 2.0]]), torch.tensor([[4.0, 6.0], [1.0, 2.0]])
    torch.testing.assert_close(ShapeDNA(2).distances(one, two), torch.tensor([[5.0, 0.0]]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: D2(function="d3"), "function.*'d3'"),  # type: ignore[arg-type]
        (lambda: D2(n_bins=0), "n_bins"),
        (lambda: D2(n_triples=0), "n_triples"),
        (lambda: D2(reach=0.0), "reach"),
        (lambda: D2(reach=float("inf")), "reach"),
        (lambda: D2().describe(of_points(np.zeros((1, 3)))), "surface samples.*at least 2"),
        (lambda: D2(function="a3").describe(of_points(np.zeros((2, 3)))), "surface samples.*at least 3"),
        (lambda: ShapeDNA(0), "n_eigenvalues"),
        (lambda: ShapeDNA(normalisation="volume"), "normalisation"),  # type: ignore[arg-type]
        (lambda: ShapeDNA(13).describe(of_points(np.zeros((1, 3)), eigenvalues=np.ones(12))), "n_eigenvalues.*12.*13"),
    ],
)
def test_parameters_and_signatures_out_of_range_are_named(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()

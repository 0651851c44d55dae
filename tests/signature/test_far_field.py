"""The far field: approximate coordinates keep their accuracy, clusters and moments the order of their error."""

from __future__ import annotations

import functools
import itertools
import logging

import numpy as np
import pytest
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from bodies import Mesh, bumpy_sphere, interior_points, smooth_functions, torus
from conftest import with_slivers
from igps.mesh import mesh as geometry
from igps.signature import _far_field as far_field
from igps.signature import mean_value as coordinates
from igps.signature._far_field import HatClusters, HatSurface
from igps.signature._weight_loops import fill_clusters, fill_hats
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import Extension, extend
from igps.signature.ordering import spatial_order
from igps.spectra import eigenpairs

pytestmark = pytest.mark.usefixtures("approximate_small_meshes")


@functools.cache
def commute_time_embedding(name: str) -> tuple[Mesh, np.ndarray]:
    """A mesh, and its first 100 eigenfunctions over √λ (V, 100): their distances are those of the descriptor."""
    mesh = {"bumpy": lambda: bumpy_sphere(4), "torus": lambda: torus(160, 60)}.get(
        name, lambda: with_slivers(*bumpy_sphere(4), 300)
    )()
    spectrum = eigenpairs(*laplacian(geometry.Mesh(*mesh)), 100, positions=mesh[0])
    return mesh, spectrum.eigenfunctions / np.sqrt(spectrum.eigenvalues)


@pytest.mark.parametrize("accuracy", [7e-3, 1e-3, 1e-4])
@pytest.mark.parametrize("name", ["bumpy", "torus", "slivers"])
def test_approximation_keeps_its_accuracy_and_spends_it(name, accuracy):
    mesh, embedding = commute_time_embedding(name)
    points = interior_points(mesh, 250)
    for functions in (embedding, smooth_functions(mesh[0])):
        exact = extend(*mesh, functions, points)
        near = extend(*mesh, functions, points, accuracy=accuracy)
        error = np.abs(pdist(near) - pdist(exact)) / pdist(exact)
        # far below, the approximation would be slower than it need be, or not take place
        assert accuracy / 20 < np.quantile(error, 0.99) < accuracy


def test_approximation_tends_to_the_exact_result():
    mesh = bumpy_sphere(4)
    points = interior_points(mesh, 60)
    functions = smooth_functions(mesh[0])
    exact = extend(*mesh, functions, points)
    assert np.array_equal(extend(*mesh, functions, points, accuracy=1e-9), exact)  # nothing is far
    errors = [
        np.abs(extend(*mesh, functions, points, accuracy=10.0**-k) - exact).max()
        for k in (3, 4, 5, 9)
    ]
    assert errors[-1] < 1e-10  # all near
    assert all(after < before / 4 for before, after in itertools.pairwise(errors))


def all_weights(surface: HatSurface, x: np.ndarray, ratio: float) -> np.ndarray:
    """(V, n) at points (3, n): series with a ratio of 0, the closed form with an infinite one."""
    weights = np.empty((len(surface.hats), x.shape[1]))
    surface.fill_weights(x, np.arange(len(weights)), ratio, weights)
    return weights


@pytest.mark.parametrize(("bend", "factor"), [(0.0, 1 / 8), (1.0, 1 / 4)])
def test_far_rule_error_falls_with_the_third_power_in_a_flat_hat_and_the_second_in_a_bent_one(
    bend, factor
):
    """One hat, seen from ever farther away."""
    ring = np.array(
        [[1.0, 0, 0.2], [0.2, 1.1, 0], [-0.9, 0.4, 0.3], [-0.5, -0.8, -0.1], [0.6, -0.9, 0.1]]
    )
    vertices = np.concatenate([[[0.1, 0, 0.4]], ring]) * [1, 1, bend]
    faces = np.array([[0, i + 1, (i + 1) % 5 + 1] for i in range(5)])
    surface = HatSurface(vertices, faces)
    assert sorted(surface.order) == [0, 1, 2, 3, 4, 5]
    errors = []
    for distance in (10.0, 20.0, 40.0):
        x = distance * surface.axes.T @ [[0.3], [-0.5], [-0.8]] / np.sqrt(0.98)
        far, exact = (all_weights(surface, x, ratio)[:, 0] for ratio in (0.0, np.inf))
        errors.append(np.abs(far - exact).sum() / np.abs(exact).sum())
    assert errors[0] < 5e-3
    assert errors[1] / errors[0] == pytest.approx(factor, rel=0.25)
    assert errors[2] / errors[1] == pytest.approx(factor, rel=0.2)


@pytest.fixture
def small_clusters(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that neighbours of a hat near a point are often in a cluster."""
    monkeypatch.setattr(coordinates, "_GROUP_SIZE", 4)
    monkeypatch.setattr(far_field, "_LEAF_SIZE", 2)


@pytest.mark.usefixtures("small_clusters")
def test_surface_points_are_interpolated_also_where_most_of_the_surface_is_far():
    vertices, faces = bumpy_sphere(4)
    functions = smooth_functions(vertices)
    rng = np.random.default_rng(5)
    chosen = rng.integers(len(faces), size=60)
    barycentric = rng.dirichlet(np.ones(3), size=60)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]])
    expected = np.einsum("pi,pik->pk", barycentric, functions[faces[chosen]])
    result = extend(vertices, faces, functions, points, accuracy=1e-2, dtype=np.float64)
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.usefixtures("small_clusters")
@pytest.mark.parametrize("accuracy", [7e-3, 1e-3])
def test_small_clusters_keep_the_accuracy(accuracy):
    mesh = torus(80, 30)
    points = interior_points(mesh, 250)
    functions = smooth_functions(mesh[0])
    exact, near = (
        pdist(extend(*mesh, functions, points, accuracy=each)) for each in (None, accuracy)
    )
    assert np.quantile(np.abs(near - exact) / exact, 0.99) < accuracy


def test_clusters_turn_with_the_mesh():
    vertices, faces = bumpy_sphere(4)
    # No mirror symmetry, no ties
    vertices = vertices + 1e-3 * np.random.default_rng(0).normal(size=vertices.shape)
    points = interior_points((vertices, faces), 400)
    functions = smooth_functions(vertices)
    rotation = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix().T
    exact, still, turned = (
        extend(
            vertices @ turn, faces, functions, points @ turn, accuracy=accuracy, dtype=np.float64
        )
        for accuracy, turn in ((None, np.eye(3)), (1e-3, np.eye(3)), (1e-3, rotation))
    )
    np.testing.assert_allclose(turned, still, atol=1e-9)
    assert np.abs(still - exact).max() > 1e-5


def test_approximation_reproduces_positions():
    mesh = torus(240, 80)
    points = interior_points(mesh, 300)
    for accuracy in (1e-2, 1e-3, 1e-4):
        error = np.linalg.norm(extend(*mesh, mesh[0], points, accuracy=accuracy) - points, axis=1)
        assert 1e-9 < np.quantile(error, 0.99) < accuracy


@pytest.mark.parametrize("size", [1, 8])
def test_spatial_order_cuts_a_grid_into_cubes(size):
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    points = np.random.default_rng(0).permutation(grid)
    order = spatial_order(points, size)
    np.testing.assert_array_equal(np.sort(order), np.arange(512))
    for run, side in ((8, 1), (64, 3)):
        assert (np.ptp(points[order].reshape(-1, run, 3), axis=1) == side).all()


@pytest.mark.parametrize("n", [0, 1, 7, 8, 9, 83, 512])
def test_spatial_order_is_one_for_any_number(n):
    points = np.random.default_rng(n).normal(size=(n, 3))
    order = spatial_order(points, 8)
    np.testing.assert_array_equal(np.sort(order), np.arange(n))


def scaled_surface(mesh: Mesh) -> tuple[HatSurface, np.ndarray]:
    """The surface, and its vertices (V, 3) in its own axes and order."""
    vertices, faces, _ = coordinates._scaled(*mesh, np.zeros((0, 3)))
    surface = HatSurface(vertices, faces)
    return surface, (vertices @ surface.axes)[surface.order]


@pytest.mark.parametrize("ratio", [1.1, 2.0, 1e9])
def test_a_box_sees_each_hat_once_and_none_that_is_near_in_a_cluster(ratio):
    surface, vertices = scaled_surface(torus(160, 60))
    n_hats = len(vertices)
    tree = HatClusters.from_hats(surface.hats, vertices)
    sizes = [32 * 4**level for level in range(len(tree.level_starts) - 1)]
    members = [np.arange(n_hats)[i : i + size] for size in sizes for i in range(0, n_hats, size)]
    assert len(sizes) > 2
    assert len(members) == len(tree.centres) == len(tree.radii) == len(tree.sums)
    for member, centre, radius in zip(members, tree.centres, tree.radii, strict=True):
        around = np.isin(surface.faces, member).any(axis=1)
        corners = vertices[surface.faces][around].reshape(-1, 3)
        assert np.linalg.norm(corners - centre, axis=1).max() <= radius
    n_clusters = 0
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (12, 1, 3))
    for x in points + np.random.default_rng(1).uniform(-0.1, 0.1, (12, 32, 3)):
        clusters, hats = tree.far_clusters(x.T, ratio)
        np.testing.assert_array_equal(hats, np.sort(hats))
        seen = np.concatenate([hats, *(members[cluster] for cluster in clusters)])
        np.testing.assert_array_equal(np.sort(seen), np.arange(n_hats))
        assert (cdist(x, tree.centres[clusters]) >= ratio * tree.radii[clusters]).all()
        is_near = (cdist(x, surface.hats[:, :3]) < ratio * surface.hats[:, 3]).any(axis=0)
        assert np.isin(np.nonzero(is_near)[0], hats).all()
        n_clusters += len(clusters)
    assert (n_clusters > 0) == (ratio < 1e9)


def test_near_pairs_equal_all_distances_and_have_no_series():
    surface, vertices = scaled_surface(bumpy_sphere(3))
    x = np.ascontiguousarray(interior_points(bumpy_sphere(3), 50).T) / 2
    for chosen in (np.arange(642), np.arange(17, 600, 3)):
        weights = np.empty((len(chosen), 50))
        near = np.empty((len(chosen) + 1, 50), bool)
        fill_hats(x, chosen, surface.hats, 1.5, weights, near)
        ratios = cdist(surface.hats[chosen, :3], x.T) / surface.hats[chosen, 3:4]
        np.testing.assert_array_equal(near[:-1], ratios < 1.5)
        np.testing.assert_array_equal(weights == 0, near[:-1])
        assert near[:-1].any()
    # The ball about a hat's centroid holds the faces around its vertex.
    for corner in range(3):
        of_hat = surface.hats[surface.faces[:, corner]]
        apart = np.linalg.norm(vertices[surface.faces] - of_hat[:, None, :3], axis=2)
        assert (apart <= of_hat[:, 3:4]).all()


def test_clusters_of_point_elements_leave_an_error_of_third_order():
    """Hats that are two surface elements n dS each, the kernel of which is n·r/|r|⁴."""
    rng = np.random.default_rng(0)
    centres, offsets, one, two = rng.normal(size=(4, 50, 3))
    offsets *= 0.3
    tilts = (one - two)[:, :, None] * offsets[:, None]
    covariances = offsets[:, :, None] * offsets[:, None]
    unused = np.full((50, 1), np.nan)
    radii = np.linalg.norm(offsets, axis=1, keepdims=True)
    hats = np.concatenate(
        [centres, radii, unused, one + two, unused, np.full((50, 3), np.nan)]
        + [
            (form + form.transpose(0, 2, 1))[:, i, [j]] / (2 if i == j else 1)
            for form in (-4 * tilts, 12 * covariances)
            for i in range(3)
            for j in range(i, 3)
        ],
        axis=1,
    )
    functions = rng.normal(size=(50, 3))
    tree = HatClusters.from_hats(hats, functions)
    clusters = np.arange(2)
    errors = []
    for distance in (200.0, 400.0, 800.0):
        x = distance * np.array([0.3, -0.5, -0.8]) / np.sqrt(0.98)
        terms = np.empty((19 * 2, 1))
        fill_clusters(x[:, None], clusters, tree.centres, tree.radii, terms)
        r = np.stack([centres + offsets, centres - offsets]) - x
        kernel = (np.stack([one, two]) * r).sum(axis=-1) / np.square(r).sum(axis=-1) ** 2
        exact = kernel.sum(axis=0) @ functions
        far = terms[:, 0] @ tree.sums[clusters].reshape(-1, 3)
        errors.append(
            np.abs((far - exact) / (np.abs(kernel).sum(axis=0) @ np.abs(functions))).max()
        )
    assert errors[0] < 1e-5
    assert errors[1] / errors[0] == pytest.approx(1 / 8, rel=0.1)
    assert errors[2] / errors[1] == pytest.approx(1 / 8, rel=0.1)


def test_cluster_error_falls_with_the_third_power():
    """All clusters of one level together, seen from ever farther away, against the closed form of all faces."""
    surface, vertices = scaled_surface(bumpy_sphere(3))
    functions = smooth_functions(vertices)
    tree = HatClusters.from_hats(surface.hats, functions)
    clusters = np.arange(tree.level_starts[1])
    errors = []
    for distance in (2.0, 4.0, 8.0, 16.0):
        x = distance * surface.axes.T @ [[0.3], [-0.5], [-0.8]] / np.sqrt(0.98)
        terms = np.empty((19 * len(clusters), 1))
        fill_clusters(x, clusters, tree.centres, tree.radii, terms)
        far = terms[:, 0] @ tree.sums[clusters].reshape(-1, functions.shape[1])
        weights = all_weights(surface, x, np.inf)[:, 0]
        scale = np.abs(weights) @ np.abs(functions)
        errors.append((np.abs(far - weights @ functions) / scale).max())
    assert errors[0] < 1e-2
    for before, after in itertools.pairwise(errors):
        assert after < before / 6.5


def test_a_mesh_on_which_the_approximation_is_worse_gets_a_finer_one(monkeypatch, caplog):
    """Error constants that are too small stand for such a mesh; the sampled error must trigger a second evaluation."""
    mesh = bumpy_sphere(5)
    points = interior_points(mesh, 250)
    functions = smooth_functions(mesh[0])
    exact = extend(*mesh, functions, points)
    caplog.set_level(logging.INFO, logger=coordinates.logger.name)

    def error(accuracy: float) -> float:
        found = extend(*mesh, functions, points, accuracy=accuracy)
        return float(np.quantile(np.abs(pdist(found) / pdist(exact) - 1), 0.99))

    accuracy = 1e-4
    assert error(accuracy) < accuracy
    assert not caplog.records
    monkeypatch.setattr(coordinates, "_CLUSTER_ERROR", 1e-7)
    monkeypatch.setattr(coordinates, "_HAT_ERROR", 1e-4)
    with monkeypatch.context() as unchecked:
        unchecked.setattr(Extension, "_sampled_error", lambda *_: 0.0)
        assert error(accuracy) > 2 * accuracy
    assert error(accuracy) < accuracy
    assert "evaluated again" in caplog.text


def test_where_no_approximation_serves_the_closed_form_does(monkeypatch):
    mesh = bumpy_sphere(5)
    points = interior_points(mesh, 60)
    functions = smooth_functions(mesh[0])
    settings = []

    def never(*_: object) -> float:
        settings.append(1)
        return 1.0

    monkeypatch.setattr(Extension, "_sampled_error", never)
    found = extend(*mesh, functions, points, accuracy=1e-3, dtype=np.float64)
    np.testing.assert_allclose(found, extend(*mesh, functions, points), atol=1e-12)
    assert settings


def test_the_sampled_error_is_that_of_the_distances():
    mesh = bumpy_sphere(4)
    points = interior_points(mesh, 100)
    functions = smooth_functions(mesh[0])
    extension = Extension(*mesh, functions, dtype=np.float64)
    x = coordinates._scaled(*mesh, points)[2] @ extension._surface.axes
    exact = extend(*mesh, functions, points)
    assert extension._sampled_error(x, exact) < 1e-12
    generator = np.random.default_rng(1)
    for size in (1e-3, 1e-2):
        wrong = exact + size * generator.normal(size=exact.shape)
        expected = np.quantile(np.abs(pdist(wrong) / pdist(exact) - 1), 0.99)
        found = extension._sampled_error(x, wrong)
        assert 0.6 * expected < found < 1.7 * expected
    # Errors that go together, here by the same share of every distance, are never taken for less than they are.
    larger = exact.mean(axis=0) + 1.01 * (exact - exact.mean(axis=0))
    assert extension._sampled_error(x, larger) > 0.01
    order = np.random.default_rng(0).permutation(len(points))
    half = exact.copy()
    half[:50] *= 1.003
    expected = extension._sampled_error(x, half)
    shuffled = extension._sampled_error(x[order], half[order])
    assert shuffled == pytest.approx(expected, rel=1e-6)  # the same points, whatever the order

"""The far field: approximate coordinates keep their accuracy, clusters and moments the order of their error."""

from __future__ import annotations

import functools
import itertools
import logging

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from bodies import Mesh, bumpy_sphere, interior_points, smooth_functions, torus
from conftest import with_slivers
from igps.mesh import mesh as geometry
from igps.signature import _closed_forms as closed_forms
from igps.signature import _far_field as far_field
from igps.signature import mean_value as coordinates
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import extend
from igps.spectra import eigenpairs

pytestmark = pytest.mark.usefixtures("approximate_small_meshes", "both_ways")


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
def test_approximation_keeps_its_accuracy_and_spends_it(name: str, accuracy: float) -> None:
    mesh, embedding = commute_time_embedding(name)
    points = interior_points(mesh, 250)
    for functions in (embedding, smooth_functions(mesh[0])):
        exact = extend(*mesh, functions, points)
        near = extend(*mesh, functions, points, accuracy=accuracy)
        error = np.abs(pdist(near) - pdist(exact)) / pdist(exact)
        # far below, the approximation would be slower than it need be, or not take place
        assert accuracy / 20 < np.quantile(error, 0.99) < accuracy


def test_approximation_tends_to_the_exact_result(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bumpy_sphere(4)
    points = interior_points(mesh, 60)
    functions = smooth_functions(mesh[0])
    exact = extend(*mesh, functions, points)
    assert np.array_equal(extend(*mesh, functions, points, accuracy=1e-9), exact)  # nothing is far
    monkeypatch.setattr(coordinates, "_NEAR_SHARE", 1.0)
    errors = [np.abs(extend(*mesh, functions, points, accuracy=10.0**-k) - exact).max() for k in (3, 4, 5, 9)]
    assert errors[-1] < 1e-10  # all listed
    assert all(after < before / 4 for before, after in itertools.pairwise(errors))


@pytest.mark.parametrize(("bend", "factor"), [(0.0, 1 / 8), (1.0, 1 / 4)])
def test_far_rule_error_falls_with_the_third_power_in_a_flat_hat_and_the_second_in_a_bent_one(
    bend: float, factor: float
) -> None:
    """One hat, seen from ever farther away."""
    ring = np.array([[1.0, 0, 0.2], [0.2, 1.1, 0], [-0.9, 0.4, 0.3], [-0.5, -0.8, -0.1], [0.6, -0.9, 0.1]])
    vertices = np.concatenate([[[0.1, 0, 0.4]], ring]) * [1, 1, bend]
    faces = np.array([[0, i + 1, (i + 1) % 5 + 1] for i in range(5)])
    tensors = torch.as_tensor(vertices), torch.as_tensor(faces)
    surface = closed_forms.Surface.of(*tensors)
    hats, listed = far_field.HatMoments.of(surface), closed_forms.ListedRule.of(surface)
    errors = []
    for distance in (10.0, 20.0, 40.0):
        x = distance * torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, -0.8]], dtype=torch.float64))
        far = torch.empty(6, 1, dtype=torch.float64)
        hats.fill_weights(x, torch.arange(6), far)
        exact = listed.weights(torch.arange(5), x.T.expand(3, 5))[0]
        total = torch.zeros(6, dtype=torch.float64).index_add_(0, tensors[1].T.flatten(), exact.flatten())
        errors.append(((far[:, 0] - total).abs().sum() / total.abs().sum()).item())
    assert errors[0] < 5e-3
    assert errors[1] / errors[0] == pytest.approx(factor, rel=0.25)
    assert errors[2] / errors[1] == pytest.approx(factor, rel=0.2)


@pytest.fixture
def small_clusters(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that neighbours of a hat near a point are often in a cluster."""
    monkeypatch.setattr(coordinates, "_GROUP", 4)
    monkeypatch.setattr(far_field, "_LEAF", 2)


@pytest.mark.usefixtures("small_clusters")
def test_surface_points_are_interpolated_also_where_most_of_the_surface_is_far() -> None:
    vertices, faces = bumpy_sphere(4)
    functions = smooth_functions(vertices)
    rng = np.random.default_rng(5)
    chosen, barycentric = rng.integers(len(faces), size=60), rng.dirichlet(np.ones(3), size=60)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]])
    expected = np.einsum("pi,pik->pk", barycentric, functions[faces[chosen]])
    result = extend(vertices, faces, functions, points, accuracy=1e-2, dtype=torch.float64)
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.usefixtures("small_clusters")
@pytest.mark.parametrize("accuracy", [7e-3, 1e-3])
def test_small_clusters_keep_the_accuracy(accuracy: float) -> None:
    mesh = torus(80, 30)
    points, functions = interior_points(mesh, 250), smooth_functions(mesh[0])
    exact, near = (pdist(extend(*mesh, functions, points, accuracy=each)) for each in (None, accuracy))
    assert np.quantile(np.abs(near - exact) / exact, 0.99) < accuracy


def test_clusters_turn_with_the_mesh() -> None:
    vertices, faces = bumpy_sphere(4)
    vertices = vertices + 1e-3 * np.random.default_rng(0).normal(size=vertices.shape)  # no mirror symmetry, no ties
    points, functions = interior_points((vertices, faces), 400), smooth_functions(vertices)
    rotation = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix().T
    exact, still, turned = (
        extend(vertices @ turn, faces, functions, points @ turn, accuracy=accuracy, dtype=torch.float64)
        for accuracy, turn in ((None, np.eye(3)), (1e-3, np.eye(3)), (1e-3, rotation))
    )
    np.testing.assert_allclose(turned, still, atol=1e-9)
    assert np.abs(still - exact).max() > 1e-5


def test_approximation_reproduces_positions() -> None:
    mesh = torus(240, 80)
    points = interior_points(mesh, 300)
    for accuracy in (1e-2, 1e-3, 1e-4):
        error = np.linalg.norm(extend(*mesh, mesh[0], points, accuracy=accuracy) - points, axis=1)
        assert 1e-9 < np.quantile(error, 0.99) < accuracy


@pytest.mark.parametrize("size", [1, 8])
def test_spatial_order_cuts_a_grid_into_cubes(size: int) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    points = np.random.default_rng(0).permutation(grid)
    order = closed_forms.spatial_order(torch.as_tensor(points), size).numpy()
    np.testing.assert_array_equal(np.sort(order), np.arange(512))
    for run, side in ((8, 1), (64, 3)):
        assert (np.ptp(points[order].reshape(-1, run, 3), axis=1) == side).all()


@pytest.mark.parametrize("n", [0, 1, 7, 8, 9, 83, 512])
def test_spatial_order_is_one_for_any_number(n: int) -> None:
    points = np.random.default_rng(n).normal(size=(n, 3))
    order = closed_forms.spatial_order(torch.as_tensor(points), 8).numpy()
    np.testing.assert_array_equal(np.sort(order), np.arange(n))


def hats_and_tree(mesh: Mesh) -> tuple[closed_forms.Surface, far_field.HatMoments, far_field.HatTree]:
    surface, _ = coordinates._renumbered(coordinates._prepare(*mesh, np.zeros((0, 3)), "cpu")[0])
    hats = far_field.HatMoments.of(surface)
    return surface, hats, far_field.HatTree.of(hats)


@pytest.mark.parametrize("ratio", [1.1, 2.0, 1e9])
def test_blocks_see_each_hat_once_and_none_that_is_near_in_a_cluster(ratio: float) -> None:
    surface, hats, tree = hats_and_tree(torus(160, 60))
    members = [np.arange(tree.n_hats)[i : i + size] for size in tree.sizes for i in range(0, tree.n_hats, size)]
    centres, radii = torch.cat(tree.centres).numpy(), torch.cat(tree.radii).numpy()
    assert len(members) == len(centres)
    for member, centre, radius in zip(members, centres, radii, strict=True):
        around = np.isin(surface.faces.numpy(), member).any(1)
        corners = surface.vertices[surface.faces].numpy()[around].reshape(-1, 3)
        assert np.linalg.norm(corners - centre, axis=1).max() <= radius
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (400, 3))
    blocks = list(tree.blocks(torch.as_tensor(points), 32, ratio))
    np.testing.assert_array_equal(np.sort(np.concatenate([block.points.numpy() for block in blocks])), np.arange(400))
    n_clusters = 0
    for block in blocks:
        x, clusters = points[block.points.numpy()], block.clusters.numpy()
        seen = np.concatenate([block.hats.numpy(), *(members[cluster] for cluster in clusters)])
        np.testing.assert_array_equal(np.sort(seen), np.arange(tree.n_hats))
        assert (cdist(x, centres[clusters]) >= ratio * radii[clusters]).all()
        is_near = (cdist(x, hats.centres.numpy()) < ratio * hats.radii.numpy()).any(0)
        assert np.isin(np.nonzero(is_near)[0], block.hats.numpy()).all()
        n_clusters += len(clusters)
    assert (n_clusters > 0) == (ratio < 1e9)


def test_near_pairs_equal_all_distances() -> None:
    _, hats, _ = hats_and_tree(bumpy_sphere(3))
    points = torch.as_tensor(interior_points(bumpy_sphere(3), 50)) / 2
    chosen = torch.arange(17, 600, 3)
    distances = cdist(hats.centres.numpy(), points.numpy())
    for given, rows in ((None, np.arange(642)), (chosen, chosen.numpy())):
        hat, point = hats.near(points, 1.5, given).numpy()
        found = np.zeros(distances.shape, bool)
        found[hat, point] = True
        ratios = distances / hats.radii.numpy()[:, None]
        assert found[rows][ratios[rows] < 1.5].all()
        assert found.sum() == len(hat)
        assert found.sum() <= (ratios[rows] < 1.51).sum()
        assert found.any()


def test_clusters_of_point_elements_leave_an_error_of_third_order() -> None:
    """Hats that are two surface elements n dS each, the kernel of which is n·r/|r|⁴."""
    rng = np.random.default_rng(0)
    centres, offsets, one, two = torch.as_tensor(rng.normal(size=(4, 50, 3)))
    offsets *= 0.3
    hats = far_field.HatMoments(
        centres=centres,
        radii=offsets.norm(dim=1),
        fluxes=one + two,
        tilts=(one - two)[:, :, None] * offsets[:, None],
        covariances=offsets[:, :, None] * offsets[:, None],
        polynomials=torch.empty(50, 4, 10, dtype=torch.float64),
    )
    functions = torch.as_tensor(rng.normal(size=(50, 3)))
    moments = far_field.ClusterMoments.of(far_field.HatTree.of(hats), hats, functions)
    clusters = torch.arange(2)
    errors = []
    for distance in (200.0, 400.0, 800.0):
        x = distance * torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, -0.8]], dtype=torch.float64))
        terms = torch.empty(19 * 2, 1, dtype=torch.float64)
        moments.fill_terms(x, clusters, terms)
        r = torch.stack([centres + offsets, centres - offsets]) - x
        kernel = (torch.stack([one, two]) * r).sum(-1) / r.square().sum(-1).square()
        exact = kernel.sum(0) @ functions
        far = terms.T @ moments.sums[moments.rows(clusters)]
        errors.append(((far - exact) / (kernel.abs().sum(0) @ functions.abs())).abs().max().item())
    assert errors[0] < 1e-5
    assert errors[1] / errors[0] == pytest.approx(1 / 8, rel=0.1)
    assert errors[2] / errors[1] == pytest.approx(1 / 8, rel=0.1)


def test_cluster_error_falls_with_the_third_power() -> None:
    """All clusters of one level together, seen from ever farther away, against the closed form of all faces."""
    surface, hats, tree = hats_and_tree(bumpy_sphere(3))
    functions = torch.as_tensor(smooth_functions(surface.vertices.numpy()))
    moments = far_field.ClusterMoments.of(tree, hats, functions)
    listed = closed_forms.ListedRule.of(surface)
    clusters = torch.arange(len(tree.radii[0]))
    faces = torch.arange(len(surface.faces))
    errors = []
    for distance in (2.0, 4.0, 8.0, 16.0):
        x = distance * torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, -0.8]], dtype=torch.float64))
        terms = torch.empty(19 * len(clusters), 1, dtype=torch.float64)
        moments.fill_terms(x, clusters, terms)
        far = terms.T @ moments.sums[moments.rows(clusters)]
        weights = listed.weights(faces, x.T.expand(3, len(faces)))[0]
        exact = (weights[..., None] * functions[surface.faces.T]).sum((0, 1))
        scale = (weights.abs()[..., None] * functions[surface.faces.T].abs()).sum((0, 1))
        errors.append(((far[0] - exact).abs() / scale).max().item())
    assert errors[0] < 1e-2
    for before, after in itertools.pairwise(errors):
        assert after < before / 6.5


def test_a_mesh_on_which_the_approximation_is_worse_gets_a_finer_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Constants that promise too much stand for a mesh on which the measured ones do."""
    mesh = bumpy_sphere(5)
    points, functions = interior_points(mesh, 250), smooth_functions(mesh[0])
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
        unchecked.setattr(coordinates, "_sampled_error", lambda *_: 0.0)
        assert error(accuracy) > 2 * accuracy
    assert error(accuracy) < accuracy
    assert "evaluated again" in caplog.text


def test_where_no_approximation_serves_the_closed_form_does(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bumpy_sphere(5)
    points, functions = interior_points(mesh, 60), smooth_functions(mesh[0])
    settings = []

    def never(*_: object) -> float:
        settings.append(1)
        return 1.0

    monkeypatch.setattr(coordinates, "_sampled_error", never)
    found = extend(*mesh, functions, points, accuracy=1e-3, dtype=torch.float64)
    np.testing.assert_allclose(found, extend(*mesh, functions, points), atol=1e-12)
    assert settings


def test_the_sampled_error_is_that_of_the_distances() -> None:
    mesh = bumpy_sphere(4)
    points, functions = interior_points(mesh, 100), smooth_functions(mesh[0])
    surface, x = coordinates._prepare(*mesh, points, "cpu")
    hats, listed = far_field.HatMoments.of(surface), closed_forms.ListedRule.of(surface)
    columns = torch.cat([torch.as_tensor(functions), torch.ones(len(functions), 1)], 1).double()
    exact = extend(*mesh, functions, points)
    assert coordinates._sampled_error(hats, listed, columns, x, exact, 1e-3) < 1e-4
    generator = np.random.default_rng(1)
    for size in (1e-3, 1e-2):
        wrong = exact + size * generator.normal(size=exact.shape)
        expected = np.quantile(np.abs(pdist(wrong) / pdist(exact) - 1), 0.99)
        found = coordinates._sampled_error(hats, listed, columns, x, wrong, 1e-3)
        assert 0.6 * expected < found < 1.7 * expected
    # Errors that go together, here by the same share of every distance, are never taken for less than they are.
    larger = exact.mean(axis=0) + 1.01 * (exact - exact.mean(axis=0))
    assert coordinates._sampled_error(hats, listed, columns, x, larger, 1e-3) > 0.01
    order = np.random.default_rng(0).permutation(len(points))
    half = exact.copy()
    half[:50] *= 1.003
    expected = coordinates._sampled_error(hats, listed, columns, x, half, 1e-3)
    shuffled = coordinates._sampled_error(hats, listed, columns, x[order], half[order], 1e-3)
    assert shuffled == pytest.approx(expected, rel=1e-6)  # the same points, whatever the order

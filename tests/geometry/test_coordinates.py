"""Mean value coordinates, extension and winding numbers against closed forms, the published loop and libigl."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator

import igl
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from conftest import with_slivers
from igps.geometry import closed_forms, coordinates, far_field
from igps.geometry import mesh as geometry
from igps.geometry.coordinates import extend, mean_value_coordinates, winding_number
from igps.geometry.laplacian import laplacian
from igps.linalg import eigenpairs

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))]
Mesh = tuple[np.ndarray, np.ndarray]


def bumpy_sphere(subdivisions: int, amplitude: float = 0.3) -> Mesh:
    """A closed, star-shaped, asymmetric surface."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = sphere.vertices.T
    radius = 1 + amplitude * np.sin(3 * x + 0.5) * np.cos(2 * y) + 0.2 * amplitude * z
    return np.asarray(sphere.vertices * radius[:, None] * [1.0, 0.8, 1.3]), np.asarray(sphere.faces, np.int64)


def cube() -> Mesh:
    box = trimesh.creation.box(extents=(2, 2, 2))
    return np.asarray(box.vertices, np.float64), np.asarray(box.faces, np.int64)


def torus(n_major: int, n_minor: int) -> Mesh:
    shape = trimesh.creation.torus(1.0, 0.35, major_sections=n_major, minor_sections=n_minor)
    return np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64)


def interior_points(mesh: Mesh, n: int, seed: int = 0) -> np.ndarray:
    vertices, faces = mesh
    low, high = vertices.min(0), vertices.max(0)
    points = np.random.default_rng(seed).uniform(low, high, (8 * n, 3))
    return points[igl.winding_number(vertices, faces, points) > 0.5][:n]


def exterior_points(mesh: Mesh, n: int, seed: int = 0) -> np.ndarray:
    vertices, faces = mesh
    points = np.random.default_rng(seed).uniform(2 * vertices.min(0), 2 * vertices.max(0), (8 * n, 3))
    return points[igl.winding_number(vertices, faces, points) < 0.5][:n]


def smooth_functions(vertices: np.ndarray) -> np.ndarray:
    x, y, z = vertices.T
    return np.stack([np.sin(2 * x), np.cos(3 * y + x), x * y * z, np.exp(z), np.sin(5 * z) * x, x], axis=1)


def published_loop(vertices: np.ndarray, faces: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Weights of one point, as Ju, Schaefer and Warren 2005, figure 4, writes them down."""
    eps = 1e-9
    distances = np.linalg.norm(vertices - point, axis=1)
    if distances.min() < eps:
        return np.eye(len(vertices))[distances.argmin()]
    units = (vertices - point) / distances[:, None]
    weights = np.zeros(len(vertices))
    for face in faces:
        u, d = units[face], distances[face]
        lengths = [np.linalg.norm(u[(i + 1) % 3] - u[(i + 2) % 3]) for i in range(3)]
        theta = [2 * math.asin(min(1.0, length / 2)) for length in lengths]
        h = sum(theta) / 2
        if math.pi - h < eps:  # on the face
            weights = np.zeros(len(vertices))
            for i in range(3):
                weights[face[i]] = math.sin(theta[i]) * d[(i + 1) % 3] * d[(i + 2) % 3]
            return weights / weights.sum()
        c = [
            2 * math.sin(h) * math.sin(h - theta[i]) / (math.sin(theta[(i + 1) % 3]) * math.sin(theta[(i + 2) % 3])) - 1
            for i in range(3)
        ]
        sign = math.copysign(1, np.linalg.det(u))
        s = [sign * math.sqrt(max(0.0, 1 - value**2)) for value in c]
        if min(abs(value) for value in s) <= eps:  # in the plane of the face, outside it
            continue
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            weights[face[i]] += (theta[i] - c[j] * theta[k] - c[k] * theta[j]) / (d[i] * math.sin(theta[j]) * s[k])
    return weights / weights.sum()


@pytest.fixture(autouse=True)
def _approximate_small_meshes() -> Iterator[None]:
    # Else the small meshes of these tests would be evaluated exactly, and nothing be compared.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coordinates, "_FEW_VERTICES", 0)
        yield


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many blocks of every kind, uneven ones at the ends."""
    tile = closed_forms.Tile(faces=37, points=5, hats=11, pairs=23)
    monkeypatch.setattr(closed_forms.Tile, "of", staticmethod(lambda device: tile))


@pytest.mark.parametrize("mesh", [bumpy_sphere(2), cube(), torus(14, 9)], ids=["bumpy", "cube", "torus"])
@pytest.mark.parametrize("sample", [interior_points, exterior_points])
def test_weights_sum_to_one_and_reproduce_linear_functions(mesh: Mesh, sample: Callable[..., np.ndarray]) -> None:
    points = sample(mesh, 60)
    weights = mean_value_coordinates(*mesh, points)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(weights @ mesh[0], points, atol=1e-9)


@pytest.mark.parametrize("mesh", [bumpy_sphere(1), cube()], ids=["bumpy", "cube"])
def test_weights_equal_the_published_loop(mesh: Mesh) -> None:
    points = np.concatenate([interior_points(mesh, 15), exterior_points(mesh, 15)])
    expected = np.stack([published_loop(*mesh, point) for point in points])
    np.testing.assert_allclose(mean_value_coordinates(*mesh, points), expected, atol=1e-9)


def test_centre_of_a_regular_solid_weighs_all_vertices_alike() -> None:
    icosahedron = trimesh.creation.icosahedron()
    weights = mean_value_coordinates(icosahedron.vertices, icosahedron.faces, np.zeros((1, 3)))
    np.testing.assert_allclose(weights, 1 / 12, atol=1e-14)


def test_surface_points_are_interpolated_in_their_triangle() -> None:
    vertices, faces = bumpy_sphere(2)
    rng = np.random.default_rng(3)
    chosen = rng.integers(len(faces), size=30)
    barycentric = rng.dirichlet(np.ones(3), size=30)
    barycentric[10:20, 0] = 0  # on an edge
    barycentric[20:] = np.eye(3)[rng.integers(3, size=10)]  # at a vertex
    barycentric /= barycentric.sum(1, keepdims=True)
    expected = np.zeros((30, len(vertices)))
    np.put_along_axis(expected, faces[chosen], barycentric, axis=1)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]])
    np.testing.assert_allclose(mean_value_coordinates(vertices, faces, points), expected, atol=1e-7)


@pytest.mark.parametrize("distance", [1e-3, 1e-5, 1e-7, 1e-8, 1e-9, 1e-10, 1e-12, 1e-15])
def test_weights_are_continuous_towards_faces_edges_and_vertices(distance: float) -> None:
    vertices, faces = bumpy_sphere(2)
    functions = smooth_functions(vertices)
    rng = np.random.default_rng(4)
    chosen = rng.integers(len(faces), size=60)
    barycentric = rng.dirichlet(np.ones(3), size=60)
    barycentric[20:40, 0] = 0
    barycentric[40:] = np.eye(3)[rng.integers(3, size=20)]
    barycentric /= barycentric.sum(1, keepdims=True)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]]) + distance * directions
    limit = np.einsum("pi,pik->pk", barycentric, functions[faces[chosen]])
    np.testing.assert_allclose(extend(vertices, faces, functions, points), limit, atol=60 * distance + 1e-7)
    assert np.abs(extend(vertices, faces, vertices, points) - points).max() < 1e-7


@pytest.mark.parametrize("offset", [0.0, 1e-11, 1e-8])
@pytest.mark.parametrize("subdivisions", [0, 2])
def test_points_in_the_planes_of_faces_are_exact(subdivisions: int, offset: float) -> None:
    """A turned cube: what should be zero is rounding instead, and most faces are far."""
    box = trimesh.creation.box(extents=(2, 2, 2))
    for _ in range(subdivisions):
        box = box.subdivide()
    grid = np.stack(np.meshgrid(*[[-2.0, -1.0 + offset, -0.51, 0.0, 1.0 + offset, 1.53]] * 3), -1).reshape(-1, 3)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix().T
    vertices, points = box.vertices @ turn, grid @ turn
    weights = mean_value_coordinates(vertices, box.faces, points)
    np.testing.assert_allclose(weights @ vertices, points, atol=1e-7)
    np.testing.assert_allclose(mean_value_coordinates(box.vertices, box.faces, grid) @ box.vertices, grid, atol=1e-7)


@pytest.mark.parametrize("accuracy", [None, 1e-2])
def test_similarities_do_not_change_the_result(accuracy: float | None) -> None:
    vertices, faces = bumpy_sphere(3)
    points = interior_points((vertices, faces), 40)
    functions = smooth_functions(vertices)
    expected = extend(vertices, faces, functions, points, accuracy=accuracy, dtype=torch.float64)
    rotation = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    for scale, shift, tolerance in ((1e-6, 0.0, 1e-9), (1e6, 0.0, 1e-9), (1.0, 1e4, 1e-7)):
        moved, moved_points = (scale * array @ rotation.T + shift for array in (vertices, points))
        result = extend(moved, faces, functions, moved_points, accuracy=accuracy, dtype=torch.float64)
        np.testing.assert_allclose(result, expected, atol=tolerance)


def test_orientation_and_order_do_not_matter() -> None:
    vertices, faces = bumpy_sphere(2)
    points = interior_points((vertices, faces), 30)
    expected = mean_value_coordinates(vertices, faces, points)
    np.testing.assert_allclose(mean_value_coordinates(vertices, faces[:, ::-1], points), expected, atol=1e-12)
    shuffled = np.random.default_rng(0).permutation(faces)
    rolled = np.roll(shuffled, 1, axis=1)
    np.testing.assert_allclose(mean_value_coordinates(vertices, rolled, points[::-1])[::-1], expected, atol=1e-12)


@pytest.mark.parametrize("accuracy", [None, 7e-3])
def test_flat_faces_and_loose_vertices_contribute_nothing(accuracy: float | None) -> None:
    vertices, faces = bumpy_sphere(3)
    points = interior_points((vertices, faces), 30)
    functions = smooth_functions(vertices)
    expected = extend(vertices, faces, functions, points, accuracy=accuracy)
    more = np.concatenate([vertices, [vertices[5], points[0], points[1] / 4]])
    n = len(vertices)
    flat = np.array([[0, 0, 1], [5, n, 7], [3, 3, 3], [n + 1, n + 1, 2]])
    values = np.concatenate([functions, np.full((3, functions.shape[1]), 100.0)])
    result = extend(more, np.concatenate([faces, flat]), values, points, accuracy=accuracy)
    np.testing.assert_allclose(result, expected, atol=1e-12 if accuracy is None else 1e-5)


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize(("accuracy", "tolerance"), [(None, 1e-12), (7e-3, 1e-11)])
def test_blocks_do_not_change_the_result(
    accuracy: float | None, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices, faces = bumpy_sphere(3)
    points = np.concatenate([interior_points((vertices, faces), 43), vertices[:3]])
    functions = smooth_functions(vertices)
    blocked = extend(vertices, faces, functions, points, accuracy=accuracy, dtype=torch.float64)
    monkeypatch.undo()
    whole = extend(vertices, faces, functions, points, accuracy=accuracy, dtype=torch.float64)
    np.testing.assert_allclose(blocked, whole, atol=tolerance)
    monkeypatch.setattr(coordinates, "_BLOCK_BYTES", 3 * 8 * len(vertices))
    limited = extend(vertices, faces, functions, points, accuracy=accuracy, dtype=torch.float64)
    np.testing.assert_allclose(limited, whole, atol=tolerance)


def test_weight_blocks_stay_within_their_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bumpy_sphere(2)
    monkeypatch.setattr(coordinates, "_BLOCK_BYTES", 7 * 8 * len(mesh[0]))
    surface, x = coordinates._prepare(*mesh, interior_points(mesh, 40), "cpu")
    hats = far_field.HatMoments.of(surface)
    widths = [weights.shape[1] for _, weights in coordinates._weight_blocks(surface, hats, x, torch.float64)]
    assert widths == [7] * 5 + [5]


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


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("accuracy", "tolerance"), [(None, 1e-5), (1e-2, 1e-5)])
def test_single_precision_agrees_with_double(device: str, accuracy: float | None, tolerance: float) -> None:
    mesh = bumpy_sphere(4)
    points = interior_points(mesh, 80)
    functions = smooth_functions(mesh[0])
    single, double = (
        extend(*mesh, functions, points, accuracy=accuracy, device=device, dtype=dtype)
        for dtype in (torch.float32, torch.float64)
    )
    np.testing.assert_allclose(single, double, atol=tolerance)
    assert not np.array_equal(single, double)


@pytest.mark.parametrize(("accuracy", "dtype"), [(1e-3, torch.float32), (1e-5, torch.float64), (None, torch.float64)])
def test_the_cheapest_precision_that_keeps_the_accuracy_is_taken(accuracy: float | None, dtype: torch.dtype) -> None:
    mesh = bumpy_sphere(3)
    arguments = *mesh, smooth_functions(mesh[0]), interior_points(mesh, 30)
    chosen, given = (extend(*arguments, accuracy=accuracy, dtype=d) for d in (None, dtype))
    assert np.array_equal(chosen, given)


@pytest.mark.parametrize("device", DEVICES[1:])
@pytest.mark.parametrize("accuracy", [None, 1e-2, 1e-5])
def test_devices_agree(device: str, accuracy: float | None) -> None:
    mesh = bumpy_sphere(4)
    points = np.concatenate([interior_points(mesh, 80), mesh[0][:4]])
    functions = smooth_functions(mesh[0])
    one, two = (
        extend(*mesh, functions, points, accuracy=accuracy, device=d, dtype=torch.float64) for d in ("cpu", device)
    )
    np.testing.assert_allclose(two, one, atol=1e-10)
    np.testing.assert_allclose(winding_number(*mesh, points[:80], device=device), 1, atol=1e-10)


@pytest.mark.parametrize("mesh", [bumpy_sphere(3), cube(), torus(20, 12)], ids=["bumpy", "cube", "torus"])
def test_winding_number_is_one_inside_and_zero_outside(mesh: Mesh) -> None:
    np.testing.assert_allclose(winding_number(*mesh, interior_points(mesh, 100)), 1, atol=1e-12)
    np.testing.assert_allclose(winding_number(*mesh, exterior_points(mesh, 100)), 0, atol=1e-12)
    np.testing.assert_allclose(winding_number(mesh[0], mesh[1][:, ::-1], mesh[0][:1] / 2 + 100), 0, atol=1e-12)


@pytest.mark.usefixtures("small_tiles")
def test_winding_number_of_open_surfaces_equals_libigl() -> None:
    vertices, faces = bumpy_sphere(3)
    opened = faces[vertices[faces].mean(1)[:, 2] < 0.4]
    points = np.random.default_rng(1).uniform(-2, 2, (83, 3))
    expected = igl.winding_number(vertices, opened, points)
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(winding_number(vertices, opened, points), expected, atol=1e-12)
    flat = np.array([[0, 1, 1], [2, 2, 2]])
    result = winding_number(vertices, np.concatenate([opened, flat]), points)
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_no_points_give_no_rows() -> None:
    mesh, none = cube(), np.zeros((0, 3))
    assert mean_value_coordinates(*mesh, none).shape == (0, 8)
    assert extend(*mesh, np.ones((8, 3)), none, accuracy=1e-3).shape == (0, 3)
    assert winding_number(*mesh, none).shape == (0,)


def test_read_only_and_single_precision_input_is_accepted_and_kept() -> None:
    vertices, faces = cube()
    points, functions = np.array([[0.1, 0.2, 0.3]]), np.ones((8, 2), np.float32)
    arrays = vertices.astype(np.float32), faces.astype(np.int32), functions, points
    for array in arrays:
        array.setflags(write=False)
    np.testing.assert_allclose(extend(*arrays, accuracy=1e-2), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.zeros((8, 2))}, "vertices: expected shape"),
        ({"vertices": np.full((8, 3), np.nan)}, "vertices: expected finite"),
        ({"vertices": np.ones((8, 3))}, "vertices: expected distinct"),
        ({"faces": np.zeros((2, 4), int)}, "faces: expected shape"),
        ({"faces": np.zeros((2, 3))}, "faces: expected integer"),
        ({"faces": np.zeros((0, 3), int)}, "faces: expected at least one face"),
        ({"faces": np.array([[0, 1, 8]])}, "faces: .* indices in"),
        ({"faces": np.array([[0, -1, 2]])}, "faces: .* indices in"),
        ({"faces": np.array([[0, 1, 1]])}, "faces: .* with an area"),
        ({"points": np.zeros(3)}, "points: expected shape"),
        ({"points": np.full((1, 3), np.inf)}, "points: expected finite"),
        ({"functions": np.ones(8)}, "functions: expected shape"),
        ({"functions": np.ones((7, 2))}, "functions: expected shape"),
        ({"functions": np.full((8, 2), np.nan)}, "functions: expected finite"),
        ({"accuracy": 0.0}, "accuracy: expected"),
        ({"accuracy": float("nan")}, "accuracy: expected"),
        ({"dtype": torch.float16}, "dtype: expected"),
    ],
)
def test_invalid_arguments_are_named(change: dict[str, object], message: str) -> None:
    vertices, faces = cube()
    arguments = {"vertices": vertices, "faces": faces, "functions": np.ones((8, 2)), "points": np.zeros((1, 3))}
    with pytest.raises(ValueError, match=message):
        extend(**(arguments | change))


def test_weights_without_a_sum_raise() -> None:
    """A point in the plane of a single triangle sees nothing of it."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(ValueError, match="points: expected mean value weights with a sum"):
        extend(vertices, np.array([[0, 1, 2]]), np.ones((3, 1)), np.array([[2.0, 2, 0]]))


def test_coarse_meshes_are_evaluated_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bumpy_sphere(3)
    points, functions = interior_points(mesh, 20), smooth_functions(mesh[0])
    monkeypatch.setattr(coordinates, "_FEW_VERTICES", 2000)
    exact, chosen = (extend(*mesh, functions, points, accuracy=a, dtype=torch.float64) for a in (None, 0.1))
    np.testing.assert_array_equal(chosen, exact)

"""The far field: approximate coordinates keep their accuracy, clusters and moments the order of their error."""

import functools
import itertools
import logging

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from bodies import bumpy_sphere, interior_points, smooth_functions, torus
from conftest import with_slivers
from igps.mesh import mesh as geometry
from igps.signature import mean_value as coordinates
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import Extension, extend
from igps.signature.ordering import spatial_order
from igps.spectra import eigenpairs

pytestmark = pytest.mark.usefixtures("approximate_small_meshes")


@functools.cache
def commute_time_embedding(name):
    """A mesh, and its first 100 eigenfunctions over √λ (V, 100): their distances are those of the descriptor."""
    if name == "torus":
        mesh = torus(160, 60)
    elif name == "bumpy":
        mesh = bumpy_sphere(4)
    else:
        mesh = with_slivers(*bumpy_sphere(4), 300)
    spectrum = eigenpairs(
        *laplacian(geometry.Mesh(*mesh)),
        100,
        positions=mesh[0],
    )
    return mesh, spectrum.eigenfunctions / np.sqrt(spectrum.eigenvalues)


@pytest.mark.parametrize("accuracy", [7e-3, 1e-4])
@pytest.mark.parametrize("name", ["bumpy", "torus", "slivers"])
def test_approximation_keeps_its_accuracy_and_spends_it(name, accuracy):
    mesh, embedding = commute_time_embedding(name)
    points = interior_points(mesh, 250)
    for functions in (embedding, smooth_functions(mesh[0])):
        exact = extend(*mesh, functions, points)
        near = extend(*mesh, functions, points, accuracy=accuracy)
        error = np.abs(pdist(near) / pdist(exact) - 1)
        # far below, the approximation would be slower than it need be, or not take place
        assert accuracy / 20 < np.quantile(error, 0.99) < accuracy


def test_approximation_tends_to_the_exact_result():
    mesh = bumpy_sphere(4)
    points = interior_points(mesh, 60)
    functions = smooth_functions(mesh[0])
    exact = extend(*mesh, functions, points)
    assert np.array_equal(
        extend(*mesh, functions, points, accuracy=1e-9),
        exact,
    )  # nothing is far
    errors = []
    for accuracy in (1e-3, 1e-4, 1e-5, 1e-9):
        found = extend(*mesh, functions, points, accuracy=accuracy)
        errors.append(np.abs(found - exact).max())
    assert errors[-1] < 1e-10  # all near
    for before, after in itertools.pairwise(errors):
        assert after < before / 4


def test_surface_points_are_interpolated_also_where_most_of_the_surface_is_far():
    vertices, faces = bumpy_sphere(4)
    functions = smooth_functions(vertices)
    rng = default_rng(5)
    chosen = rng.integers(len(faces), size=60)
    barycentric = rng.dirichlet(np.ones(3), size=60)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]])
    expected = np.einsum("pi,pik->pk", barycentric, functions[faces[chosen]])
    result = extend(
        vertices,
        faces,
        functions,
        points,
        accuracy=1e-2,
        dtype=np.float64,
    )
    assert_allclose(result, expected, atol=1e-12)


def test_clusters_turn_with_the_mesh():
    vertices, faces = bumpy_sphere(4)
    # No mirror symmetry, no ties
    vertices = vertices + 1e-3 * default_rng(0).normal(size=vertices.shape)
    points = interior_points((vertices, faces), 400)
    functions = smooth_functions(vertices)
    rotation = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix().T
    exact, still, turned = (
        extend(
            vertices @ turn, faces, functions, points @ turn, accuracy=accuracy, dtype=np.float64
        )
        for accuracy, turn in ((None, np.eye(3)), (1e-3, np.eye(3)), (1e-3, rotation))
    )
    assert_allclose(turned, still, atol=1e-9)
    assert np.abs(still - exact).max() > 1e-5


def test_approximation_reproduces_positions():
    mesh = torus(240, 80)
    points = interior_points(mesh, 300)
    for accuracy in (1e-2, 1e-3, 1e-4):
        error = np.linalg.norm(
            extend(*mesh, mesh[0], points, accuracy=accuracy) - points,
            axis=1,
        )
        assert 1e-9 < np.quantile(error, 0.99) < accuracy


@pytest.mark.parametrize("size", [1, 8])
def test_spatial_order_cuts_a_grid_into_cubes(size):
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    points = default_rng(0).permutation(grid)
    order = spatial_order(points, size)
    assert_array_equal(np.sort(order), np.arange(512))
    for run, side in ((8, 1), (64, 3)):
        assert (np.ptp(points[order].reshape(-1, run, 3), axis=1) == side).all()


@pytest.mark.parametrize("n", [0, 7, 83])
def test_spatial_order_is_one_for_any_number(n):
    points = default_rng(n).normal(size=(n, 3))
    order = spatial_order(points, 8)
    assert_array_equal(np.sort(order), np.arange(n))


def test_a_mesh_on_which_the_approximation_is_worse_gets_a_finer_one(monkeypatch, caplog):
    """Error constants that are too small stand for such a mesh; the sampled error must trigger a second evaluation."""
    mesh = bumpy_sphere(5)
    points = interior_points(mesh, 250)
    functions = smooth_functions(mesh[0])
    exact = extend(*mesh, functions, points)
    caplog.set_level(logging.INFO, logger=coordinates.logger.name)

    def error(accuracy):
        found = extend(*mesh, functions, points, accuracy=accuracy)
        return float(
            np.quantile(
                np.abs(pdist(found) / pdist(exact) - 1),
                0.99,
            )
        )

    accuracy = 1e-4
    assert error(accuracy) < accuracy
    assert not caplog.records
    monkeypatch.setattr(coordinates, "_CLUSTER_ERROR", 1e-7)
    monkeypatch.setattr(coordinates, "_HAT_ERROR", 1e-4)
    assert error(accuracy) < accuracy
    assert "evaluated again" in caplog.text


def test_where_no_approximation_serves_the_closed_form_does(monkeypatch):
    mesh = bumpy_sphere(5)
    points = interior_points(mesh, 60)
    functions = smooth_functions(mesh[0])
    settings = []

    def never(*_):
        settings.append(1)
        return 1.0

    monkeypatch.setattr(Extension, "_sampled_error", never)
    found = extend(
        *mesh,
        functions,
        points,
        accuracy=1e-3,
        dtype=np.float64,
    )
    assert_allclose(found, extend(*mesh, functions, points), atol=1e-12)
    assert settings

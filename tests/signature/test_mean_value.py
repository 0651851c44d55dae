"""Mean value coordinates, extension and winding numbers against closed forms, the published loop and libigl."""

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from bodies import (
    bumpy_sphere,
    cube,
    exterior_points,
    interior_points,
    mean_value_coordinates,
    smooth_functions,
    torus,
)
from igps.signature import mean_value as coordinates
from igps.signature.mean_value import extend
from loops import mean_values

pytestmark = pytest.mark.usefixtures("approximate_small_meshes")


@pytest.mark.parametrize(
    "mesh", [bumpy_sphere(2), cube(), torus(14, 9)], ids=["bumpy", "cube", "torus"]
)
@pytest.mark.parametrize("sample", [interior_points, exterior_points])
def test_weights_sum_to_one_and_reproduce_linear_functions(mesh, sample):
    points = sample(mesh, 60)
    weights = mean_value_coordinates(*mesh, points)
    assert_allclose(weights.sum(1), 1, atol=1e-12)
    assert_allclose(weights @ mesh[0], points, atol=1e-9)


@pytest.mark.parametrize(
    "mesh",
    [bumpy_sphere(1), cube()],
    ids=["bumpy", "cube"],
)
def test_weights_equal_the_published_loop(mesh):
    points = np.concatenate(
        [
            interior_points(mesh, 15),
            exterior_points(mesh, 15),
        ]
    )
    expected = mean_values(*mesh, points, np.eye(len(mesh[0])))
    assert_allclose(mean_value_coordinates(*mesh, points), expected, atol=1e-9)


def test_centre_of_a_regular_solid_weighs_all_vertices_alike():
    icosahedron = trimesh.creation.icosahedron()
    weights = mean_value_coordinates(
        icosahedron.vertices,
        icosahedron.faces,
        np.zeros((1, 3)),
    )
    assert_allclose(weights, 1 / 12, atol=1e-14)


def test_surface_points_are_interpolated_in_their_triangle():
    vertices, faces = bumpy_sphere(2)
    rng = default_rng(3)
    chosen = rng.integers(len(faces), size=30)
    barycentric = rng.dirichlet(np.ones(3), size=30)
    barycentric[10:20, 0] = 0  # on an edge
    barycentric[20:] = np.eye(3)[rng.integers(3, size=10)]  # at a vertex
    barycentric /= barycentric.sum(1, keepdims=True)
    expected = np.zeros((30, len(vertices)))
    np.put_along_axis(expected, faces[chosen], barycentric, axis=1)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]])
    assert_allclose(mean_value_coordinates(vertices, faces, points), expected, atol=1e-7)


@pytest.mark.parametrize("distance", [1e-3, 1e-7, 1e-9, 1e-12])
def test_weights_are_continuous_towards_faces_edges_and_vertices(distance):
    vertices, faces = bumpy_sphere(2)
    functions = smooth_functions(vertices)
    rng = default_rng(4)
    chosen = rng.integers(len(faces), size=60)
    barycentric = rng.dirichlet(np.ones(3), size=60)
    barycentric[20:40, 0] = 0
    barycentric[40:] = np.eye(3)[rng.integers(3, size=20)]
    barycentric /= barycentric.sum(1, keepdims=True)
    directions = rng.normal(size=(60, 3))
    directions /= norm(directions, axis=1, keepdims=True)
    points = np.einsum("pi,pix->px", barycentric, vertices[faces[chosen]]) + distance * directions
    limit = np.einsum("pi,pik->pk", barycentric, functions[faces[chosen]])
    assert_allclose(extend(vertices, faces, functions, points), limit, atol=60 * distance + 1e-7)
    assert np.abs(extend(vertices, faces, vertices, points) - points).max() < 1e-7


@pytest.mark.parametrize("offset", [0.0, 1e-11, 1e-8])
@pytest.mark.parametrize("subdivisions", [0, 2])
def test_points_in_the_planes_of_faces_are_exact(subdivisions, offset):
    """A turned cube: what should be zero is rounding instead, and most faces are far."""
    box = trimesh.creation.box(extents=(2, 2, 2))
    for _ in range(subdivisions):
        box = box.subdivide()
    line = [
        -2.0,
        -1.0 + offset,
        -0.51,
        0.0,
        1.0 + offset,
        1.53,
    ]
    grid = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix().T
    vertices = box.vertices @ turn
    points = grid @ turn
    weights = mean_value_coordinates(vertices, box.faces, points)
    assert_allclose(weights @ vertices, points, atol=1e-7)
    straight = mean_value_coordinates(box.vertices, box.faces, grid)
    assert_allclose(straight @ box.vertices, grid, atol=1e-7)


@pytest.mark.parametrize("accuracy", [None, 1e-2])
def test_similarities_do_not_change_the_result(accuracy):
    vertices, faces = bumpy_sphere(3)
    points = interior_points((vertices, faces), 40)
    functions = smooth_functions(vertices)
    expected = extend(
        vertices,
        faces,
        functions,
        points,
        accuracy=accuracy,
        dtype=np.float64,
    )
    rotation = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    for scale, shift, tolerance in ((1e-6, 0.0, 1e-9), (1e6, 0.0, 1e-9), (1.0, 1e4, 1e-7)):
        moved, moved_points = (scale * array @ rotation.T + shift for array in (vertices, points))
        result = extend(
            moved,
            faces,
            functions,
            moved_points,
            accuracy=accuracy,
            dtype=np.float64,
        )
        assert_allclose(result, expected, atol=tolerance)


def test_orientation_and_order_do_not_matter():
    vertices, faces = bumpy_sphere(2)
    points = interior_points((vertices, faces), 30)
    expected = mean_value_coordinates(vertices, faces, points)
    turned = mean_value_coordinates(vertices, faces[:, ::-1], points)
    assert_allclose(turned, expected, atol=1e-12)
    shuffled = default_rng(0).permutation(faces)
    rolled = np.roll(shuffled, 1, axis=1)
    backwards = mean_value_coordinates(vertices, rolled, points[::-1])
    assert_allclose(backwards[::-1], expected, atol=1e-12)


@pytest.mark.parametrize("accuracy", [None, 7e-3])
def test_flat_faces_and_loose_vertices_contribute_nothing(accuracy):
    vertices, faces = bumpy_sphere(3)
    points = interior_points((vertices, faces), 30)
    functions = smooth_functions(vertices)
    expected = extend(vertices, faces, functions, points, accuracy=accuracy)
    more = np.concatenate(
        [
            vertices,
            [vertices[5], points[0], points[1] / 4],
        ]
    )
    n = len(vertices)
    flat = np.array(
        [
            [0, 0, 1],
            [5, n, 7],
            [3, 3, 3],
            [n + 1, n + 1, 2],
        ]
    )
    values = np.concatenate(
        [
            functions,
            np.full((3, functions.shape[1]), 100.0),
        ]
    )
    result = extend(
        more,
        np.concatenate([faces, flat]),
        values,
        points,
        accuracy=accuracy,
    )
    assert_allclose(result, expected, atol=1e-12 if accuracy is None else 1e-5)


@pytest.mark.parametrize(
    ("accuracy", "tolerance"),
    [(None, 1e-12), (7e-3, 1e-11)],
)
def test_pieces_do_not_change_the_result(accuracy, tolerance, monkeypatch):
    vertices, faces = bumpy_sphere(3)
    points = np.concatenate(
        [
            interior_points((vertices, faces), 43),
            vertices[:3],
        ]
    )
    functions = smooth_functions(vertices)
    whole = extend(
        vertices,
        faces,
        functions,
        points,
        accuracy=accuracy,
        dtype=np.float64,
    )
    monkeypatch.setattr(coordinates, "_BLOCK_BYTES", 3 * 8 * len(vertices))
    limited = extend(
        vertices,
        faces,
        functions,
        points,
        accuracy=accuracy,
        dtype=np.float64,
    )
    assert_allclose(limited, whole, atol=tolerance)


@pytest.mark.parametrize("accuracy", [None, 1e-2])
def test_single_precision_agrees_with_double(accuracy):
    mesh = bumpy_sphere(4)
    points = interior_points(mesh, 80)
    functions = smooth_functions(mesh[0])
    single, double = (
        extend(*mesh, functions, points, accuracy=accuracy, dtype=dtype)
        for dtype in (np.float32, np.float64)
    )
    assert_allclose(single, double, atol=1e-5)
    assert not np.array_equal(single, double)


@pytest.mark.parametrize(
    ("accuracy", "dtype"),
    [
        (1e-3, np.float32),
        (1e-5, np.float64),
        (None, np.float64),
    ],
)
def test_the_cheapest_precision_that_keeps_the_accuracy_is_taken(accuracy, dtype):
    mesh = bumpy_sphere(3)
    arguments = *mesh, smooth_functions(mesh[0]), interior_points(mesh, 30)
    chosen, given = (
        extend(
            *arguments,
            accuracy=accuracy,
            dtype=d,
        )
        for d in (None, dtype)
    )
    assert np.array_equal(chosen, given)


def test_no_points_give_no_rows():
    mesh = cube()
    none = np.zeros((0, 3))
    assert mean_value_coordinates(*mesh, none).shape == (0, 8)
    assert extend(*mesh, np.ones((8, 3)), none, accuracy=1e-3).shape == (0, 3)


def test_read_only_and_single_precision_input_is_accepted_and_kept():
    vertices, faces = cube()
    points = np.array([[0.1, 0.2, 0.3]])
    functions = np.ones((8, 2), np.float32)
    arrays = vertices.astype(np.float32), faces.astype(np.int32), functions, points
    for array in arrays:
        array.setflags(write=False)
    assert_allclose(extend(*arrays, accuracy=1e-2), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.zeros((8, 2))}, "vertices: expected shape"),
        ({"vertices": np.full((8, 3), np.nan)}, "vertices: expected finite"),
        ({"vertices": np.ones((8, 3))}, "vertices: expected distinct"),
        ({"faces": np.zeros((2, 4), int)}, "faces: expected shape"),
        ({"faces": np.zeros((2, 3))}, "faces: expected integer"),
        ({"faces": np.zeros((0, 3), int)}, "faces: expected at least one face"),
        ({"faces": np.array([[0, -1, 2]])}, "faces: .* indices in"),
        ({"faces": np.array([[0, 1, 1]])}, "faces: .* with an area"),
        ({"points": np.zeros(3)}, "points: expected shape"),
        ({"points": np.full((1, 3), np.inf)}, "points: expected finite"),
        ({"functions": np.ones(8)}, "functions: expected shape"),
        ({"functions": np.full((8, 2), np.nan)}, "functions: expected finite"),
        (
            {"functions": np.array([[1.0, np.inf]] * 4 + [[1.0, -np.inf]] * 4)},
            "functions: expected finite",
        ),
        (
            {"divisors": np.ones(3)},
            r"divisors: expected shape \(2,\), one per function, got \(3,\)",
        ),
        ({"accuracy": float("nan")}, "accuracy: expected"),
        ({"dtype": np.float16}, "dtype: expected"),
    ],
)
def test_invalid_arguments_are_named(change, message):
    vertices, faces = cube()
    arguments = {
        "vertices": vertices,
        "faces": faces,
        "functions": np.ones((8, 2)),
        "points": np.zeros((1, 3)),
    }
    with pytest.raises(ValueError, match=message):
        extend(**(arguments | change))


@pytest.mark.parametrize("accuracy", [None, 1e-3])
def test_functions_are_divided_on_the_way(accuracy):
    mesh = bumpy_sphere(3)
    generator = default_rng(5)
    functions = generator.standard_normal((len(mesh[0]), 4))
    points = generator.uniform(-0.4, 0.4, (30, 3))
    divisors = np.array([0.5, 1.0, 3.0, 7.0])
    result = extend(*mesh, functions, points, divisors=divisors, accuracy=accuracy)
    assert np.array_equal(
        result,
        extend(*mesh, functions / divisors, points, accuracy=accuracy),
    )


def test_finite_functions_may_sum_to_infinity():
    vertices, faces = cube()
    huge = np.full((8, 2), 3e38, dtype=np.float32)
    found = extend(
        vertices,
        faces,
        huge,
        np.zeros((1, 3)),
    )
    assert found == pytest.approx(3e38, rel=1e-6)


def test_weights_without_a_sum_raise():
    """A point in the plane of a single triangle sees nothing of it."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(ValueError, match="points: expected mean value weights with a non-zero sum"):
        extend(
            vertices,
            np.array([[0, 1, 2]]),
            np.ones((3, 1)),
            np.array([[2.0, 2, 0]]),
        )

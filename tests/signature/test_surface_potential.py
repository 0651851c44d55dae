"""The potential of charged triangles against quadrature and closed forms."""

import numpy as np
import pytest
import scipy.integrate
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose

from igps.signature.surface_potential import surface_potential


def by_quadrature(triangle, point):
    """∫ dS/r in polar coordinates about the point's projection, where nothing is singular."""
    a, b, c = triangle
    normal = np.cross(b - a, c - a)
    normal /= norm(normal)
    height = (a - point) @ normal
    foot = point + height * normal
    total = 0.0
    for p, q in ((a, b), (b, c), (c, a)):
        along = (q - p) / norm(q - p)
        # Of the side's line from the foot, positive inside
        distance = np.cross(along, normal) @ (p - foot)
        if abs(distance) < 1e-14:
            continue
        angles = [
            np.arctan2(
                (end - foot) @ along,
                abs(distance),
            )
            for end in (p, q)
        ]
        # ∫ r dr / √(r² + h²) from the foot to the side, for each direction.
        value, _ = scipy.integrate.quad(
            lambda t, d=distance: np.hypot(d / np.cos(t), height) - abs(height),
            *angles,
            epsabs=1e-13,
            epsrel=1e-12,
        )
        total += np.sign(distance) * value
    return total


def triangle_of(kind):
    generator = default_rng(3)
    if kind == "any":
        return generator.normal(size=(3, 3))
    if kind == "obtuse":
        return np.array([[0, 0, 0], [1, 0.2, 0.1], [0.4, 0.1, 0.3]])
    return np.array([[0, 0, 0], [3, 1, 2], [3, 1, 2.001]])


@pytest.mark.parametrize("kind", ["any", "obtuse", "needle"])
@pytest.mark.parametrize("height", [0.0, 1e-9, -0.3, 5.0])
def test_triangle_equals_quadrature(kind, height):
    triangle = triangle_of(kind)
    normal = np.cross(
        triangle[1] - triangle[0],
        triangle[2] - triangle[0],
    )
    normal /= norm(normal)
    weights = np.array(
        [
            [0.2, 0.3, 0.5],
            [0.9, 0.05, 0.05],
            [1.4, -0.2, -0.2],
            [-0.6, 0.9, 0.7],
            [2.5, -3.0, 1.5],
        ]
    )
    points = weights @ triangle + height * normal
    expected = [by_quadrature(triangle, point) for point in points]
    result = surface_potential(
        triangle,
        np.array([[0, 1, 2]]),
        points,
    )
    assert_allclose(result, expected, rtol=1e-4)
    exact = surface_potential(
        triangle,
        np.array([[0, 1, 2]]),
        points,
        accuracy=1e-12,
    )
    assert_allclose(exact, expected, rtol=1e-7)


def test_square_from_its_centre_side_and_corner():
    square = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        dtype=float,
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    # On the diagonal, and at its ends or not
    points = np.array(
        [
            [0.5, 0.5, 0],
            [0, 0, 0],
            [1, 1, 0],
            [0, 1, 0],
        ]
    )
    expected = np.log(1 + np.sqrt(2)) * np.array([4, 2, 2, 2])
    found = surface_potential(square, faces, points)
    assert_allclose(found, expected, rtol=1e-12)
    # A side's middle sees two rectangles of 1 × ½.
    middle = 2 * (np.arcsinh(0.5) + 0.5 * np.arcsinh(2))
    assert_allclose(
        surface_potential(square, faces, np.array([[0.5, 0, 0]])),
        middle,
        rtol=1e-12,
    )


def test_disc_on_its_axis():
    n = 4000
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    rim = 3 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n)])
    vertices = np.vstack([rim, np.zeros(3)])
    faces = np.column_stack(
        [
            np.arange(n),
            np.roll(np.arange(n), -1),
            np.full(n, n),
        ]
    )
    heights = np.array([0, 1e-6, 0.01, 0.5, 3, -20, 300])
    points = np.column_stack([0 * heights, 0 * heights, heights])
    expected = 2 * np.pi * (np.sqrt(9 + heights**2) - np.abs(heights))
    found = surface_potential(vertices, faces, points)
    assert_allclose(found, expected, rtol=2e-6)


@pytest.mark.parametrize("n_subdivisions", [0, 2])
def test_centre_of_a_cylinder_of_needles(n_subdivisions):
    cylinder = trimesh.creation.cylinder(0.2, 4, sections=300)
    for _ in range(n_subdivisions):
        cylinder = cylinder.subdivide()
    side = 2 * np.pi * 0.2 * 2 * np.arcsinh(2 / 0.2)
    caps = 2 * 2 * np.pi * (np.hypot(0.2, 2) - 2)
    result = surface_potential(
        cylinder.vertices,
        cylinder.faces,
        np.zeros((1, 3)),
    )
    assert_allclose(result, side + caps, rtol=1e-4)  # a polygon of 300 sides
    exact = surface_potential(
        cylinder.vertices,
        cylinder.faces,
        np.zeros((1, 3)),
        accuracy=1e-12,
    )
    assert_allclose(result, exact, rtol=1e-5)


def body():
    """A bent bar with needles, fans and fine triangles beside coarse ones."""
    cylinder = trimesh.creation.cylinder(0.3, 3, sections=90)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.6)
    ball.vertices += [0, 0, 1.8]
    vertices = np.vstack([cylinder.vertices, ball.vertices])
    vertices[:, 0] += 0.2 * vertices[:, 2] ** 2
    return vertices, np.vstack(
        [
            cylinder.faces,
            ball.faces + len(cylinder.vertices),
        ]
    )


def samples(vertices, faces):
    """Points inside, outside, far away, at vertices, on edges, on faces and a hair above them."""
    generator = default_rng(0)
    corners = vertices[faces[generator.integers(len(faces), size=40)]]
    weights = generator.dirichlet([1, 1, 1], size=40)
    on = np.einsum("pi,pij->pj", weights, corners)
    return np.vstack(
        [
            generator.uniform(
                vertices.min(axis=0) - 0.5,
                vertices.max(axis=0) + 0.5,
                (200, 3),
            ),
            generator.normal(size=(20, 3)) * 50,
            vertices[::101],
            (corners[:, 0] + corners[:, 1]) / 2,
            on,
            on + 1e-7,
        ]
    )


def test_every_value_has_the_accuracy():
    vertices, faces = body()
    points = samples(vertices, faces)
    exact = surface_potential(vertices, faces, points, accuracy=1e-13)
    assert np.isfinite(exact).all()
    errors = {}
    for accuracy in (1e-1, 1e-3, 1e-6):
        found = surface_potential(vertices, faces, points, accuracy=accuracy)
        errors[accuracy] = np.abs(found / exact - 1).max()
    assert 1e-7 < errors[1e-1] < 1e-2
    assert errors[1e-3] < 1e-5
    assert errors[1e-6] < 1e-9


def test_exact_values_are_the_sum_over_the_triangles():
    vertices, faces = body()
    points = samples(vertices, faces)[::40]
    exact = surface_potential(vertices, faces, points, accuracy=1e-13)
    expected = [
        sum(by_quadrature(vertices[face], point) for face in faces[::37]) for point in points
    ]
    assert_allclose(
        surface_potential(
            vertices,
            faces[::37],
            points,
            accuracy=1e-13,
        ),
        expected,
        rtol=1e-7,
    )
    assert (exact > expected).all()


def test_motion_scale_numbering_and_company_do_not_matter():
    vertices, faces = body()
    points = samples(vertices, faces)
    expected = surface_potential(vertices, faces, points)
    generator = default_rng(1)
    turn = trimesh.transformations.random_rotation_matrix(generator.random(3))[:3, :3]
    places, samples_there = (1e-4 * x @ turn.T + [3, -1, 2] for x in (vertices, points))
    moved = surface_potential(places, faces, samples_there)
    assert_allclose(moved, 1e-4 * expected, rtol=1e-5)
    order = generator.permutation(len(vertices))
    renumbered = np.argsort(order)[faces][generator.permutation(len(faces))][:, [1, 2, 0]]
    assert_allclose(surface_potential(vertices[order], renumbered, points), expected, rtol=1e-5)
    alone = [surface_potential(vertices, faces, point[None])[0] for point in points[::25]]
    assert_allclose(alone, expected[::25], rtol=1e-5)


def test_faces_without_area_add_nothing_and_no_points_give_none():
    vertices, faces = body()
    points = samples(vertices, faces)
    flat = np.vstack([faces, [[0, 0, 5], [7, 8, 8]]])
    assert_allclose(
        surface_potential(vertices, flat, points),
        surface_potential(vertices, faces, points),
        rtol=1e-5,
    )
    assert surface_potential(vertices, faces, np.empty((0, 3))).shape == (0,)
    assert (surface_potential(vertices, flat[-2:], points[:2]) == 0).all()

"""Winding numbers, against closed solids and spherical excess."""

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.testing import assert_allclose

from bodies import bumpy_sphere, cube, exterior_points, interior_points, torus
from igps.mesh.winding import winding_number


@pytest.mark.parametrize(
    "mesh", [bumpy_sphere(3), cube(), torus(20, 12)], ids=["bumpy", "cube", "torus"]
)
def test_winding_number_is_one_inside_and_zero_outside(mesh):
    assert_allclose(winding_number(*mesh, interior_points(mesh, 100)), 1, atol=1e-12)
    assert_allclose(winding_number(*mesh, exterior_points(mesh, 100)), 0, atol=1e-12)
    assert_allclose(
        winding_number(mesh[0], mesh[1][:, ::-1], mesh[0][:1] / 2 + 100),
        0,
        atol=1e-12,
    )


def winding_by_loops(vertices, faces, points):
    """Spherical excess of one triangle after another (L'Huilier), signed by the side that the point is on."""
    total = np.zeros(len(points))
    for i, point in enumerate(points):
        for corners in vertices[faces] - point:
            a, b, c = corners / norm(corners, axis=1, keepdims=True)
            sides = [2 * np.arctan2(norm(p - q), norm(p + q)) for p, q in ((b, c), (c, a), (a, b))]
            half = sum(sides) / 2
            tangents = np.tan(half / 2) * np.prod([np.tan((half - side) / 2) for side in sides])
            total[i] += (
                np.sign(np.linalg.det(corners))
                * 4
                * np.arctan(np.sqrt(max(tangents, 0)))
                / (4 * np.pi)
            )
    return total


@pytest.mark.parametrize("kind", ["opened", "soup"])
def test_winding_number_is_the_sum_of_solid_angles(kind):
    generator = np.random.default_rng(1)
    vertices, faces = bumpy_sphere(2)
    if kind == "opened":
        faces = faces[vertices[faces].mean(1)[:, 2] < 0.4]
    else:
        vertices = generator.normal(size=(270, 3))
        faces = np.arange(270).reshape(-1, 3)
    points = generator.uniform(-2, 2, (83, 3))
    expected = winding_by_loops(vertices, faces, points)
    assert np.ptp(expected) > 0.5
    found = winding_number(vertices, faces, points)
    assert_allclose(found, expected, atol=1e-7)
    flat = np.array([[0, 1, 1], [2, 2, 2]])
    for more in (np.concatenate([faces, flat]), np.concatenate([np.tile(flat, (40, 1)), faces])):
        assert_allclose(winding_number(vertices, more, points), expected, atol=1e-7)
    assert_allclose(
        winding_number(1e3 + vertices, faces, 1e3 + points),
        expected,
        atol=1e-7,
    )


def test_winding_number_of_flat_faces_alone_is_refused():
    flat = np.array([[0, 1, 1], [2, 2, 2]])
    with pytest.raises(ValueError, match="expected at least one face with an area"):
        winding_number(
            cube()[0],
            flat,
            np.zeros((1, 3)),
        )


def test_no_points_have_no_winding_numbers():
    assert winding_number(*cube(), np.zeros((0, 3))).shape == (0,)

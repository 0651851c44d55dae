import numpy as np
import pytest
import scipy.integrate
import trimesh
from numpy.testing import assert_allclose

from igps.mesh.mesh import Mesh
from igps.signature.attributes import (
    depth,
    electrostatic_potential,
    interior_attributes,
    surface_attributes,
    surface_direction,
)
from igps.signature.config import SignatureConfig


@pytest.fixture(scope="module")
def box():
    body = trimesh.creation.box([1.0, 2.0, 3.0])
    for _ in range(4):
        body = body.subdivide()
    return Mesh(body.vertices, body.faces)


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-0.45, 0.45, (40, 3)) * [1, 2, 3]


def test_depth_in_a_box_is_to_the_nearest_wall(box, points):
    expected = (np.array([0.5, 1.0, 1.5]) - np.abs(points)).min(axis=1) / np.sqrt(22)
    assert_allclose(depth(box, points), expected, atol=1e-12)


def test_direction_in_a_box_is_the_normal_of_the_nearest_wall(box, points):
    gap = np.array([0.5, 1.0, 1.5]) - np.abs(points)
    expected = np.sign(points) * (gap == gap.min(axis=1, keepdims=True))
    assert_allclose(surface_direction(box, points), expected, atol=1e-12)


def test_direction_on_the_surface_is_the_outward_normal(sphere):
    faces = np.arange(0, len(sphere.faces), 7)
    centres = sphere.vertices[sphere.faces[faces]].mean(axis=1)
    normals = surface_attributes(sphere, faces, ("depth", "surface_direction"))
    assert list(normals) == ["surface_direction"]  # the depth of the surface is 0 everywhere
    expected = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    assert_allclose(normals["surface_direction"], expected, atol=0.02)
    assert surface_attributes(sphere, faces, ("depth",)) == {}


def test_potential_in_a_charged_ball_is_constant(sphere):
    points = np.random.default_rng(1).normal(size=(30, 3))
    points *= np.linspace(0, 0.9, 30)[:, None] / np.linalg.norm(points, axis=1)[:, None]
    assert_allclose(
        electrostatic_potential(sphere, points),
        np.sqrt(4 * np.pi),
        rtol=2e-3,
    )


def test_potential_in_a_box_is_the_surface_integral(box):
    point = np.array([0.1, -0.3, 0.6])
    size = np.array([1.0, 2.0, 3.0])
    total = 0.0
    for axis in range(3):
        u, v = (i for i in range(3) if i != axis)
        for side in (-0.5, 0.5):
            height = side * size[axis] - point[axis]
            value, _ = scipy.integrate.dblquad(
                lambda y, x, u=u, v=v, h=height: (
                    1 / np.sqrt((x - point[u]) ** 2 + (y - point[v]) ** 2 + h**2)
                ),
                -size[u] / 2,
                size[u] / 2,
                -size[v] / 2,
                size[v] / 2,
            )
            total += value
    finer = Mesh(*trimesh.remesh.subdivide(box.vertices, box.faces))
    assert_allclose(
        electrostatic_potential(finer, point[None]),
        total / np.sqrt(22),
        rtol=1e-3,
    )


def test_potential_stays_finite_on_a_vertex(sphere):
    value = electrostatic_potential(sphere, sphere.vertices[:1])
    assert_allclose(value, np.sqrt(4 * np.pi), rtol=2e-3)


def test_attributes_do_not_change_with_scale_or_place(box, points):
    names = ("depth", "electrostatic_potential", "surface_direction")
    moved = Mesh(
        box.vertices * 7 + [100.0, 0, 5],
        box.faces,
    )
    here, there = (
        interior_attributes(m, p, names)
        for m, p in ((box, points), (moved, points * 7 + [100.0, 0, 5]))
    )
    for name in names:
        assert_allclose(here[name], there[name], rtol=1e-5, atol=1e-6)
        assert here[name].dtype == np.float32


@pytest.mark.parametrize("names", [("height",), ("depth", "depth")])
def test_unknown_or_repeated_names_are_refused(names):
    with pytest.raises(
        ValueError, match="attributes: expected distinct names among depth, electrostatic_potential"
    ):
        SignatureConfig(attributes=names)

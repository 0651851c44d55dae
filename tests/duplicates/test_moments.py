"""Moments against closed forms, and how far apart they tell surfaces to be at least against known moves."""

from itertools import product

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from igps.duplicates._moments import distance_bounds, moments

Array = NDArray[np.float64]
MOST = 0.002


def of(body, scale=1.0):
    return moments(
        scale * body.vertices / body.area**0.5,
        np.asarray(body.faces),
        MOST,
    )


def apart(one, other, scale=1.0):
    some, others = (torch.from_numpy(found)[None] for found in (of(one), of(other, scale)))
    return float(distance_bounds(some, others))


def lump(stretch, bumps=0.0, subdivisions=3):
    """An ellipsoid; with bumps, without any symmetry."""
    body = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = body.vertices.T
    body.vertices *= (1 + bumps * (np.sin(2 * x + 1) + np.cos(3 * y) + z * x))[:, None] * stretch
    return body


def test_moments_of_a_box_are_its_closed_forms():
    sides = np.array([1.0, 2.0, 3.0])
    area = 22.0
    body = trimesh.creation.box(sides)
    body.apply_transform(trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.9])))
    body.apply_translation([3.0, -2.0, 1.0])
    volume, (a, b, c) = 6.0, sides**2
    fourth = volume * ((a * a + b * b + c * c) / 80 + (a * b + b * c + a * c) / 72)
    second = volume * sides**2 / 12
    expected = np.log(
        [
            volume / area**1.5,
            *(second / area**2.5),
            fourth / area**3.5,
        ]
    )
    found = of(body)[0]
    np.testing.assert_allclose(
        found,
        [*expected, 0.0],
        rtol=1e-9,
        atol=1e-5,
    )


def test_a_motion_a_mirror_image_and_other_triangles_leave_nothing():
    body = lump((1.0, 0.7, 0.4), 0.1)
    turn = -Rotation.random(random_state=1).as_matrix()
    again = trimesh.Trimesh(
        7 * body.vertices @ turn.T + 5.0, body.faces[:, ::-1], process=False
    ).subdivide()
    assert apart(body, again) < 1e-7


@pytest.mark.parametrize(
    ("stretch", "bumps"),
    [
        ((1.0, 1.0, 1.0), 0.0),
        ((1.0, 1.0, 0.4), 0.1),
        ((3.0, 0.8, 0.5), 0.1),
    ],
)
def test_the_lower_bound_does_not_exceed_the_displacement(stretch, bumps):
    """Normal displacements by polynomials, scaled to a known root mean square; bodies with and without symmetry."""
    body = lump(stretch, bumps)
    normals = np.asarray(body.vertex_normals)
    weights = np.bincount(
        body.faces.ravel(),
        np.repeat(body.area_faces, 3),
    )
    places = body.vertices / np.abs(body.vertices).max(axis=0)
    told = []
    for powers in product(range(4), repeat=3):
        if sum(powers) <= 4:
            move = np.prod(places**powers, axis=1)
            move *= MOST / np.sqrt(np.average(move**2, weights=weights))
            vertices = body.vertices + body.area**0.5 * move[:, None] * normals
            moved = trimesh.Trimesh(vertices, body.faces, process=False)
            told.append(apart(body, moved, (moved.area / body.area) ** 0.5) / MOST)
    assert max(told) < 1.1
    assert max(told) > 0.6


def test_a_scale_by_a_tenth_counts_as_much_as_the_most():
    body = lump((1.0, 0.7, 0.4), 0.1)
    assert apart(body, body, 1.1) == pytest.approx(MOST, rel=0.01)


def test_a_hole_is_closed_by_a_cone_whatever_the_triangles():
    """Three sides of a box are a corner; with its cones it is half of the box, and no other corner's."""
    corner = trimesh.creation.box((1.0, 0.8, 0.6)).subdivide()
    corner.update_faces((corner.face_normals > 0.5).any(axis=1))
    corner.remove_unreferenced_vertices()
    finer = corner.subdivide().subdivide()
    finer.apply_translation([3.0, -1.0, 2.0])
    assert apart(corner, finer) < 1e-7
    other = corner.copy()
    other.vertices *= [1.2, 1.0, 1.0]
    assert apart(corner, other) > 2 * MOST

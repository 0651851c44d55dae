"""The watertight surface against closed forms: where it lies, what it fills, and what it leaves open."""

import re
from collections import Counter

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from tests.mesh.damages import DAMAGES
from trimesh.creation import box, cylinder, torus

from igps.mesh.errors import MeshError
from igps.mesh.mending import mend
from igps.mesh.mesh import Mesh
from igps.mesh.watertight import watertight
from igps.mesh.winding import winding_number
from igps.shapes import ArticulatedShapes

Surface = tuple[NDArray[np.float64], NDArray[np.int64]]
BALL = 4 / 3 * np.pi


def arrays(*parts):
    whole = trimesh.util.concatenate(parts)
    return np.asarray(
        whole.vertices,
        dtype=np.float64,
    ), np.asarray(whole.faces, dtype=np.int64)


def ball(radius=1.0, centre=(0, 0, 0), subdivisions=3):
    surface = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    surface.apply_translation(centre)
    return surface


def cut_ball(height):
    """The unit sphere without its cap above `height`."""
    surface = ball(subdivisions=4)
    below = surface.triangles_center[:, 2] < height
    return np.asarray(surface.vertices), np.asarray(surface.faces)[below]


def turned_profile(profile):
    """A surface of revolution about z."""
    surface = trimesh.creation.revolve(np.array(profile), sections=64)
    return np.asarray(surface.vertices), np.asarray(surface.faces)


def is_inside(mesh, *points):
    return (winding_number(mesh.vertices, mesh.faces, np.array(points, dtype=float)) > 0.5).tolist()


def assert_closed(mesh):
    """Every edge is run through once in each direction, counted one by one."""
    seen = Counter((int(f[i]), int(f[i - 1])) for f in mesh.faces for i in range(3))
    assert set(seen.values()) == {1}
    for a, b in seen:
        assert (b, a) in seen


def test_ball_of_loose_turned_triangles():
    vertices, faces = arrays(ball(subdivisions=4))
    generator = default_rng(0)
    soup = vertices[generator.permutation(faces)].reshape(-1, 3)
    loose = np.arange(len(soup)).reshape(-1, 3)
    turned = generator.random(len(loose)) < 1 / 3
    loose[turned] = loose[turned, ::-1]
    body = watertight(soup, loose)
    assert_closed(body)
    radius = norm(body.vertices, axis=1)
    cell = 2 / 96
    assert np.abs(radius - 1).max() < cell / 2
    assert body.volume == pytest.approx(BALL, rel=0.01)
    assert body.area == pytest.approx(4 * np.pi, rel=0.01)
    assert len(body.vertices) <= 5000


@pytest.mark.parametrize(
    "solid",
    [
        box((1, 0.9, 0.8)),
        box((1, 1, 0.05)),
        cylinder(0.05, 1, sections=64),
    ],
    ids=["block", "thin plate", "rod"],
)
def test_the_volume_is_kept_by_the_grid_and_by_the_simplification(solid):
    body = watertight(*arrays(solid))
    assert len(body.vertices) <= 5000
    assert body.volume == pytest.approx(solid.volume, rel=3.5e-3)
    # Edges and corners are rounded.
    assert body.area == pytest.approx(solid.area, rel=0.02)
    assert np.abs(np.ptp(body.vertices, axis=0) - solid.extents).max() < solid.extents.max() / 96


def test_a_hole_is_closed_and_a_cup_stays_open():
    holed = watertight(*cut_ball(0.9), resolution=64)
    assert holed.volume == pytest.approx(BALL, rel=0.02)
    assert any("opening" in note for note in holed.notes)
    cup = watertight(*cut_ball(0.3), resolution=64)
    assert_closed(cup)
    found = is_inside(
        cup,
        (0, 0, 0),
        (0, 0, -0.9),
        (0, 0, -1),
    )
    assert found == [False, False, True]
    # A sheet of about a cell.
    cell = 2 / 64
    assert 0.7 * cell < cup.volume / (2 * np.pi * 1.3) < 1.5 * cell


def test_a_missing_base_is_no_leak_beyond_the_bounding_box():
    surface = box((1, 1, 4)).subdivide_to_size(0.2)
    faces = np.asarray(surface.faces)[surface.triangles_center[:, 2] > -1.99]
    body = watertight(np.asarray(surface.vertices), faces, resolution=64)
    assert_closed(body)
    assert body.volume == pytest.approx(4, rel=0.03)
    assert np.ptp(body.vertices[:, 2]) == pytest.approx(4, abs=0.05)


def test_the_neck_of_a_bottle_is_closed_unless_its_wall_has_two_sides():
    outer = [
        (0.0, 0.0),
        (1.0, 0.0),
        (1.0, 1.5),
        (0.2, 1.8),
        (0.2, 2.2),
    ]
    found = is_inside(
        watertight(*turned_profile(outer), resolution=48),
        (0, 0, 0.8),
    )
    assert found == [True]
    inner = [
        (0.14, 2.2),
        (0.14, 1.75),
        (0.94, 1.45),
        (0.94, 0.06),
        (0.0, 0.06),
    ]
    vase = watertight(*turned_profile(outer + inner), resolution=64)
    assert is_inside(vase, (0, 0, 0.8), (0, 0, 2.0)) == [False, False]
    found = is_inside(
        vase,
        (0, 0, 0.03),
        (0.97, 0, 0.8),
    )
    assert found == [True, True]


def test_what_is_hidden_is_filled():
    body = watertight(
        *arrays(
            ball(),
            ball(0.3, (0.2, 0, 0)),
            box((0.5, 0.4, 0.3)),
        ),
        resolution=64,
    )
    alone = watertight(*arrays(ball()), resolution=64)
    assert body.volume == pytest.approx(alone.volume, rel=1e-4)
    assert norm(body.vertices, axis=1).min() > 0.98


def test_overlapping_parts_are_one():
    first = box((1, 1, 1))
    second = box((1, 1, 1))
    second.apply_translation([0.6, 0.3, 0.2])
    body = watertight(*arrays(first, second))
    assert_closed(body)
    assert body.volume == pytest.approx(2 - 0.4 * 0.7 * 0.8, rel=0.01)


@pytest.mark.parametrize(
    "turned",
    [(False, True), (True, True)],
)
def test_parts_are_turned_outward_by_their_winding_numbers(turned):
    # Two rings: the far sides of each face its middle, so that no simple rule tells their outside.
    rings = [torus(10.0, 1.0, major_sections=48, minor_sections=16) for _ in range(2)]
    rings[1].apply_transform(
        trimesh.transformations.rotation_matrix(
            1.2,
            [1, 0, 0],
        )
    )
    for ring, inverted in zip(rings, turned, strict=True):
        if inverted:
            ring.invert()
    vertices, faces = arrays(*rings)
    # A fortieth of the faces is missing from one place.
    away = norm(
        vertices[faces].mean(axis=1) - [10, 0, 0],
        axis=1,
    )
    body = watertight(
        vertices,
        faces[np.argsort(away)[len(faces) // 40 :]],
        resolution=64,
    )
    inside = (-10, 0, 0), (0, 10, 0), (0, 10 * np.cos(1.2), 10 * np.sin(1.2))
    assert is_inside(body, *inside) == [True] * 3
    assert is_inside(body, (0, 0, 0), (0, 0, 9)) == [False] * 2


@pytest.mark.parametrize("number", [6, 7])
def test_a_thin_body_of_overlapping_halves_with_holes_is_solid(number):
    shape = ArticulatedShapes(number + 1, 1, seed=11, n_vertices=3500)[number]
    body = Mesh(shape.vertices, shape.faces)
    mended = mend(*DAMAGES["everything"].apply(body, 0))
    assert_closed(mended)
    assert mended.volume == pytest.approx(body.volume, rel=0.03)
    assert mended.area == pytest.approx(body.area, rel=0.03)


def test_parts_that_share_an_edge_are_one():
    vertices = np.array(
        [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)],
        dtype=float,
    )
    faces = np.asarray(trimesh.Trimesh(vertices).convex_hull.faces)
    hull = np.asarray(trimesh.Trimesh(vertices).convex_hull.vertices)
    pair = np.vstack([hull, hull + np.array([1, 1, 0])])
    body = watertight(
        pair,
        np.vstack([faces, faces + len(hull)]),
    )
    assert_closed(body)
    assert body.volume == pytest.approx(2, rel=0.02)


def test_a_wall_inside_that_lies_on_points_of_the_grid_is_filled():
    left = box((1, 1, 1)).subdivide().subdivide()
    # Whose squares in the wall are cut along the other diagonal
    right = left.copy().apply_translation([1, 0, 0])
    mesh = watertight(*arrays(left, right))
    assert mesh.genus == 0
    assert mesh.area == pytest.approx(10, rel=0.03)
    assert mesh.volume == pytest.approx(2, rel=0.01)


def test_a_sheet_gets_about_a_cell():
    x, y = (
        values.ravel()
        for values in np.meshgrid(
            np.linspace(0, 1, 5),
            np.linspace(0, 1, 5),
        )
    )
    vertices = np.stack([x, y, np.zeros_like(x)], axis=1)
    start = np.array([5 * i + j for i in range(4) for j in range(4)])
    faces = np.vstack(
        [
            np.stack([start, start + 1, start + 6], 1),
            np.stack([start, start + 6, start + 5], 1),
        ]
    )
    body = watertight(vertices, faces, resolution=48)
    assert_closed(body)
    thickness = np.ptp(body.vertices[:, 2])
    assert 0.9 / (2 * 48) < thickness < 1.5 / (0.8 * 48)


def test_pieces_are_joined_and_specks_dropped():
    apart = watertight(
        *arrays(ball(), ball(0.7, (2.5, 0, 0))),
        resolution=64,
    )
    assert_closed(apart)
    assert apart.volume == pytest.approx(BALL * (1 + 0.7**3), rel=0.03)
    assert any("joined 2 pieces" in note for note in apart.notes)
    speck = watertight(
        *arrays(ball(), ball(0.01, (5, 5, 5))),
        resolution=48,
    )
    alone = watertight(*arrays(ball()), resolution=48)
    assert_array_equal(speck.vertices, alone.vertices)


def test_wires_stay_in_one_piece():
    t = np.linspace(0, 4 * np.pi, 200)
    path = np.stack(
        [np.cos(t), np.sin(t), t / 6],
        axis=1,
    )
    strip = np.vstack([path, path + np.array([0, 0, 1e-3])])
    i = np.arange(199)
    faces = np.vstack(
        [
            np.stack([i, i + 1, i + 200], 1),
            np.stack([i + 1, i + 201, i + 200], 1),
        ]
    )
    body = watertight(strip, faces)
    assert_closed(body)
    assert_allclose(np.ptp(body.vertices, axis=0), np.ptp(strip, axis=0), atol=0.08)


@pytest.mark.parametrize("with_normals", [True, False])
def test_point_clouds(with_normals):
    points = default_rng(0).standard_normal((6000, 3))
    points /= norm(points, axis=1, keepdims=True)
    body = watertight(points, normals=points if with_normals else None, resolution=64)
    assert_closed(body)
    assert body.volume == pytest.approx(BALL, rel=0.03)


def test_flat_places_have_a_delaunay_triangulation():
    body = watertight(
        *arrays(box((1, 1, 0.6))),
        resolution=48,
        max_vertices=500,
    )
    assert_closed(body)
    opposite = {}
    for face in body.faces.tolist():
        for i in range(3):
            corner = face[i - 1]
            u, v = (body.vertices[face[k]] - body.vertices[corner] for k in (i, (i + 1) % 3))
            cosine = u @ v / norm(u) / norm(v)
            opposite[face[i], face[(i + 1) % 3]] = np.arccos(np.clip(cosine, -1, 1))
    sums = np.array([angle + opposite[b, a] for (a, b), angle in opposite.items()])
    # All but a few along the box's edges, where the surface bends.
    assert (sums > np.pi + 2e-3).mean() < 0.02
    assert sums.max() < 2 * np.pi - 1e-3


def test_follows_the_surface_when_it_is_moved_and_scaled():
    vertices, faces = arrays(torus(1.0, 0.3))
    body = watertight(vertices, faces, resolution=64)
    moved = watertight(
        vertices * 8 + [16, -32, 64],
        faces,
        resolution=64,
    )
    assert_allclose(moved.vertices, body.vertices * 8 + [16, -32, 64], atol=8 * 0.02)
    assert body.volume == pytest.approx(2 * np.pi**2 * 0.09, rel=0.03)
    euler = len(body.vertices) - len(body.faces) // 2
    assert euler == 0


def test_inputs_stay_as_they_are():
    vertices, faces = arrays(ball())
    before = vertices.copy(), faces.copy()
    watertight(vertices, faces, resolution=24)
    assert_array_equal(vertices, before[0])
    assert_array_equal(faces, before[1])


def test_what_is_no_surface_is_refused():
    with pytest.raises(
        MeshError, match=r"line\.obj: expected a surface, but no triangle has an area"
    ):
        watertight(
            np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), np.array([[0, 1, 2]]), name="line.obj"
        )
    with pytest.raises(
        MeshError, match=r"five\.xyz: expected at least 10 points for a surface, got 5"
    ):
        watertight(default_rng(0).random((5, 3)), name="five.xyz")
    with pytest.raises(MeshError, match="finite"):
        watertight(
            np.full((3, 3), np.nan),
            np.array([[0, 1, 2]]),
        )
    with pytest.raises(ValueError, match="resolution"):
        watertight(*arrays(ball()), resolution=2)


def chain(n, gap):
    """Unit balls in a row."""
    return arrays(
        *(
            ball(
                centre=(gap * i, 0, 0),
                subdivisions=2,
            )
            for i in range(n)
        )
    )


@pytest.mark.parametrize("gap", [1.9, 2.1])
def test_a_chain_of_beads_gets_a_grid_as_fine_as_its_beads_ask_for(gap):
    """Beads that overlap, and beads that do not touch and are joined."""
    body = watertight(*chain(60, gap))
    hidden = max(1 - gap / 2, 0)  # of the area, by the caps inside of other beads
    assert_closed(body)
    bead = ball(subdivisions=2)
    assert body.volume == pytest.approx(60 * bead.volume, rel=0.015)
    expected = pytest.approx(
        60 * bead.area * (1 - hidden),
        rel=0.05,
    )
    assert body.area == expected
    # Between beads it is thin again.
    near = np.abs(body.vertices[:, 0] - 30.5 * gap) < 0.1
    assert norm(body.vertices[near, 1:], axis=1).max() < 0.6
    for note in body.notes:
        assert "coarse" not in note


def test_a_long_rod_is_as_thick_as_it_was():
    rod = cylinder(0.005, 1, sections=32)
    body = watertight(*arrays(rod))
    assert body.volume == pytest.approx(rod.volume, rel=0.03)
    assert body.area == pytest.approx(rod.area, rel=0.03)


def test_a_note_tells_that_the_grid_is_too_coarse():
    """Thin rods in all directions, for which the grid cannot be refined enough."""
    rods = [cylinder(0.004, 1, sections=12) for _ in range(12)]
    generator = default_rng(0)
    for rod in rods:
        rod.apply_transform(trimesh.transformations.random_rotation_matrix(generator.random(3)))
    body = watertight(*arrays(*rods), resolution=32)
    assert any(re.match(r"coarse: about [01]\.\d cells thick", note) for note in body.notes)

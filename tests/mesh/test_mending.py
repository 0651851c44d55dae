"""The ladder of mending: each step where it is needed, none where it is not, and the body that comes of it."""

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from scipy.spatial import cKDTree
from tests.mesh.damages import DAMAGES, halves, holes
from trimesh.creation import icosphere

from conftest import tube
from igps.mesh.errors import MeshError
from igps.mesh.loading import refined
from igps.mesh.mending import mend, repair_steps
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.simplification import subdivide
from igps.mesh.surface import area_vectors
from igps.mesh.watertight import watertight


def box():
    surface = trimesh.creation.box((1, 2, 3))
    return Mesh(
        np.asarray(surface.vertices),
        np.asarray(surface.faces),
        name="box",
    )


def area(vertices, faces):
    return float(norm(area_vectors(vertices, faces), axis=1).sum())


def same_surface(a, b):
    """The same triangles, whatever their order and the numbers of their corners."""

    def canonical(mesh):
        corners = np.round(mesh.vertices, 5)[mesh.faces]
        first = np.lexsort(corners.reshape(-1, 3).T[::-1])
        rank = np.empty(len(first), dtype=int)
        rank[first] = np.arange(len(first))
        start = rank.reshape(-1, 3).argmin(axis=1)
        order = (start[:, None] + np.arange(3)) % 3
        turned = np.take_along_axis(corners, order[:, :, None], axis=1).reshape(-1, 9)
        return turned[np.lexsort(turned.T[::-1])]

    return len(a.faces) == len(b.faces) and bool(
        np.allclose(
            canonical(a),
            canonical(b),
            atol=2e-5,
        )
    )


def test_a_body_is_left_as_it_is(blob):
    mesh = mend(blob.vertices, blob.faces)
    assert_array_equal(mesh.vertices, blob.vertices)
    assert_array_equal(mesh.faces, blob.faces)
    assert mesh.notes == ()
    assert repair_steps(mesh.notes) == ()


@pytest.mark.parametrize("name", ["soup", "turned", "fins", "parts"])
def test_welding_and_dropping_gives_the_very_surface(blob, name):
    mesh = mend(*DAMAGES[name].apply(blob, 3))
    assert repair_steps(mesh.notes) == ("welded",)
    assert same_surface(mesh, blob)


def test_holes_are_filled_where_the_surface_was(sphere):
    mesh = mend(*holes(sphere, seed=1))
    assert repair_steps(mesh.notes) == ("filled",)
    assert mesh.notes == ("filled 3 small holes",)
    # The old vertices stay, and the new ones go on like the sphere.
    assert np.abs(norm(mesh.vertices, axis=1) - 1).max() < 0.01
    assert mesh.volume == pytest.approx(sphere.volume, rel=2e-3)
    sides = mesh.vertices[mesh.faces]
    length = norm(
        sides - np.roll(sides, 1, axis=1),
        axis=2,
    )
    assert length.max() < 3 * np.median(length)


def test_holes_that_touch_are_filled_one_by_one(sphere):
    """Rims that meet in a vertex are taken apart."""
    kept = np.ones(len(sphere.faces), dtype=bool)
    kept[default_rng(0).choice(len(kept), len(kept) // 20, replace=False)] = False
    mesh = mend(sphere.vertices, sphere.faces[kept])
    assert repair_steps(mesh.notes) == ("filled",)
    assert mesh.volume == pytest.approx(sphere.volume, rel=2e-3)


def test_a_patch_has_as_many_vertices_as_its_rim_asks_for(sphere):
    """Those of a disc of radius r = n / 2π steps that are one step apart: about π r² = n² / 4π."""
    away = norm(sphere.vertices - sphere.vertices[0], axis=1)
    kept = sphere.faces[(away[sphere.faces] > 0.11 * np.ptp(sphere.vertices)).all(axis=1)]
    sides = np.sort(
        kept[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2),
        axis=1,
    )
    _, counts = np.unique(sides, axis=0, return_counts=True)
    n = int((counts == 1).sum())
    assert n > 15
    mesh = mend(sphere.vertices, kept)
    added = len(mesh.vertices) - len(np.unique(kept))
    assert added == pytest.approx(n**2 / (4 * np.pi), rel=0.35)


def test_halves_that_overlap_are_the_body_again(blob):
    mesh = mend(*halves(blob))
    assert repair_steps(mesh.notes) == ("united",)
    assert mesh.volume == pytest.approx(blob.volume, rel=1e-9)
    assert mesh.area == pytest.approx(blob.area, rel=1e-9)


def test_a_cup_is_not_filled():
    surface = icosphere(subdivisions=3)
    open_faces = np.asarray(surface.faces)[surface.triangles_center[:, 2] < 0.2]
    mesh = mend(np.asarray(surface.vertices), open_faces)
    # The cap's vertices were left unused.
    assert repair_steps(mesh.notes) == ("welded", "watertight")
    assert mesh.volume < 0.1 * surface.volume


def test_a_part_that_sticks_out_is_not_hidden():
    surface = icosphere(subdivisions=3)
    knob = icosphere(subdivisions=2, radius=0.3)
    knob.apply_translation([1, 0, 0])
    whole = trimesh.util.concatenate([surface, knob])
    mesh = mend(
        np.asarray(whole.vertices),
        np.asarray(whole.faces),
    )
    assert repair_steps(mesh.notes) == ("united",)
    assert mesh.vertices[:, 0].max() == pytest.approx(1.3, abs=1e-9)


def test_too_few_vertices_are_more_on_the_same_surface():
    mesh = refined(box(), LoadOptions(), 52)
    assert repair_steps(mesh.notes) == ("subdivided",)
    assert len(mesh.vertices) >= 52
    assert mesh.volume == pytest.approx(6, rel=1e-12)
    assert mesh.area == pytest.approx(22, rel=1e-12)
    # All on the surface of the box.
    assert np.isclose(np.abs(mesh.vertices), [0.5, 1, 1.5]).any(axis=1).all()
    assert_array_equal(mesh.vertices[:8], box().vertices)


@pytest.mark.parametrize("n_vertices", [9, 333])
def test_longest_edges_are_cut_first(n_vertices):
    mesh = subdivide(box(), n_vertices)
    assert len(mesh.vertices) == n_vertices
    sides = mesh.vertices[mesh.faces]
    length = norm(
        sides - np.roll(sides, 1, axis=1),
        axis=2,
    )
    if n_vertices > 50:
        assert length.max() < 4.5 * np.sqrt(22 / n_vertices)
    assert (norm(area_vectors(mesh.vertices, mesh.faces), axis=1) > 1e-6).all()


def test_never_refuses_and_always_makes_watertight(blob):
    vertices, faces = holes(blob)
    with pytest.raises(MeshError, match="open surface"):
        mend(vertices, faces, how="never")
    mesh = mend(vertices, faces, how="always")
    assert repair_steps(mesh.notes) == ("watertight",)
    assert mesh.volume == pytest.approx(blob.volume, rel=0.01)
    with pytest.raises(ValueError, match="how"):
        mend(vertices, faces, how="sometimes")


def test_always_leaves_the_boundary_of_one_body_as_it_is(blob):
    mesh = mend(blob.vertices, blob.faces, how="always")
    assert mesh.notes == ()
    assert_array_equal(mesh.vertices, blob.vertices)
    assert_array_equal(mesh.faces, blob.faces)


def test_close_turns_of_a_coil_stay_apart():
    """Two turns of a coil, half a cell from each other: a grid joins them."""
    near = coil(turns=2.2, pitch=0.41)
    assert watertight(near.vertices, near.faces).area < 0.97 * near.area
    for vertices, faces in ((near.vertices, near.faces), DAMAGES["soup"].apply(near, 0)):
        mesh = mend(vertices, faces, how="always")
        assert "watertight" not in repair_steps(mesh.notes)
        assert mesh.area == pytest.approx(near.area, rel=1e-6)


def test_a_closed_surface_that_crosses_itself_passes_and_is_always_made_watertight():
    """A coil with less room than it is thick; the union of its balls is the oracle for the volume."""
    crossing = coil(turns=2.2, pitch=0.3)
    assert mend(crossing.vertices, crossing.faces).notes == ()
    mesh = mend(crossing.vertices, crossing.faces, how="always")
    assert repair_steps(mesh.notes) == ("watertight",)
    points = default_rng(0).uniform(
        mesh.vertices.min(axis=0), mesh.vertices.max(axis=0), (100_000, 3)
    )
    turn = np.linspace(0, 2.2, 3000)
    middles = np.stack(
        [np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn), 0.3 * turn],
        axis=1,
    )
    away, nearest = cKDTree(middles).query(points)
    # Without the half balls beyond the flat ends; the radius is that of a circle of the polygon's area.
    radius = 0.2 * np.sqrt(8 / np.pi * np.sin(np.pi / 8))
    inside = (away < radius) & (nearest > 0) & (nearest < len(middles) - 1)
    volume = inside.mean() * np.prod(np.ptp(mesh.vertices, axis=0))
    assert mesh.volume == pytest.approx(volume, rel=0.02)
    assert mesh.volume < 0.95 * crossing.volume


def coil(turns, pitch, radius=0.2):
    """A tube around a helix of radius 1, with flat ends."""
    angle = 2 * np.pi * np.linspace(0, turns, round(90 * turns))[:, None]
    outward = np.hstack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    middles = outward + [0, 0, pitch / (2 * np.pi)] * angle
    along = np.hstack([-np.sin(angle), np.cos(angle), np.full_like(angle, pitch / (2 * np.pi))])
    upward = np.cross(outward, along / norm(along, axis=1, keepdims=True))
    phase = np.linspace(0, 2 * np.pi, 16, endpoint=False)[:, None]
    rings = np.cos(phase) * outward[:, None] + np.sin(phase) * upward[:, None]
    return tube(middles[:, None] + radius * rings, middles[[0, -1]])


def test_a_vertex_that_no_face_uses_does_not_weld_the_others(blob):
    mesh = mend(
        np.vstack(
            [
                blob.vertices[:9],
                [[1e9, 0, 0]],
                blob.vertices[9:],
            ]
        ),
        blob.faces + (blob.faces >= 9),
    )
    assert same_surface(mesh, blob)
    assert mesh.notes == ("dropped 1 unreferenced vertex",)


@pytest.mark.parametrize("share", [0.02, 0.5])
def test_corners_that_differ_in_the_last_digit_of_single_precision_are_one(blob, share):
    generator = default_rng(0)
    corners = blob.vertices[blob.faces].reshape(-1, 3).astype(np.float32)
    moved = np.nextafter(
        corners,
        generator.choice(np.float32([-9, 9]), corners.shape),
    )
    corners = np.where(
        generator.random(corners.shape) < share,
        moved,
        corners,
    )
    mesh = mend(
        corners.astype(np.float64),
        np.arange(len(corners)).reshape(-1, 3),
    )
    assert repair_steps(mesh.notes) == ("welded",)
    assert len(mesh.vertices) == len(blob.vertices)
    assert mesh.area == pytest.approx(blob.area, rel=1e-5)


UNUSABLE = {
    "empty": (lambda: (np.zeros((0, 3)), np.zeros((0, 3), dtype=int)), "is empty"),
    "triangle": (lambda: (np.eye(3), np.array([[0, 1, 2]])), "a single triangle"),
    "line": (
        lambda: (np.outer(np.arange(4.0), [1, 2, 3]), np.array([[0, 1, 2], [1, 2, 3]])),
        "no triangle has an area",
    ),
    "point": (lambda: (np.ones((4, 3)), np.array([[0, 1, 2], [1, 2, 3]])), "in one point"),
    "five": (
        lambda: (default_rng(0).random((5, 3)), None),
        "expected at least 10 points for a surface, got 5",
    ),
    "line of points": (
        lambda: (np.outer(np.linspace(0, 1, 30), [1, 2, 3]).astype(np.float32) + 5, None),
        "all 30 points lie on one line",
    ),
    "huge": (
        lambda: (1e200 * np.eye(3)[[0, 1, 2, 0]], np.array([[0, 1, 2], [1, 2, 3]])),
        "from 1e-30 to 1e\\+30",
    ),
    "tiny": (
        lambda: (1e-200 * np.eye(3)[[0, 1, 2, 0]], np.array([[0, 1, 2], [1, 2, 3]])),
        "from 1e-30 to 1e\\+30",
    ),
    "tiny cloud": (
        lambda: (1e-200 * default_rng(0).random((400, 3)), None),
        "from 1e-30 to 1e\\+30",
    ),
    "nan": (lambda: (np.full((4, 3), np.nan), np.array([[0, 1, 2], [1, 2, 3]])), "NaN"),
    "nan cloud": (lambda: (np.full((40, 3), np.nan), None), "NaN"),
    "out of range": (lambda: (np.eye(3), np.array([[0, 1, 9], [0, 1, 2]])), "out of range"),
}


@pytest.mark.parametrize("case", sorted(UNUSABLE))
@pytest.mark.parametrize("how", ["auto", "always"])
def test_what_cannot_be_mended_is_named(case, how):
    make, words = UNUSABLE[case]
    vertices, faces = make()
    with pytest.raises(MeshError, match=words) as error:
        mend(vertices, faces, how=how, name="some/file.obj")
    assert str(error.value).startswith("some/file.obj: ")

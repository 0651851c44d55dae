"""Voxelised closed forms give back volume and area, whatever the spacing and the orientation of the voxels."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import elliprg

from igps.fields.volumes.label_surface import voxel_surface
from igps.fields.volumes.label_volume import LabelVolume, label_bodies
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.surface import components, largest, signed_volume


class Solid(NamedTuple):
    """A body about the origin: which points (..., 3) it holds, half its box, its volume, area and handles."""

    holds: Callable
    half: np.ndarray
    volume: float
    area: float
    genus: int = 0


def ellipsoid(r):
    axes = r * np.array([1, 1.3, 2])
    a, b, c = axes
    area = 4 * np.pi * elliprg((a * b) ** 2, (a * c) ** 2, (b * c) ** 2)
    volume = 4 / 3 * np.pi * axes.prod()
    return Solid(
        lambda p: ((p / axes) ** 2).sum(-1) < 1,
        axes,
        volume,
        area,
    )


def torus(r):
    ring = 2.5 * r

    def holds(p):
        return (np.hypot(p[..., 0], p[..., 1]) - ring) ** 2 + p[..., 2] ** 2 < r**2

    half = np.array([ring + r, ring + r, r])
    return Solid(
        holds,
        half,
        2 * np.pi**2 * ring * r**2,
        4 * np.pi**2 * ring * r,
        1,
    )


def capsule(r):
    def holds(p):
        beyond = np.maximum(abs(p[..., 2]) - 2 * r, 0)
        return p[..., 0] ** 2 + p[..., 1] ** 2 + beyond**2 < r**2

    volume = (4 + 4 / 3) * np.pi * r**3
    return Solid(
        holds,
        np.array([r, r, 3 * r]),
        volume,
        (8 + 4) * np.pi * r**2,
    )


def rod(r):
    def holds(p):
        return (np.hypot(p[..., 0], p[..., 1]) < r) & (abs(p[..., 2]) < 4 * r)

    return Solid(
        holds,
        np.array([r, r, 4 * r]),
        8 * np.pi * r**3,
        18 * np.pi * r**2,
    )


def plate(r):
    half = r * np.array([3, 4, 1])
    a, b, c = half
    area = 8 * (a * b + b * c + a * c)
    return Solid(
        lambda p: (abs(p) < half).all(-1),
        half,
        8 * a * b * c,
        area,
    )


def ball(r):
    volume = 4 / 3 * np.pi * r**3
    return Solid(
        lambda p: (p**2).sum(-1) < r**2,
        np.full(3, r),
        volume,
        4 * np.pi * r**2,
    )


def voxels(body, matrix, rng):
    """The body, turned and moved at random, at the centres of voxels: (X, Y, Z), and the affine (4, 4)."""
    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    size = norm(body.half)
    reach = np.ceil(norm(np.linalg.inv(matrix), axis=1) * size).astype(int) + 1
    index = np.stack(
        np.meshgrid(*(np.arange(2 * n + 1) for n in reach), indexing="ij"),
        axis=-1,
    )
    affine = np.eye(4)
    affine[:3, :3] = matrix
    affine[:3, 3] = -matrix @ (reach + rng.uniform(-0.5, 0.5, 3))
    mask = body.holds((index @ matrix.T + affine[:3, 3]) @ turn)
    affine[:3, 3] += (100, -50, 20)
    return mask, affine


def errors(body, matrix, rng):
    mask, affine = voxels(body, matrix, rng)
    vertices, faces, _ = voxel_surface(mask, affine)
    mesh = Mesh(vertices, faces)  # closed, manifold, oriented, of one piece
    assert mesh.notes == ()  # and not inside out
    assert mesh.genus == body.genus
    centre = np.mean(
        [vertices.min(axis=0), vertices.max(axis=0)],
        axis=0,
    )
    assert_allclose(centre, (100, -50, 20), atol=np.abs(matrix).max())
    return abs(mesh.volume / body.volume - 1), abs(mesh.area / body.area - 1)


@pytest.mark.parametrize("length", [1, 2.5, 6])
@pytest.mark.parametrize(
    ("n_voxels", "most"),
    [(9, (0.01, 0.02)), (4, (0.05, 0.08))],
)
def test_voxelised_bodies_give_back_volume_and_area(length, n_voxels, most):
    rng = default_rng([n_voxels, int(length)])
    matrix = 0.8 * np.diag(rng.permutation([1, 1, length]))
    radius = 0.4 * n_voxels * length
    solids = [kind(radius) for kind in (ellipsoid, torus, capsule, rod, plate)]
    found = [errors(body, matrix, rng) for body in solids]
    assert (np.median(found, axis=0) <= most).all()


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([-1.0, 1, 2]),
        np.array([[0, 1.0, 0], [0, 0, 3], [1, 0, 0]]),
        np.array([[1, 0.5, 0.2], [0, 1, -0.4], [0, 0, 1.5]]),
    ],
    ids=["left-handed", "axes turned", "sheared"],
)
def test_the_affine_is_honoured(matrix):
    volume, area = errors(ball(14), matrix, default_rng(1))
    assert volume < 0.01
    assert area < 0.02


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_unit_of_length_changes_nothing(unit):
    """Voxels of a nanometre and of a mouse's micro-CT in millimetres, and of a kilometre."""
    mask = voxels(torus(4.5), np.eye(3), default_rng(5))[0]
    vertices, faces, _ = voxel_surface(mask, np.diag([1, 1, 2, 1]))
    found, triangles, _ = voxel_surface(
        mask,
        unit * np.diag([1, 1, 2, 1 / unit]),
    )
    np.testing.assert_array_equal(triangles, faces)
    assert_allclose(found / unit, vertices, atol=1e-6)


def test_many_voxels_are_put_on_a_coarser_grid_and_nothing_is_lost_by_it():
    mask, affine = voxels(ball(60), np.eye(3), default_rng(2))
    vertices, faces, _ = voxel_surface(mask, affine, max_vertices=2000)
    mesh = Mesh(vertices, faces)
    assert len(mesh.vertices) <= 2000
    assert mesh.volume == pytest.approx(np.count_nonzero(mask), rel=1e-6)
    assert mesh.area == pytest.approx(4 * np.pi * 60**2, rel=0.01)
    radius = norm(
        mesh.vertices - (100, -50, 20),
        axis=1,
    )
    assert abs(radius - 60).max() < 0.5


def test_a_thin_ring_in_a_large_box_needs_little_memory_and_has_no_seams():
    """It is solved in blocks; as a whole it took 88 bytes a voxel, so that the vessels of a CT needed 10 GB."""
    tube, ring = 2.2, 100.0
    turn = Rotation.from_euler("xy", [40, 35], degrees=True).as_matrix()
    index = np.moveaxis(np.indices((211, 211, 211), dtype=np.float32), 0, -1) - 105
    x, y, z = np.moveaxis(
        (index + 0.3) @ turn.astype(np.float32),
        -1,
        0,
    )
    mask = (np.hypot(x, y) - ring) ** 2 + z**2 < tube**2
    del index, x, y, z
    tracemalloc.start()
    vertices, faces, _ = voxel_surface(mask)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    mesh = Mesh(vertices - 105 + 0.3, faces)
    box = np.prod([side.stop - side.start for side in ndimage.find_objects(mask.view(np.uint8))[0]])
    assert box > 2**22  # voxels, of which blocks are made
    assert peak < 36 * box
    assert mesh.genus == 1
    expected = pytest.approx(
        2 * np.pi**2 * ring * tube**2,
        rel=0.01,
    )
    assert mesh.volume == expected
    x, y, z = (mesh.vertices @ turn).T
    assert abs(np.hypot(np.hypot(x, y) - ring, z) - tube).max() < 0.6
    expected = pytest.approx(
        4 * np.pi**2 * ring * tube,
        rel=0.03,
    )
    assert mesh.area == expected


def test_a_ball_has_no_stairs():
    """Voxels leave the radius free within about half a side; steps of a mask scatter it by 0.29, 1 / √12."""
    random = default_rng(4)
    scatter = []
    for _ in range(6):
        mask, affine = voxels(ball(10), np.eye(3), random)
        vertices, _, _ = voxel_surface(mask, affine)
        scatter.append(norm(vertices - (100, -50, 20), axis=1).std())
    assert np.mean(scatter) < 0.06


def test_every_voxel_stays_on_its_side():
    import igl

    rng = default_rng(3)
    mask, affine = voxels(
        torus(2.5),
        np.diag([1, 1, 2.0]),
        rng,
    )
    vertices, faces, _ = voxel_surface(mask, affine)
    centres = np.argwhere(np.ones_like(mask)) @ affine[:3, :3].T + affine[:3, 3]
    held = igl.fast_winding_number(vertices, faces, centres) > 0.5
    assert np.count_nonzero(held != mask.ravel()) <= 0.001 * np.count_nonzero(mask)


@pytest.mark.parametrize(
    "direction",
    [(1, 0, 0), (1, 1, 1), (3, 2, 1)],
)
def test_a_rib_of_two_voxels_stays_one_body(direction):
    axis = np.array(direction) / norm(direction)
    points = np.stack(np.meshgrid(*3 * [np.arange(40.0)], indexing="ij"), axis=-1) - 19.6
    along = points @ axis
    mask = (norm(points - along[..., None] * axis, axis=-1) < 1) & (abs(along) < 16)
    mesh = Mesh(*voxel_surface(mask)[:2])
    assert mesh.genus == 0
    assert mesh.volume == pytest.approx(np.count_nonzero(mask), rel=0.05)
    assert np.ptp(mesh.vertices @ axis) == pytest.approx(32, abs=1.5)


def test_voxels_that_touch_at_a_corner_are_one_piece():
    mask = np.zeros((9, 9, 9), dtype=bool)
    mask[1:4, 1:4, 1:4] = mask[4:7, 4:7, 4:7] = True
    assert Mesh(*voxel_surface(mask)[:2]).genus == 0


def test_a_body_at_the_border_is_closed():
    mesh = Mesh(*voxel_surface(np.ones((12, 13, 14)))[:2])
    assert mesh.volume == pytest.approx(12 * 13 * 14, rel=1e-3)
    assert mesh.vertices.min() == pytest.approx(-0.5, abs=0.3)


def test_neighbours_that_touch_meet_in_the_middle_between_their_voxels():
    labels = np.zeros((24, 20, 20), dtype=int)
    labels[3:12, 3:17, 3:17] = 1
    labels[12:21, 3:17, 3:17] = 2
    one, two = (Mesh(*voxel_surface(labels == label)[:2]) for label in (1, 2))
    for mesh in (one, two):
        near = norm(mesh.vertices[:, 1:] - 9.5, axis=1) < 5
        at = mesh.vertices[near & (abs(mesh.vertices[:, 0] - 11.5) < 2), 0]
        assert len(at)
        assert_allclose(at, 11.5, atol=0.15)


def test_small_pieces_apart_are_dropped_and_large_ones_stay():
    mask = np.zeros((40, 20, 20), dtype=bool)
    mask[2:18, 2:18, 2:18] = mask[22:30, 2:18, 2:18] = mask[35:37, 5:7, 5:7] = True
    vertices, faces, notes = voxel_surface(mask)
    assert components(faces, len(vertices))[0] == 2
    assert notes == ("left out 1 small piece apart: 8 voxels, 8, 0.1% of the label",)
    assert Mesh(*largest(vertices, faces)).volume == pytest.approx(16**3, rel=0.01)


@pytest.mark.parametrize(
    ("more", "lost"), [(0, "100% of the voxels lie in 121"), (20, "94% of the voxels lie in 120")]
)
def test_a_label_that_is_mostly_small_pieces_is_refused(more, lost):
    """Many small lesions: dropping all of them, or all but one, would be wrong."""
    mask = np.zeros((54, 54, 36), dtype=np.uint8)
    mask[:5, :4, : 4 + more] = 1
    for corner in np.ndindex(5, 6, 4):
        x, y, z = 9 * np.array(corner) + (9, 0, 0)
        mask[x : x + 4, y : y + 4, z : z + 4] = 1
    words = rf"lesions: {lost} separate pieces, each below 2% .* --bodies pieces; or"
    with pytest.raises(MeshError, match=words):
        voxel_surface(mask, joins=True, name="lesions")
    pieces = label_bodies(
        LabelVolume((mask,), np.eye(4)),
        LoadOptions(bodies="pieces"),
    )
    assert len(pieces) == 121
    assert pieces[0].made().fault is None


def rod_across(angle, radius=6.0, length=30.0, n=52):
    """A capsule so many degrees off the third axis, in voxels of side 1."""
    axis = np.array(
        [
            np.sin(np.radians(angle)),
            0,
            np.cos(np.radians(angle)),
        ]
    )
    points = np.moveaxis(np.indices((n, n, n)), 0, -1) - (n - 1) / 2
    along = np.clip(points @ axis, -length / 2, length / 2)
    return np.asarray(
        norm(
            points - along[..., None] * axis,
            axis=-1,
        )
        < radius
    )


def test_pieces_that_face_each_other_in_a_slant_are_not_filled_up():
    """Vertebrae: the volume is that of the voxels and of a bar from one to the other."""
    mask = rod_across(45, radius=10, length=24, n=60)
    normal = np.array([np.sqrt(0.5), 0, np.sqrt(0.5)])
    mask &= abs((np.moveaxis(np.indices(mask.shape), 0, -1) - 29.5) @ normal) > 1
    vertices, faces, notes = voxel_surface(mask, joins=True)
    assert notes == ("joined 2 pieces by bars",)
    assert Mesh(vertices, faces).volume == pytest.approx(np.count_nonzero(mask), rel=0.01)


@pytest.mark.parametrize("side", [1.0, 0.6])
def test_a_bar_is_as_thick_on_every_grid(side):
    """Two balls of radius 15 at a distance of 10: a fiftieth of the square root of their area is 1.5."""
    n = np.ceil(np.array([37, 16, 16]) / side).astype(int)
    points = (np.moveaxis(np.indices(2 * n + 1), 0, -1) - n) * side
    mask = norm(points - [20, 0, 0], axis=-1) < 15
    mask |= mask[::-1]
    affine = np.diag([side, side, side, 1])
    affine[:3, 3] = -n * side
    vertices, faces, notes = voxel_surface(mask, affine, joins=True)
    assert notes == ("joined 2 pieces by bars",)
    assert Mesh(vertices, faces).genus == 0
    (line,) = trimesh.Trimesh(vertices, faces).section([1, 0, 0], [0, 0, 0]).discrete
    _, y, z = line.T
    section = abs(y[1:] @ z[:-1] - y[:-1] @ z[1:]) / 2
    assert np.sqrt(section / np.pi) == pytest.approx(1.5, abs=0.3)


def test_holes_inside_are_filled():
    mask = np.ones((12, 12, 12), dtype=bool)
    mask[5:7, 5:7, 5:7] = False
    vertices, faces, notes = voxel_surface(mask)
    assert notes == ("filled holes: 8 voxels, 8",)
    assert Mesh(vertices, faces).volume == pytest.approx(12**3, rel=1e-3)


def test_what_is_no_body_is_refused_with_its_count():
    mask = np.zeros((9, 9, 9), dtype=bool)
    mask[2:9, 4, 4] = True
    with pytest.raises(MeshError, match="liver: expected at least 8 voxels, got 7"):
        voxel_surface(mask, name="liver")
    with pytest.raises(MeshError, match="singular"):
        voxel_surface(
            np.ones((9, 9, 9)),
            np.diag([1.0, 1, 0, 1]),
        )
    with pytest.raises(MeshError, match=r"got shape \(9, 9\)"):
        voxel_surface(np.ones((9, 9)))
    with pytest.raises(MeshError, match="finite matrix"):
        voxel_surface(
            np.ones((9, 9, 9)),
            np.full((4, 4), np.nan),
        )


def test_a_thin_label_has_the_volume_of_its_voxels():
    """A slanted sheet one voxel thick touches itself along edges, where voxels are added for the grid."""
    x, y, z = np.indices((24, 24, 24))
    height = (0.7 * x + 0.4 * y).astype(int)
    sheet = (z == height) & (x > 2) & (x < 20) & (y > 2) & (y < 20)
    vertices, faces, notes = voxel_surface(sheet)
    assert notes == ()
    assert signed_volume(vertices, faces) == pytest.approx(sheet.sum(), rel=5e-3)

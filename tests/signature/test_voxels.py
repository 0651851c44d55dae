import igl
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal
from scipy.stats import kstest
from trimesh.creation import box

from conftest import as_mesh
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.signature.voxels import grid_axes, inside_grid, interior_samples


def grid_points(axes):
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_box_is_filled_exactly():
    points = interior_samples(
        as_mesh(box((1, 2, 4))),
        resolution=32,
    )
    assert len(points) == 8 * 16 * 32
    np.testing.assert_allclose(np.sort(np.unique(points[:, 0].round(9))), (np.arange(8) - 3.5) / 8)


def test_volume_of_samples_tends_to_volume(blob):
    resolution = 64
    cell = np.ptp(blob.vertices, axis=0).max() / resolution
    assert len(interior_samples(blob, resolution)) * cell**3 == pytest.approx(blob.volume, rel=0.01)


def test_radial_law_of_a_ball(sphere):
    radius = np.linalg.norm(interior_samples(sphere, 32), axis=1)
    assert kstest(radius, lambda r: np.clip(r, 0, 1) ** 3).statistic < 0.02


@pytest.mark.parametrize(
    "make",
    [
        lambda: trimesh.creation.torus(1, 0.3),
        lambda: trimesh.creation.capsule(2, 0.5),
    ],
)
def test_inside_equals_libigl_winding_number(make):
    mesh = as_mesh(make())
    axes = grid_axes(mesh, 19)
    winding = igl.winding_number(
        np.array(mesh.vertices),
        np.array(mesh.faces),
        grid_points(axes),
    )
    assert_array_equal(inside_grid(mesh, axes).ravel(), winding > 0.5)


def test_grid_lines_through_vertices_and_edges():
    # A grid whose lines run through every vertex and along every edge of an octahedron, and through none when shifted.
    mesh = as_mesh(trimesh.Trimesh(*_octahedron(), process=False))
    exact = tuple(np.arange(-2, 3) / 2.0 for _ in range(3))
    points = grid_points(exact)
    assert_array_equal(inside_grid(mesh, exact).ravel(), (np.abs(points).sum(axis=1) < 1 - 1e-9))


def _octahedron():
    vertices = np.array(
        [
            [1, 0, 0],
            [-1, 0, 0],
            [0, 1, 0],
            [0, -1, 0],
            [0, 0, 1],
            [0, 0, -1],
        ],
        dtype=float,
    )
    faces = np.array(
        [
            [0, 2, 4],
            [2, 1, 4],
            [1, 3, 4],
            [3, 0, 4],
            [2, 0, 5],
            [1, 2, 5],
            [3, 1, 5],
            [0, 3, 5],
        ]
    )
    return vertices, faces


def test_overlapping_parts_count_as_inside_once_or_twice():
    # Two boxes that overlap, bridged to one component by sharing no vertex is not allowed: use a self-crossing tube.
    surface = trimesh.creation.torus(1, 0.6, major_sections=48, minor_sections=24)
    surface.vertices[:, 0] *= 0.5  # the tube now crosses itself near the axis
    mesh = as_mesh(surface)
    axes = grid_axes(mesh, 24)
    winding = igl.winding_number(
        np.array(mesh.vertices),
        np.array(mesh.faces),
        grid_points(axes),
    )
    assert_array_equal(inside_grid(mesh, axes).ravel(), winding > 0.5)


def test_small_holes_do_not_matter_and_large_ones_go_by_the_winding_number(sphere):
    axes = grid_axes(sphere, 24)
    whole = inside_grid(sphere, axes)
    few = np.delete(
        sphere.faces,
        [3, 700, 2222],
        axis=0,
    )
    holed = Mesh(sphere.vertices, few, allow_open=True)
    assert_array_equal(inside_grid(holed, axes), whole)
    cap = sphere.faces[sphere.vertices[sphere.faces, 2].mean(axis=1) < 0.75]
    used, faces = np.unique(cap, return_inverse=True)
    bowl = Mesh(
        sphere.vertices[used],
        faces.reshape(-1, 3),
        allow_open=True,
    )
    winding = igl.winding_number(
        np.array(bowl.vertices),
        np.array(bowl.faces),
        grid_points(axes),
    )
    clear = np.abs(winding - 0.5) > 1e-6
    assert_array_equal(inside_grid(bowl, axes).ravel()[clear], (winding > 0.5)[clear])


def test_grid_moves_and_turns_with_the_mesh(blob):
    turn = np.array(
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
        dtype=float,
    )
    shift = np.array([3.0, -40.0, 0.7])
    moved = interior_samples(
        Mesh(blob.vertices @ turn.T + shift, blob.faces),
        20,
    )
    expected = interior_samples(blob, 20) @ turn.T + shift
    moved = moved[np.lexsort(moved.round(6).T)]
    np.testing.assert_allclose(moved, expected[np.lexsort(expected.round(6).T)], atol=1e-9)


def test_min_samples_refines_the_grid(blob):
    coarse = interior_samples(blob, 8)
    refined = interior_samples(blob, 8, min_samples=1000)
    assert len(coarse) < 1000 <= len(refined) < 2500
    assert_array_equal(interior_samples(blob, 8, min_samples=len(coarse)), coarse)


def test_body_too_thin_for_the_grid():
    sheet = box((1, 1, 1e-3))
    turn = trimesh.transformations.rotation_matrix(0.4, [1, 2, 0])
    sheet.apply_transform(turn)
    with pytest.raises(MeshError, match="set min_samples to refine it"):
        interior_samples(as_mesh(sheet, "sheet"), resolution=2)


def test_limits_of_the_grid_are_named(blob):
    with pytest.raises(
        MeshError, match=r"resolution of at most \d+ \(512 cells along the longest .* got 900\."
    ):
        interior_samples(blob, 900)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("depth", "n_inside"),
    [(5e-6, 16 * 16), (5e-7, 0)],
)
def test_surface_is_as_thick_where_the_grid_has_one_layer(axis, depth, n_inside):
    # The cell centres of a plate lie so many cells below its two faces; closer than 1e-6 cells is on the surface.
    extents = np.roll([2 * depth / 16, 1.0, 1.0], axis)
    plate = as_mesh(box(extents))
    axes = grid_axes(plate, 16)
    assert len(axes[axis]) == 1
    assert inside_grid(plate, axes).sum() == n_inside


@pytest.mark.parametrize(
    ("resolution", "min_samples", "name"),
    [
        (0, 0, "resolution"),
        (4, -1, "min_samples"),
    ],
)
def test_bad_arguments(blob, resolution, min_samples, name):
    with pytest.raises(ValueError, match=name):
        interior_samples(blob, resolution, min_samples)

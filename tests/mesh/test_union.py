import numpy as np
import trimesh
from numpy.testing import assert_allclose

from igps.mesh.mending import mend, repair_steps
from igps.mesh.mesh import Mesh
from igps.shapes import ArticulatedShapes


def box(low, high, subdivisions=2):
    mesh = trimesh.creation.box(bounds=[low, high])
    for _ in range(subdivisions):
        mesh = mesh.subdivide()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


def together(*surfaces):
    vertices = np.empty((0, 3))
    faces = np.empty((0, 3), dtype=np.int64)
    for more, corners in surfaces:
        faces = np.vstack([faces, corners + len(vertices)])
        vertices = np.vstack([vertices, more])
    return vertices, faces


def test_boxes_that_overlap_are_one_body_of_the_right_volume_and_area():
    surface = together(
        box([0, 0, 0], [2, 1, 1]),
        box([1.3, 0.2, 0.25], [3, 0.7, 0.75]),
    )
    body = mend(*surface)
    assert repair_steps(body.notes) == ("united",)
    # The second box reaches 0.7 into the first.
    assert_allclose(body.volume, 2 + 1.0 * 0.5 * 0.5, rtol=1e-12)
    assert_allclose(body.area, 10 + 4 * 0.5 * 1.0, rtol=1e-12)


def test_parts_that_do_not_touch_or_are_open_are_left_to_the_grid():
    apart = together(
        box([0, 0, 0], [1, 1, 1]),
        box([2, 0, 0], [3, 1, 1]),
    )
    vertices, faces = box([0.5, 0.5, 0.5], [2, 2, 2])
    opened = together(
        box([0, 0, 0], [1, 1, 1]),
        (vertices, faces[len(faces) // 2 :]),
    )
    for surface in (apart, opened):
        steps = repair_steps(mend(*surface).notes)
        assert "watertight" in steps
        assert "united" not in steps


def test_two_halves_with_a_wall_each_that_overlap_are_the_body_that_they_were_cut_from():
    import manifold3d

    shape = ArticulatedShapes(3, 1, seed=4)[2]
    shape = Mesh(shape.vertices, shape.faces)
    centred = shape.vertices - shape.vertices.mean(axis=0)
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            centred.copy(),
            shape.faces.astype(np.uint64),
        )
    )
    reach = 0.02 * np.ptp(centred, axis=0).max()
    halves = []
    for normal in ([1.0, 0, 0], [-1.0, 0, 0]):
        half = solid.trim_by_plane(normal, -reach).to_mesh64()
        vertices = np.asarray(half.vert_properties)[:, :3]
        halves.append((vertices, np.asarray(half.tri_verts, np.int64)))
    body = mend(*together(*halves))
    assert "watertight" not in repair_steps(body.notes)
    assert_allclose((body.volume, body.area), (shape.volume, shape.area), rtol=1e-9)

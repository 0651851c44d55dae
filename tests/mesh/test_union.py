import numpy as np
import trimesh

from igps.mesh._union import drop_inner_walls, unite_parts
from igps.mesh.mending import mend, repair_steps
from igps.mesh.mesh import Mesh
from igps.mesh.surface import face_patches
from igps.shapes import ArticulatedShapes


def box(low, high, subdivisions=2):
    mesh = trimesh.creation.box(bounds=[low, high])
    for _ in range(subdivisions):
        mesh = mesh.subdivide()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


def together(*surfaces):
    at = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    return np.vstack([v for v, _ in surfaces]), np.vstack(
        [f + n for (_, f), n in zip(surfaces, at, strict=False)]
    )


def test_boxes_that_overlap_are_one_body_of_the_right_volume_and_area():
    surface = together(box([0, 0, 0], [2, 1, 1]), box([1.3, 0.2, 0.25], [3, 0.7, 0.75]))
    body = mend(*surface)
    assert repair_steps(body.notes) == ("united",)
    # The second box reaches 0.7 into the first.
    np.testing.assert_allclose(body.volume, 2 + 1.0 * 0.5 * 0.5, rtol=1e-12)
    np.testing.assert_allclose(body.area, 10 + 4 * 0.5 * 1.0, rtol=1e-12)


def test_parts_that_do_not_touch_or_are_open_are_left_to_the_grid():
    apart = together(box([0, 0, 0], [1, 1, 1]), box([2, 0, 0], [3, 1, 1]))
    vertices, faces = box([0.5, 0.5, 0.5], [2, 2, 2])
    opened = together(box([0, 0, 0], [1, 1, 1]), (vertices, faces[len(faces) // 2 :]))
    for surface in (apart, opened):
        notes = []
        assert unite_parts(*surface, notes)[1] is surface[1]
        assert notes == []


def with_wall():
    """A body of two boxes of one size, with the wall between them still there."""
    vertices, faces = box([0, 0, 0], [1, 1, 1])
    # The same triangles on both sides of the wall
    mirrored = (
        vertices * [-1, 1, 1] + [2, 0, 0],
        faces[:, ::-1],
    )
    return together((vertices, faces), mirrored)


def test_a_wall_between_two_halves_is_dropped_and_nothing_else():
    body = mend(*with_wall())
    assert any("dropped 1 wall inside" in note for note in body.notes)
    assert "watertight" not in repair_steps(body.notes)
    np.testing.assert_allclose((body.volume, body.area), (2, 10), rtol=1e-12)


def test_two_halves_with_a_wall_each_that_overlap_are_the_body_that_they_were_cut_from():
    import manifold3d

    shape = ArticulatedShapes(3, 1, seed=4)[2]
    shape = Mesh(shape.vertices, shape.faces)
    centred = shape.vertices - shape.vertices.mean(axis=0)
    solid = manifold3d.Manifold(manifold3d.Mesh64(centred.copy(), shape.faces.astype(np.uint64)))
    reach = 0.02 * np.ptp(centred, axis=0).max()
    meshes = [
        solid.trim_by_plane(normal, -reach).to_mesh64() for normal in ([1.0, 0, 0], [-1.0, 0, 0])
    ]
    body = mend(
        *together(
            *(
                (np.asarray(m.vert_properties)[:, :3], np.asarray(m.tri_verts, np.int64))
                for m in meshes
            )
        )
    )
    assert "watertight" not in repair_steps(body.notes)
    np.testing.assert_allclose((body.volume, body.area), (shape.volume, shape.area), rtol=1e-9)


def test_a_box_without_inner_walls_is_unchanged():
    """The faces of a closed box are returned as they are, without a note."""
    vertices, faces = box([0, 0, 0], [1, 1, 1])
    notes = []
    assert drop_inner_walls(vertices, faces, notes)[1] is faces
    assert notes == []


def test_patches_are_what_an_edge_of_three_faces_separates():
    vertices, faces = with_wall()
    points, index = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    welded = np.unique(np.sort(index.ravel()[faces], axis=1), axis=0)
    patch, may_go = face_patches(welded, len(points))
    assert patch.max() == 2
    x = points[welded].mean(axis=1)[:, 0]
    for side in (x < 1 - 1e-9, np.isclose(x, 1), x > 1 + 1e-9):
        assert len(set(patch[side])) == 1
    assert may_go.all()  # two others meet wherever one of the three ends

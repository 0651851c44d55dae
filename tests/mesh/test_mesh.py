"""A mesh is checked when made, and what is wrong is named with its remedy."""

from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
import trimesh
from docs.benchmarks.weld import weld_gap
from numpy.testing import assert_array_equal

from conftest import FACES, TETRAHEDRON, horseshoe, surface_genus
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.objects import as_mesh


def test_closed_forms_of_area_and_volume():
    mesh = Mesh(TETRAHEDRON, FACES)
    assert mesh.volume == pytest.approx(1 / 6)
    assert mesh.area == pytest.approx(1.5 + np.sqrt(3) / 2)


def test_mesh_copies_and_freezes_its_arrays():
    vertices = TETRAHEDRON.copy()
    mesh = Mesh(vertices, FACES)
    vertices[0] = 9
    assert mesh.vertices[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1


def test_inside_out_mesh_is_turned_and_says_so():
    mesh = Mesh(TETRAHEDRON, FACES[:, ::-1])
    assert mesh.volume == pytest.approx(1 / 6)
    assert any("inside out" in note for note in mesh.notes)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TETRAHEDRON, np.empty((0, 3), dtype=int), "no faces"),
        (TETRAHEDRON[:, :2], FACES, r"expected shape \(V, 3\)"),
        (np.where(TETRAHEDRON == 1, np.nan, TETRAHEDRON), FACES, "3 vertices with NaN"),
        (np.where(TETRAHEDRON == 1, np.inf, TETRAHEDRON), FACES, "3 vertices with NaN or infinite"),
        (TETRAHEDRON, FACES + 1, "3 faces with vertices out of range"),
        (TETRAHEDRON, FACES - 1, "out of range"),
        (TETRAHEDRON, FACES[:3], "3 boundary edges"),
        (
            TETRAHEDRON,
            np.vstack([FACES[:3], FACES[3:, ::-1]]),
            "inconsistent orientation, two faces go along 3 edges",
        ),
        (TETRAHEDRON, np.vstack([FACES, [[0, 0, 1]]]), "1 face with a vertex twice"),
        (np.vstack([TETRAHEDRON, [[5, 5, 5]]]), FACES, "1 vertex in no face"),
        (
            np.vstack([TETRAHEDRON, [[5, 5, 5]]]),
            np.vstack([FACES, [[0, 1, 4]]]),
            "1 non-manifold edge ",
        ),
        (
            np.vstack([TETRAHEDRON, TETRAHEDRON + 3]),
            np.vstack([FACES, FACES + 4]),
            "2 connected components",
        ),
        (TETRAHEDRON * [1, 1, 0], FACES, "encloses no volume"),
    ],
)
def test_bad_mesh_is_named_and_explained(vertices, faces, message):
    with pytest.raises(MeshError, match=rf"(?s)bad\.off: .*{message}"):
        Mesh(vertices, faces, name="bad.off")


def test_every_message_of_a_repairable_fault_names_the_remedy():
    for faces in (
        FACES[:3],
        np.vstack([FACES, [[0, 0, 1]]]),
        np.vstack([FACES[:3], FACES[3:, ::-1]]),
    ):
        with pytest.raises(MeshError, match="mend="):
            Mesh(TETRAHEDRON, faces)


def test_genus_and_diagonal():
    ring = as_mesh(trimesh.creation.torus(1, 0.1, major_sections=64, minor_sections=16))
    for mesh, expected in (
        (Mesh(TETRAHEDRON, FACES), 0),
        (ring, 1),
        (horseshoe(), 0),
        (weld_gap(horseshoe()), 1),
    ):
        assert mesh.genus == surface_genus(mesh) == expected
    assert Mesh(TETRAHEDRON * [1, 2, 2], FACES).diagonal == pytest.approx(3)
    with pytest.raises(MeshError, match="open surface has no genus"):
        _ = Mesh(TETRAHEDRON, FACES[:3], allow_open=True).genus


def test_numbered_by_faces_is_the_same_surface_whatever_the_numbers(blob):
    order = np.random.default_rng(0).permutation(len(blob.vertices))
    rank = np.argsort(order)
    found = blob.numbered_by_faces()
    again = Mesh(blob.vertices[order], rank[blob.faces]).numbered_by_faces()
    assert_array_equal(found.vertices[found.faces], blob.vertices[blob.faces])
    assert_array_equal(found.vertices, again.vertices)
    assert_array_equal(found.faces, again.faces)
    assert found.numbered_by_faces().faces.tolist() == found.faces.tolist()


def test_more_notes_and_a_unit_leave_the_surface_as_it_is(blob):
    told = blob.annotated(notes=("first",), unit="mm")
    assert told.notes == ("first", *blob.notes)
    assert told.unit == "mm"
    assert told.annotated().unit == "mm"
    assert blob.unit is None
    assert told.vertices is blob.vertices
    assert told.area == blob.area


def test_a_trimesh_becomes_a_mesh_and_a_mesh_stays_itself():
    box = trimesh.creation.box((1, 2, 3))
    mesh = as_mesh(box)
    assert_array_equal(mesh.vertices, box.vertices)
    assert_array_equal(mesh.faces, box.faces)
    assert mesh.name == "mesh"
    assert as_mesh(mesh) is mesh
    box.metadata["file_name"] = "box.ply"
    assert as_mesh(box).name == "box.ply"
    box.update_faces(np.arange(12) > 0)
    with pytest.raises(MeshError, match=r"box\.ply: open surface"):
        as_mesh(box)


@pytest.mark.parametrize(
    "body",
    [None, "box.ply", np.zeros((3, 3)), trimesh.Scene()],
)
def test_what_is_no_mesh_is_named(body):
    with pytest.raises(
        TypeError,
        match=rf"mesh: expected a Mesh, a trimesh.Trimesh, .* got .*{type(body).__name__}\. Read",
    ):
        as_mesh(body)


def test_meshes_of_other_libraries(blob):
    """PyVista's polygons stand in one row, each behind its number of corners; only what it is asked for is needed."""
    of_trimesh = trimesh.Trimesh(blob.vertices, blob.faces, process=False)
    of_trimesh.units = "inch"
    points = nibabel.gifti.GiftiDataArray(blob.vertices.astype("f4"), "NIFTI_INTENT_POINTSET")
    faces = nibabel.gifti.GiftiDataArray(blob.faces.astype("i4"), "NIFTI_INTENT_TRIANGLE")
    row = np.column_stack([np.full(len(blob.faces), 3), blob.faces]).ravel()
    for thing, unit in (
        (of_trimesh, "inch"),
        (nibabel.gifti.GiftiImage(darrays=[points, faces]), "mm"),
        (SimpleNamespace(points=blob.vertices, faces=row), None),
    ):
        mesh = as_mesh(thing)
        np.testing.assert_allclose(mesh.vertices, blob.vertices, atol=1e-6)
        assert_array_equal(mesh.faces, blob.faces)
        assert mesh.name == "mesh"
        assert mesh.unit == unit
    quads = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [1, 3, 7, 5],
        [3, 2, 6, 7],
        [2, 0, 4, 6],
    ]
    corners = np.array(
        [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float32
    )
    rows = np.ravel([[4, *quad] for quad in quads])
    assert as_mesh(SimpleNamespace(points=corners, faces=rows)).volume == 1


def test_voxels_of_one_label_are_a_mesh():
    ball = ((np.indices((20, 20, 20)) - 9.5) ** 2).sum(axis=0) < 8**2
    image = nibabel.Nifti1Image(
        5 * ball.astype(np.uint8),
        np.diag([-1, 1, 2, 1]),
    )
    for thing, spacing, unit in ((image, None, "mm"), (ball, (1, 1, 2), "mm"), (ball, None, None)):
        mesh = as_mesh(thing, spacing)
        sides = 1 if unit is None else 2
        assert mesh.volume == pytest.approx(sides * ball.sum(), rel=1e-3)
        assert mesh.name == "volume"
        assert mesh.unit == unit
    with pytest.raises(
        MeshError, match=r"expected one label, got 1, 3\. Select one, such as labels == 1"
    ):
        as_mesh(ball + 2 * (ball & (np.arange(20) < 9)))
    with pytest.raises(MeshError, match=r"three sides of a voxel, got .*spacing \(1, 2\)"):
        as_mesh(ball, (1, 2))


def test_an_image_without_a_surface_is_none():
    with pytest.raises(TypeError, match="expected a GIFTI image of a surface"):
        as_mesh(nibabel.gifti.GiftiImage())

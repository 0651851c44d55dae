from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from conftest import as_mesh
from igps.geometry.mesh import Mesh, MeshError, load_mesh, simplify

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def write_off(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0", *(" ".join(map(str, v)) for v in vertices)]
    lines += [" ".join(map(str, [len(f), *f])) for f in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_closed_forms_of_area_and_volume() -> None:
    mesh = Mesh(TETRAHEDRON, FACES)
    assert mesh.volume == pytest.approx(1 / 6)
    assert mesh.area == pytest.approx(1.5 + np.sqrt(3) / 2)


def test_mesh_copies_and_freezes_its_arrays() -> None:
    vertices = TETRAHEDRON.copy()
    mesh = Mesh(vertices, FACES)
    vertices[0] = 9
    assert mesh.vertices[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1


def test_inside_out_mesh_is_turned_and_says_so() -> None:
    mesh = Mesh(TETRAHEDRON, FACES[:, ::-1])
    assert mesh.volume == pytest.approx(1 / 6)
    assert any("inside out" in note for note in mesh.notes)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TETRAHEDRON, np.empty((0, 3), dtype=int), "no faces"),
        (TETRAHEDRON[:, :2], FACES, r"expected shape \(V, 3\)"),
        (np.where(TETRAHEDRON == 1, np.nan, TETRAHEDRON), FACES, "3 vertices have NaN"),
        (np.where(TETRAHEDRON == 1, np.inf, TETRAHEDRON), FACES, "3 vertices have NaN or infinite"),
        (TETRAHEDRON, FACES + 1, "3 faces refer to vertices out of range"),
        (TETRAHEDRON, FACES - 1, "out of range"),
        (TETRAHEDRON, FACES[:3], "3 boundary edges"),
        (TETRAHEDRON, np.vstack([FACES[:3], FACES[3:, ::-1]]), "inconsistent orientation, 3 edges"),
        (TETRAHEDRON, np.vstack([FACES, [[0, 0, 1]]]), "1 faces use a vertex twice"),
        (np.vstack([TETRAHEDRON, [[5, 5, 5]]]), FACES, "1 vertices belong to no face"),
        (np.vstack([TETRAHEDRON, [[5, 5, 5]]]), np.vstack([FACES, [[0, 1, 4]]]), "1 non-manifold edges"),
        (np.vstack([TETRAHEDRON, TETRAHEDRON + 3]), np.vstack([FACES, FACES + 4]), "2 connected components"),
        (TETRAHEDRON * [1, 1, 0], FACES, "encloses no volume"),
    ],
)
def test_bad_mesh_is_named_and_explained(vertices: np.ndarray, faces: np.ndarray, message: str) -> None:
    with pytest.raises(MeshError, match=rf"(?s)bad\.off: .*{message}"):
        Mesh(vertices, faces, name="bad.off")


def test_every_message_of_a_repairable_fault_names_the_remedy() -> None:
    for faces in (FACES[:3], np.vstack([FACES, [[0, 0, 1]]]), np.vstack([FACES[:3], FACES[3:, ::-1]])):
        with pytest.raises(MeshError, match="repair=True"):
            Mesh(TETRAHEDRON, faces)


def test_open_mesh_passes_when_allowed() -> None:
    mesh = Mesh(TETRAHEDRON, FACES[:3], allow_open=True)
    assert len(mesh.faces) == 3


def test_missing_and_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"nowhere\.off: no such file"):
        load_mesh(tmp_path / "nowhere.off")
    for name, text in (("empty.off", ""), ("words.off", "hello"), ("cut.ply", "ply\nformat ascii 1.0\n")):
        (tmp_path / name).write_text(text)
        with pytest.raises(MeshError, match=rf"{name}: not readable"):
            load_mesh(tmp_path / name)


@pytest.mark.parametrize("suffix", ["off", "obj", "ply", "glb"])
def test_formats_keep_vertices_in_order(tmp_path: Path, suffix: str) -> None:
    surface = trimesh.creation.icosphere(subdivisions=1)
    surface.export(tmp_path / f"mesh.{suffix}")
    mesh = load_mesh(tmp_path / f"mesh.{suffix}")
    np.testing.assert_allclose(mesh.vertices, surface.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, surface.faces)


def test_quads_become_triangles(tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]])
    mesh = load_mesh(write_off(tmp_path / "cube.off", corners, quads))
    assert mesh.faces.shape == (12, 3)
    assert mesh.volume == pytest.approx(1)
    assert mesh.area == pytest.approx(6)


def test_texture_seams_do_not_split_vertices(tmp_path: Path) -> None:
    lines = [f"v {x} {y} {z}" for x, y, z in TETRAHEDRON] + ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += [f"f {a + 1}/{i % 4 + 1} {b + 1}/2 {c + 1}/3" for i, (a, b, c) in enumerate(FACES)]
    (tmp_path / "seams.obj").write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(load_mesh(tmp_path / "seams.obj").vertices, TETRAHEDRON)


def test_stl_needs_and_gets_welding(tmp_path: Path) -> None:
    surface = trimesh.creation.icosphere(subdivisions=2)
    surface.export(tmp_path / "mesh.stl")
    with pytest.raises(MeshError, match="boundary edges"):
        load_mesh(tmp_path / "mesh.stl")
    mesh = load_mesh(tmp_path / "mesh.stl", repair=True)
    assert len(mesh.vertices) == len(surface.vertices)
    assert mesh.volume == pytest.approx(surface.volume, rel=1e-6)
    assert any("welded" in note for note in mesh.notes)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_repair_mends_each_fault_at_any_scale(tmp_path: Path, scale: float) -> None:
    surface = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    faulty = faces.copy()
    faulty[::3] = faulty[::3, ::-1]
    faulty[5, 0] = len(vertices)
    faulty = np.vstack([faulty, faulty[7], [[0, 0, 1]]])
    vertices = np.vstack([vertices, vertices[faces[5, 0] if 5 % 3 else faces[5, 2]], [[4, 4, 4]]]) * scale
    mesh = load_mesh(write_off(tmp_path / "faulty.off", vertices, faulty), repair=True)
    assert mesh.volume == pytest.approx(surface.volume * scale**3, rel=1e-6)
    assert len(mesh.vertices) == len(surface.vertices)
    said = " ".join(mesh.notes)
    assert all(word in said for word in ("welded 1", "degenerate", "duplicate", "unreferenced", "orient"))


def test_largest_component_is_that_of_the_largest_area(tmp_path: Path) -> None:
    fine, large = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.box((5, 5, 5))
    vertices = np.vstack([fine.vertices + 20, large.vertices])
    faces = np.vstack([fine.faces, large.faces + len(fine.vertices)])
    path = write_off(tmp_path / "two.off", vertices, faces)
    with pytest.raises(MeshError, match="2 connected components"):
        load_mesh(path)
    mesh = load_mesh(path, component="largest")
    assert mesh.volume == pytest.approx(125)
    assert any("largest of 2 components" in note for note in mesh.notes)


def test_simplify_keeps_the_shape_and_the_promise(sphere: Mesh) -> None:
    small = simplify(sphere, 500)
    assert len(small.vertices) <= 500
    assert small.volume == pytest.approx(sphere.volume, rel=0.02)
    assert any("simplified from 2562" in note for note in small.notes)
    assert simplify(sphere, 5000) is sphere


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_simplify_does_not_depend_on_scale(blob: Mesh, scale: float) -> None:
    scaled = simplify(Mesh(blob.vertices * scale, blob.faces), 200)
    np.testing.assert_allclose(scaled.vertices / scale, simplify(blob, 200).vertices, atol=1e-9)


def test_simplify_keeps_the_topology() -> None:
    ring = trimesh.creation.torus(1, 0.1, major_sections=64, minor_sections=16)
    small = simplify(as_mesh(ring), 60)
    n_vertices, n_faces = len(small.vertices), len(small.faces)
    assert n_vertices - n_faces // 2 == 0  # Euler characteristic of a torus, with 3/2 edges a face
    with pytest.raises(MeshError, match="Raise max_vertices"):
        simplify(as_mesh(ring), 4)

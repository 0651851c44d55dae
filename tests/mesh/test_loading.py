"""Meshes from files: formats, clouds of points, mending, and what makes a file unusable."""

import numpy as np
import pytest
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from trimesh.creation import icosphere

from conftest import FACES, TETRAHEDRON
from igps.fields.meshes import vertex_values
from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh, read_surface
from igps.mesh.options import LoadOptions


def write_off(path, vertices, faces):
    lines = [
        "OFF",
        f"{len(vertices)} {len(faces)} 0",
        *(" ".join(map(str, v)) for v in vertices),
    ]
    lines += [" ".join(map(str, [len(f), *f])) for f in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(MeshError, match=r"nowhere\.off: no such file"):
        load_mesh(tmp_path / "nowhere.off")
    with pytest.raises(MeshError, match="expected a file, got a folder"):
        load_mesh(tmp_path)
    for name, text in (
        ("blank.off", "\n"),
        ("words.off", "hello"),
        ("cut.ply", "ply\nformat ascii 1.0\n"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(MeshError, match=rf"{name}: not readable"):
            load_mesh(tmp_path / name)


@pytest.mark.parametrize("suffix", ["off", "obj", "ply", "stl", "glb", "xyz", "3mf"])
def test_an_empty_file_is_called_empty(tmp_path, suffix):
    (tmp_path / f"none.{suffix}").write_bytes(b"")
    with pytest.raises(
        MeshError, match=rf"none\.{suffix}: the file is empty \(0 bytes\)\. Export it again"
    ):
        load_mesh(tmp_path / f"none.{suffix}")


@pytest.mark.parametrize("suffix", ["off", "obj", "ply", "glb"])
def test_formats_keep_vertices_in_order(tmp_path, suffix):
    surface = icosphere(subdivisions=1)
    surface.export(tmp_path / f"mesh.{suffix}")
    mesh = load_mesh(tmp_path / f"mesh.{suffix}")
    assert_allclose(mesh.vertices, surface.vertices, atol=1e-6)
    assert_array_equal(mesh.faces, surface.faces)


@pytest.mark.parametrize(
    ("suffix", "comment"), [("off", "# {}"), ("obj", "# {}"), ("ply", "comment {}")]
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "shift_jis"])
def test_comments_may_be_in_any_encoding(tmp_path, suffix, comment, encoding):
    surface = icosphere(subdivisions=1)
    options = {"encoding": "ascii"} if suffix == "ply" else {}
    text = surface.export(file_type=suffix, **options)
    lines = (text if isinstance(text, str) else text.decode()).split("\n")
    words = "球の大きさ" if encoding == "shift_jis" else "Größe, né à Paris"
    lines.insert(2 if suffix == "ply" else 1, comment.format(words))
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes("\n".join(lines).encode(encoding))
    mesh = load_mesh(path)
    assert_allclose(mesh.vertices, surface.vertices, atol=1e-6)
    assert_array_equal(mesh.faces, surface.faces)
    (tmp_path / "cloud.xyz").write_bytes(f"# {words}\n0 0 1\n0 1 0\n".encode(encoding))
    cloud = read_surface(tmp_path / "cloud.xyz")
    assert cloud.vertices.tolist() == [[0, 0, 1], [0, 1, 0]]


def test_a_byte_order_mark_costs_no_vertex(tmp_path):
    """Editors on Windows put it first, before the first vertex where no comment stands above."""
    surface = icosphere(subdivisions=1)
    lines = surface.export(file_type="obj").split("\n")
    text = "\n".join(line for line in lines if not line.startswith("#"))
    (tmp_path / "mesh.obj").write_text(text, encoding="utf-8-sig")
    assert (tmp_path / "mesh.obj").read_bytes()[3:5] == b"v "
    mesh = load_mesh(tmp_path / "mesh.obj")
    assert_allclose(mesh.vertices, surface.vertices, atol=1e-6)


@pytest.mark.parametrize("start", [0, 3])
def test_polygons_with_corners_turned_inwards_do_not_fold(start, tmp_path):
    """Prisms over stars, whose area and volume are those of the polygon (Gauss's formula)."""
    random = default_rng(start)
    angle = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    if start == 3:
        angle = np.sort(random.uniform(0, 2 * np.pi, 4))
    radius = np.where(
        np.arange(len(angle)) % 2,
        1.0,
        random.uniform(0.1, 0.5, len(angle)),
    )
    x, y = np.roll(
        radius * (np.cos(angle), np.sin(angle)),
        start,
        axis=1,
    )
    area = abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2
    around = np.hypot(np.roll(x, -1) - x, np.roll(y, -1) - y).sum()
    n = len(x)
    rings = [np.column_stack([x, y, np.full(len(x), z)]) for z in (0, 2)]
    faces = [range(n, 0, -1), range(n + 1, 2 * n + 1)]
    faces += [(i + 1, (i + 1) % n + 1, (i + 1) % n + n + 1, i + n + 1) for i in range(n)]
    lines = [f"v {a!r} {b!r} {c!r}" for a, b, c in np.concatenate(rings).tolist()]
    lines += ["f " + " ".join(map(str, face)) for face in faces]
    (tmp_path / "star.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "star.obj")
    assert mesh.notes == ()
    assert len(mesh.faces) == 2 * (n - 2) + 2 * n
    assert mesh.volume == pytest.approx(2 * area)
    assert mesh.area == pytest.approx(2 * area + 2 * around)


def test_a_polygon_around_a_hole_does_not_fold(tmp_path):
    """A square with a square hole, reached by an edge that is run through twice, as CAD programs write it."""
    square = [
        (0, 0),
        (3, 0),
        (3, 3),
        (0, 3),
        (1, 1),
        (1, 2),
        (2, 2),
        (2, 1),
    ]
    (tmp_path / "ring.obj").write_text(
        "\n".join(f"v {x} {y} 0" for x, y in square) + "\nf 1 2 3 4 1 5 6 7 8 5\n"
    )
    surface = read_surface(tmp_path / "ring.obj")
    corners = surface.vertices[surface.faces]
    normals = np.cross(
        corners[:, 1] - corners[:, 0],
        corners[:, 2] - corners[:, 0],
    )
    assert (normals[:, 2] >= 0).all()
    assert normals[:, 2].sum() / 2 == pytest.approx(8)


@pytest.mark.parametrize("n_corners", [60, 5000])
def test_a_polygon_that_crosses_itself_or_has_many_corners_is_cut_all_the_same(n_corners, tmp_path):
    """Into triangles that use every corner, each side of the polygon once."""
    places = default_rng(0).normal(size=(n_corners, 2)).tolist()
    face = " ".join(str(i + 1) for i in range(n_corners))
    (tmp_path / "scribble.obj").write_text(
        "\n".join(f"v {x!r} {y!r} 0" for x, y in places) + f"\nf {face}\n"
    )
    faces = read_surface(tmp_path / "scribble.obj").faces
    assert len(faces) == n_corners - 2
    starts = faces.ravel().tolist()
    ends = np.roll(faces, -1, axis=1).ravel().tolist()
    sides = set(zip(starts, ends, strict=True))
    assert {(i, (i + 1) % n_corners) for i in range(n_corners)} <= sides
    assert len(sides) == 3 * len(faces)


def by_trimesh(text, path):
    """The surface of an OFF file; it knows no comments but in the first line, and reads files that are cut short."""
    text = "\n".join(line.partition("#")[0] for line in text.split("\n"))
    (n_vertices, n_faces, *_), *rows = [
        row.split() for row in text.partition("OFF")[2].splitlines() if row.strip()
    ]
    faces = rows[int(n_vertices) :][: int(n_faces)]
    if len(faces) < int(n_faces) or any(len(face) <= int(face[0]) for face in faces):
        raise ValueError("cut short")
    path.write_text(text)
    return trimesh.load(path, process=False, force="scene").to_mesh()


def test_off_files_are_read_as_trimesh_reads_them(tmp_path):
    """These are plain, or have faults and liberties of all kinds."""
    ball = icosphere(subdivisions=0)
    plain = ball.export(file_type="off")
    lines = plain.splitlines()
    random = default_rng(0)
    texts = [
        plain,
        plain.replace("\n", "\r\n"),
        plain.replace("\n", " \n\t"),
        plain.replace("\n", "\n\n"),
        plain.replace("OFF\n", "OFF "),
        "# a ball\n" + plain,
        "\n".join(
            [
                *lines[:2],
                "# vertices",
                *lines[2:14],
                "# faces",
                *lines[14:],
            ]
        ),
        plain + "# a ball\n",
        plain + "3 0 1 2\n",
        "\n".join(lines[:-1]),
        "\n".join([*lines[:5], *lines[6:]]),
        "\n".join(
            [
                lines[0],
                lines[1],
                *(line + " 0 0 1" for line in lines[2:14]),
                *lines[14:],
            ]
        ),
        "\n".join(
            [
                *lines[:14],
                *(line + " 255 0 0" for line in lines[14:]),
            ]
        ),
        "\n".join([*lines[:14], "4 0 1 2 3", *lines[15:]]),
        "\n".join([*lines[:14], "3 0 1 2.5", *lines[15:]]),
        "\n".join([*lines[:14], "3 0 1 12", *lines[15:]]),
        "\n".join([*lines[:14], "3 0 1 -1", *lines[15:]]),
        "\n".join(["OFF", "1 0 0", "0 0 0"]),
        "OFF\n0 0 0\n",
        "OFF\n5 3 0\n",
        "OFF\n5 3 0\n\n\n\n\n\n3 0 1 2\n",
    ]
    alphabet = [*"0123456789.-+eEnaif #\n\t,x", "٣", "\x0c"]
    for _ in range(800):
        text = list(plain)
        for place in random.integers(
            0,
            len(text),
            random.integers(1, 4),
        ):
            text[place] = random.choice(
                [
                    "",
                    random.choice(alphabet),
                    text[place] + random.choice(alphabet),
                ]
            )
        texts.append("".join(text))
    outcomes = []
    for text in texts:
        path = tmp_path / "ball.off"
        try:
            expected = by_trimesh(text, path)
        except Exception:  # of any kind
            expected = None
        path.write_text(text)
        try:
            found = read_surface(path)
        except MeshError:
            found = None
        assert (found is None) == (expected is None), text
        if expected is not None:
            assert_array_equal(found.vertices, expected.vertices)
            assert_array_equal(found.faces, expected.faces.reshape(-1, 3))
        outcomes.append(expected is not None)
    assert 150 < sum(outcomes) < len(texts) - 150


def test_texture_seams_do_not_split_vertices(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in TETRAHEDRON] + ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += [f"f {a + 1}/{i % 4 + 1} {b + 1}/2 {c + 1}/3" for i, (a, b, c) in enumerate(FACES)]
    (tmp_path / "seams.obj").write_text("\n".join(lines) + "\n")
    assert_allclose(load_mesh(tmp_path / "seams.obj").vertices, TETRAHEDRON)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(TETRAHEDRON)}\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "height"))
    head += f"element face {len(FACES)}\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    rows = [f"{x} {y} {z} {z}" for x, y, z in TETRAHEDRON]
    rows += [f"3 {a} {b} {c} 6 0.{i} 0 1 0.{i} 0.{i} 1" for i, (a, b, c) in enumerate(FACES)]
    (tmp_path / "seams.ply").write_text(head + "end_header\n" + "\n".join(rows) + "\n")
    assert_allclose(
        load_mesh(tmp_path / "seams.ply", LoadOptions(mend="never")).vertices, TETRAHEDRON
    )
    assert_allclose(
        vertex_values.read(tmp_path / "seams.ply")["height"], np.array(TETRAHEDRON)[:, 2]
    )


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_each_fault_is_mended_at_any_scale(tmp_path, scale):
    surface = icosphere(subdivisions=2)
    vertices = np.asarray(surface.vertices)
    faces = np.asarray(surface.faces)
    faulty = faces.copy()
    faulty[::3] = faulty[::3, ::-1]
    faulty[5, 0] = len(vertices)
    faulty = np.vstack([faulty, faulty[7], [[0, 0, 1]]])
    vertices = np.vstack([vertices, vertices[faces[5, 0]], [[4, 4, 4]]]) * scale
    mesh = load_mesh(write_off(tmp_path / "faulty.off", vertices, faulty))
    assert mesh.volume == pytest.approx(surface.volume * scale**3, rel=1e-6)
    assert len(mesh.vertices) == len(surface.vertices)
    said = " ".join(mesh.notes)
    for word in ("welded 1", "degenerate", "duplicate", "unreferenced", "orient"):
        assert word in said


def test_open_files_are_read_when_allowed(tmp_path):
    path = write_off(tmp_path / "open.off", TETRAHEDRON, FACES[:3])
    with pytest.raises(MeshError, match="3 boundary edges"):
        load_mesh(path, LoadOptions("never"))
    mesh = load_mesh(path, LoadOptions(allow_open=True))
    assert mesh.allow_open
    assert len(mesh.faces) == 3


def test_unknown_way_to_mend_is_refused():
    with pytest.raises(ValueError, match="mend: expected one of auto, never, always, got 'please'"):
        LoadOptions(mend="please")


@pytest.mark.parametrize(
    ("suffix", "normals"),
    [("xyz", False), ("ply", True)],
)
def test_a_cloud_of_points_becomes_the_body_it_was_taken_from(tmp_path, suffix, normals):
    surface = icosphere(subdivisions=4)
    rows = np.asarray(surface.vertices) * [1, 0.8, 1.3]
    names = ["x", "y", "z"]
    if normals:
        rows = np.hstack([rows, surface.vertex_normals])
        names = [*names, "nx", "ny", "nz"]
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {n}" for n in names),
    ]
    lines = [*header, "end_header"] if suffix == "ply" else []
    lines += [" ".join(f"{x:.7f}" for x in row) for row in rows]
    path = tmp_path / f"cloud.{suffix}"
    path.write_text("\n".join(lines) + "\n")
    mesh = load_mesh(path)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 1.04, rel=0.02)
    assert mesh.genus == 0
    assert any("watertight" in note for note in mesh.notes)
    with pytest.raises(MeshError, match=r"cloud.*no faces"):
        load_mesh(path, LoadOptions("never"))


@pytest.mark.parametrize("where", ["far", "far in double precision", "at the origin"])
def test_places_that_single_precision_rounds_off_are_told(where, tmp_path):
    """In coordinates of maps an object of some metres has steps of half a metre, which bend its surface."""
    ball = icosphere(subdivisions=3, radius=10.0)
    vertices = ball.vertices + (0.0 if where == "at the origin" else np.array([5e5, 5.4e6, 0.0]))
    if where == "far in double precision":
        text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
        (tmp_path / "a.obj").write_text(
            text + "".join(f"f {a} {b} {c}\n" for a, b, c in (ball.faces + 1).tolist())
        )
        assert load_mesh(tmp_path / "a.obj").notes == ()
        return
    trimesh.Trimesh(vertices, ball.faces, process=False).export(tmp_path / "a.ply")
    mesh = load_mesh(tmp_path / "a.ply")
    steps = np.diff(np.unique(mesh.vertices[:, 1]))
    told = "coordinates are rounded to 0.5, 1.4% of the size" in " ".join(mesh.notes)
    assert told == (steps.min() == 0.5) == (where == "far")

"""Formats: the same surface from all of them, against the libraries that write them, and what files get wrong."""

import gzip
import re
import tarfile
import tracemalloc
import zipfile
from pathlib import Path

import meshio
import nibabel
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal

from igps import SignatureConfig, compute_signature
from igps.fields.meshes.stl import merged
from igps.mesh.errors import MeshError
from igps.mesh.formats import all_formats, format_of, is_searched
from igps.mesh.loading import list_bodies, load_mesh, read_surface
from igps.mesh.options import LoadOptions

BALL = trimesh.creation.icosphere(subdivisions=2)
# Exactly representable in single precision; no two faces and no two vertices are alike.
PLACES = BALL.vertices * [1, 0.8, 1.3] + 0.1 * BALL.vertices**2
VERTICES = np.asarray(PLACES, dtype=np.float32).astype(np.float64)
FACES = np.asarray(BALL.faces, dtype=np.int64)


def lines(rows, before=""):
    return "".join(before + " ".join(map(repr, row)) + "\n" for row in rows.tolist())


def off():
    return f"OFF\n{len(VERTICES)} {len(FACES)} 0\n" + lines(VERTICES) + lines(FACES, "3 ")


def relative_obj():
    """Indices that count from the last vertex, with textures and normals, lines that go on, comments."""
    corners = [[f"{i - len(VERTICES)}/-1/-1" for i in face] for face in FACES.tolist()]
    faces = "".join(f"f {a} {b} \\\n {c} # a face\n" for a, b, c in corners)
    return "vt 0 0\nvn 0 0 1\n" + lines(VERTICES, "v ") + faces


def polydata(version):
    head = f"# vtk DataFile Version {version}\na ball\nASCII\nDATASET POLYDATA\nPOINTS {len(VERTICES)} double\n"
    if version < "5":
        cells = f"POLYGONS {len(FACES)} {4 * len(FACES)}\n"
        return head + lines(VERTICES) + cells + lines(FACES, "3 ")
    offsets = " ".join(map(str, range(0, 3 * len(FACES) + 1, 3)))
    cells = f"POLYGONS {len(FACES) + 1} {3 * len(FACES)}\nOFFSETS vtktypeint64\n{offsets}\nCONNECTIVITY vtktypeint64\n"
    return head + lines(VERTICES) + cells + lines(FACES) + f"CELL_DATA {len(FACES)}\n"


def binary_polydata():
    head = f"# vtk DataFile Version 3.0\na ball\nBINARY\nDATASET POLYDATA\nPOINTS {len(VERTICES)} float\n".encode()
    cells = np.column_stack([np.full(len(FACES), 3), FACES]).astype(">i4").tobytes()
    counts = f"\nPOLYGONS {len(FACES)} {4 * len(FACES)}\n".encode()
    return head + VERTICES.astype(">f4").tobytes() + counts + cells


def polydata_of_vtk_9():
    """As VTK 9 writes it: identifiers, which it keeps as 64 bits, as 32, and notes about an array behind it."""
    head = f"# vtk DataFile Version 5.1\nvtk output\nBINARY\nDATASET POLYDATA\nPOINTS {len(VERTICES)} float\n".encode()
    notes = b"\nMETADATA\nCOMPONENT_NAMES\nPOLYGONS\ny\nz\nINFORMATION 0\n\n"
    cells = f"POLYGONS {len(FACES) + 1} {3 * len(FACES)}\nOFFSETS vtktypeint64\n".encode()
    cells += np.arange(0, 3 * len(FACES) + 1, 3).astype(">i8").tobytes()
    cells += b"\nCONNECTIVITY vtkIdType\n" + FACES.astype(">i4").tobytes() + b"\n"
    return head + VERTICES.astype(">f4").tobytes() + notes + cells


def polydata_of_windows():
    """Text with notes about an array, and carriage returns, also in the blank line behind the notes."""
    notes = (
        "METADATA\nINFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1 \n\nPOLYGONS"
    )
    return polydata("5.1").replace("POLYGONS", notes).replace("\n", "\r\n").encode()


def vtp(form):
    arrays = {
        "points": VERTICES.astype("<f4"),
        "connectivity": FACES.ravel().astype("<i8"),
        "offsets": np.arange(
            3,
            3 * len(FACES) + 1,
            3,
            dtype="<i8",
        ),
    }
    kinds = {"points": "Float32", "connectivity": "Int64", "offsets": "Int64"}
    appended = b""
    written = {}
    for name, array in arrays.items():
        text = " ".join(map(repr, array.ravel().tolist())) if form == "ascii" else ""
        where = "ascii" if form == "ascii" else f'appended" offset="{len(appended)}'
        n = 3 if name == "points" else 1
        written[name] = (
            f'<DataArray type="{kinds[name]}" Name="{name}" NumberOfComponents="{n}" format="{where}">{text}'
        )
        appended += np.uint32(array.nbytes).tobytes() + array.tobytes()
    points, connectivity, offsets = (text + "</DataArray>" for text in written.values())
    body = f"<PolyData><Piece><Points>{points}</Points><Polys>{connectivity}{offsets}</Polys></Piece></PolyData>"
    tail = b""
    if form != "ascii":
        tail = b'<AppendedData encoding="raw">\n_' + appended + b"\n</AppendedData>"
    head = '<?xml version="1.0"?><VTKFile type="PolyData" byte_order="LittleEndian">'
    return (head + body).encode() + tail + b"</VTKFile>"


def gifti(path, encoding):
    array = nibabel.gifti.GiftiDataArray
    points = array(VERTICES.astype("f4"), "NIFTI_INTENT_POINTSET", encoding=encoding)
    triangles = array(FACES.astype("i4"), "NIFTI_INTENT_TRIANGLE", encoding=encoding)
    nibabel.save(
        nibabel.gifti.GiftiImage(darrays=[points, triangles]),
        path,
    )


def zipped(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("in/a.off", off())
        archive.writestr("readme.txt", "a ball")


def tarred(path):
    (path.parent / "a.off").write_text(off())
    with tarfile.open(path, "w:gz") as archive:
        archive.add(path.parent / "a.off", "a.off")


def strips_ply(order):
    """A list of strips of one triangle each, as text without an order."""
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(VERTICES)}\nproperty float x\nproperty float y\n"
    head += (
        "property float z\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    )
    strips = np.column_stack([FACES, np.full(len(FACES), -1)])
    row = np.concatenate([[4 * len(FACES)], strips.ravel()])
    if not order:
        return (head + lines(VERTICES) + lines(row[None])).encode()
    places = VERTICES.astype(f"{order}f4").tobytes()
    return head.encode() + places + row.astype(f"{order}i4").tobytes()


SOLID = trimesh.Trimesh(VERTICES, FACES, process=False)
CELLS = meshio.Mesh(VERTICES, [("triangle", FACES)])
WRITERS = {
    "plain.off": lambda path: path.write_text(off()),
    "relative.obj": lambda path: path.write_text(relative_obj()),
    "binary.ply": lambda path: SOLID.export(path),
    "text.ply": lambda path: meshio.write(path, CELLS, binary=False),
    "strips.ply": lambda path: path.write_bytes(strips_ply("")),
    "little_strips.ply": lambda path: path.write_bytes(strips_ply("<")),
    "big_strips.ply": lambda path: path.write_bytes(strips_ply(">")),
    "binary.stl": lambda path: SOLID.export(path),
    "text.stl": lambda path: SOLID.export(path, file_type="stl_ascii"),
    "scene.glb": lambda path: SOLID.export(path),
    "plate.3mf": lambda path: SOLID.export(path),
    "cells51.vtk": lambda path: meshio.write(path, CELLS),
    "cells42.vtk": lambda path: meshio.write(path, CELLS, file_format="vtk42"),
    "polygons3.vtk": lambda path: path.write_text(polydata("3.0")),
    "polygons5.vtk": lambda path: path.write_text(polydata("5.1")),
    "binary.vtk": lambda path: path.write_bytes(binary_polydata()),
    "binary5.vtk": lambda path: path.write_bytes(polydata_of_vtk_9()),
    "windows.vtk": lambda path: path.write_bytes(polydata_of_windows()),
    "text.vtp": lambda path: path.write_bytes(vtp("ascii")),
    "raw.vtp": lambda path: path.write_bytes(vtp("raw")),
    "zlib.vtu": lambda path: meshio.write(path, CELLS, compression="zlib"),
    "lzma.vtu": lambda path: meshio.write(path, CELLS, compression="lzma"),
    "base64.vtu": lambda path: meshio.write(path, CELLS, compression=None),
    "zipped.surf.gii": lambda path: gifti(path, "GIFTI_ENCODING_B64GZ"),
    "base64.gii": lambda path: gifti(path, "GIFTI_ENCODING_B64BIN"),
    "lh.pial": lambda path: nibabel.freesurfer.write_geometry(path, VERTICES, FACES),
    "one.zip": zipped,
    "one.tar.gz": tarred,
    "one.off.gz": lambda path: path.write_bytes(gzip.compress(off().encode())),
}
CONFIG = SignatureConfig(n_eigenpairs=10, min_samples=100)
UNITS = {".glb": "m", ".3mf": "mm", ".gii": "mm", ".pial": "mm"}


def numbers(signature):
    inside = signature.interior
    outside = signature.surface
    arrays = [signature.eigenvalues, inside.points, inside.eigenfunctions]
    arrays += [outside.points, outside.eigenfunctions]
    return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "plain.off"
    path.write_text(off())
    return numbers(compute_signature(load_mesh(path), CONFIG))


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_every_format_gives_the_same_signature_to_the_byte(name, tmp_path, expected):
    WRITERS[name](tmp_path / name)
    mesh = load_mesh(tmp_path / name, LoadOptions("never"))
    assert_array_equal(mesh.vertices[mesh.faces], VERTICES[FACES])
    assert len(mesh.vertices) == len(VERTICES)
    assert mesh.notes == ()
    assert mesh.unit == UNITS.get(Path(name).suffix)
    assert numbers(compute_signature(mesh, CONFIG)) == expected


def test_a_binary_stl_with_a_wrong_count_gives_what_is_there(tmp_path):
    path = tmp_path / "count.stl"
    SOLID.export(path)
    content = bytearray(path.read_bytes())
    for count in (55_866, 0):
        content[80:84] = count.to_bytes(4, "little")
        path.write_bytes(content + b"\0" * 7)
        mesh = load_mesh(path)
        assert_array_equal(mesh.vertices[mesh.faces], VERTICES[FACES])
        assert mesh.notes == (f"the header declares {count} triangles: {len(FACES)} were read",)
    path.write_bytes(content[:100])
    with pytest.raises(MeshError, match=r"count\.stl: not readable as STL.*no triangle"):
        load_mesh(path)


def test_corners_in_one_place_are_one_vertex_in_the_order_in_which_they_come():
    generator = np.random.default_rng(0)
    # Zeros of both signs
    corners = generator.integers(-1, 2, (300, 3)) * generator.choice([1.0, -1.0], (300, 3))
    vertices, faces = merged(corners)
    assert_array_equal(vertices[faces.ravel()], corners)
    places = list(dict.fromkeys(map(tuple, corners.tolist())))
    assert_array_equal(vertices, places)


def test_volumes_of_cells_give_the_surface_around_them(tmp_path):
    """Two cells of every kind side by side: the wall between them is inside, and the volume is that of both."""
    square = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        dtype=float,
    )
    cube = np.vstack([square, square + np.array([0, 0, 1])])
    twice = np.vstack([cube, square + np.array([0, 0, 2])])
    hexahedra = meshio.Mesh(
        twice,
        [("hexahedron", [[*range(8)], [*range(4, 12)]])],
    )
    wedges = meshio.Mesh(
        cube,
        [("wedge", [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]])],
    )
    tips = np.vstack([square, [[0.5, 0.5, 1], [0.5, 0.5, -1]]])
    pyramids = meshio.Mesh(
        tips,
        [("pyramid", [[0, 1, 2, 3, 4], [0, 3, 2, 1, 5]])],
    )
    tetrahedra = meshio.Mesh(
        tips,
        [("tetra", [[0, 1, 2, 4], [0, 2, 3, 4]])],
    )
    for cells, n_faces, volume in (
        (hexahedra, 20, 2),
        (wedges, 12, 1),
        (pyramids, 8, 2 / 3),
        (tetrahedra, 6, 1 / 3),
    ):
        for suffix in ("vtk", "vtu"):
            meshio.write(tmp_path / f"cells.{suffix}", cells)
            mesh = load_mesh(tmp_path / f"cells.{suffix}")
            assert len(mesh.faces) == n_faces
            assert mesh.volume == pytest.approx(volume)
            for note in mesh.notes:
                assert "inside out" not in note


def test_a_strip_of_a_ply_file_turns_its_triangles_alike(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    # The last is none
    (tmp_path / "a.ply").write_text(head + "0 0 0\n1 0 0\n0 1 0\n0 0 1\n9 1 0 2 3 1 0 -1 0 1\n")
    mesh = load_mesh(tmp_path / "a.ply", LoadOptions(mend="never"))
    strip = trimesh.util.triangle_strips_to_faces([[1, 0, 2, 3, 1, 0]])
    assert_array_equal(mesh.faces, strip)
    assert mesh.volume == pytest.approx(1 / 6)


def test_strips_and_polygons_of_vtk_files(tmp_path):
    """A tetrahedron as a strip, and a prism of two pentagons and five quadrilaterals."""
    head = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\n"
    corners = "POINTS 4 float\n0 0 0 1 0 0 0 1 0 0 0 1\n"
    (tmp_path / "strip.vtk").write_text(head + corners + "TRIANGLE_STRIPS 1 7\n6 0 1 2 3 0 1\n")
    assert load_mesh(tmp_path / "strip.vtk").volume == pytest.approx(1 / 6)
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack(
        [np.cos(angle), np.sin(angle), np.zeros(5)],
        axis=1,
    )
    sides = [[i, (i + 1) % 5, (i + 1) % 5 + 5, i + 5] for i in range(5)]
    polygons = [[4, 3, 2, 1, 0], [5, 6, 7, 8, 9], *sides]
    cells = "".join(" ".join(map(str, [len(row), *row])) + "\n" for row in polygons)
    text = f"POINTS 10 double\n{lines(np.vstack([ring, ring + np.array([0, 0, 1])]))}POLYGONS 7 37\n{cells}"
    (tmp_path / "prism.vtk").write_text(head + text)
    mesh = load_mesh(tmp_path / "prism.vtk")
    assert len(mesh.faces) == 16
    assert mesh.volume == pytest.approx(2.5 * np.sin(2 * np.pi / 5))


FAULTY = {
    "four.off": (b"4" + off().replace("\n3 ", " 2\n3 ").encode(), "4OFF"),
    "binary.off": (b"OFF BINARY\n\0\0\0\4\0\0\0\4\0\0\0\0" + bytes(112), "OFF BINARY"),
    "strips.ply": (strips_ply("")[:-40], "expected 1 rows of tristrips, got fewer"),
    "cut.ply": (
        trimesh.exchange.ply.export_ply(SOLID, encoding="ascii")[:-40],
        "expected .* rows of face, got fewer",
    ),
    "cut.vtk": (polydata("3.0")[:4000].encode(), "expected .* numbers, got"),
    "huge.vtk": (
        b"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET POLYDATA\nPOINTS 1000000000 float\n",
        "numbers, got",
    ),
    "image.vtk": (
        b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\n",
        "STRUCTURED_POINTS",
    ),
    "cut.vtp": (
        vtp("raw").replace(
            np.uint32(12 * len(VERTICES)).tobytes(),
            b"\xff\xff\xff\x7f",
            1,
        ),
        "bytes, got",
    ),
    "lz4.vtu": (b'<VTKFile compressor="vtkLZ4DataCompressor"/>', "vtkLZ4DataCompressor"),
    "curved.vtk": (
        b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 6 float\n"
        + b"0 0 1\n" * 6
        + b"CELLS 1 7\n6 0 1 2 3 4 5\nCELL_TYPES 1\n22\n",
        "type 22",
    ),
    "axes.gii": (
        b"<GIFTI><DataArray Intent='NIFTI_INTENT_POINTSET' DataType='NIFTI_TYPE_INT32' Dimensionality='7'/></GIFTI>",
        "7 axes",
    ),
    "map.gii": (
        b"<GIFTI><DataArray Intent='NIFTI_INTENT_SHAPE'/></GIFTI>",
        "expected points and triangles",
    ),
    "lh.white": (b"\xff\xff\xfemade\n\n" + b"\x7f\xff\xff\xff" * 2, "expected .* vertices"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "counted from 1"),
    "entities.vtu": (
        b'<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]><VTKFile>&c;</VTKFile>',
        "entity",
    ),
    "file.gii": (
        b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><GIFTI>&b;</GIFTI>',
        "entity",
    ),
    "empty.3mf": (b"PK\x05\x06" + bytes(18), "no model"),
}


@pytest.mark.parametrize("name", sorted(FAULTY))
def test_what_is_wrong_with_a_file_is_told_in_a_sentence_that_names_it(name, tmp_path):
    content, words = FAULTY[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=rf"{name}: not readable as .*{words}.*\. .*[Ee]xport"):
        load_mesh(tmp_path / name)


@pytest.mark.parametrize("name", ["text.vtp", "polygons3.vtk", "text.stl"])
def test_one_long_number_does_not_widen_all_others(name, tmp_path):
    WRITERS[name](tmp_path / name)
    content = (tmp_path / name).read_bytes()
    word = re.findall(rb"\d\.\d{6,}", content)[5]  # those before may be of a normal
    (tmp_path / name).write_bytes(
        content.replace(
            word,
            word + b"0" * 30_000,
            1,
        )
    )
    tracemalloc.start()
    mesh = load_mesh(tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert_array_equal(mesh.vertices[mesh.faces], VERTICES[FACES])
    assert peak < 8e6


def test_arrays_in_one_place_count_as_often_as_they_are_named(tmp_path):
    head, piece, tail = re.split(rb"(<Piece>.*</Piece>)", vtp("raw"), maxsplit=1)
    (tmp_path / "a.vtp").write_bytes(head + 20 * piece + tail)
    once = 12 * len(VERTICES) + 32 * len(FACES)
    options = LoadOptions(bodies="objects", max_unpacked=20 * once)
    assert len(list_bodies(tmp_path / "a.vtp", options)) == 20
    with pytest.raises(MeshError, match=r"a\.vtp: unpacks to .*max_unpacked="):
        load_mesh(tmp_path / "a.vtp", LoadOptions(max_unpacked=10 * once))


def test_an_array_that_promises_too_much_is_not_unpacked(tmp_path):
    gifti(tmp_path / "a.gii", "GIFTI_ENCODING_B64GZ")
    text = (tmp_path / "a.gii").read_text()
    (tmp_path / "a.gii").write_text(text.replace(f'Dim0="{len(VERTICES)}"', 'Dim0="1000000000000"'))
    with pytest.raises(MeshError, match=r"a\.gii: unpacks to .* GB or more"):
        load_mesh(tmp_path / "a.gii")
    (tmp_path / "a.gii").write_text(text.replace(f'Dim0="{len(VERTICES)}"', 'Dim0="10"'))
    with pytest.raises(MeshError, match="a block unpacks to"):
        load_mesh(tmp_path / "a.gii")


def bracket():
    """A prism over a C of area 10 and perimeter 22: octagons whose first corner sees not all others, and squares."""
    outline = np.array(
        [[4, 0], [4, 1], [1, 1], [1, 3], [4, 3], [4, 4], [0, 4], [0, 0]],
        float,
    )
    vertices = np.concatenate(
        [
            np.c_[outline, np.zeros(8)],
            np.c_[outline, np.ones(8)],
        ]
    )
    sides = [[i, (i + 1) % 8, 8 + (i + 1) % 8, 8 + i] for i in range(8)]
    return vertices, [
        [*range(7, -1, -1)],
        [*range(8, 16)],
        *sides,
    ]


def text_of(rows, counted=True):
    return "".join(f"{len(row)} " * counted + " ".join(map(str, row)) + "\n" for row in rows)


def ply_of(vertices, faces, order=""):
    """A PLY file with a colour before and behind the corners of each face; as text without an order."""
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"ply\nformat {kind} 1.0\ncomment made here\nelement vertex {len(vertices)}\n"
    head += "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    head += (
        f"element face {len(faces)}\nproperty short group\nproperty list uchar int vertex_indices\n"
    )
    head += "property uchar red\nend_header\n"
    if not order:
        rows = "".join(" ".join(map(str, row)) + " 9\n" for row in vertices.tolist())
        polygons = "".join(f"5 {len(row)} {' '.join(map(str, row))} 9\n" for row in faces)
        return (head + rows + polygons).encode()
    body = b"".join(np.array(row, f"{order}f4").tobytes() + b"\x09" for row in vertices)
    for row in faces:
        body += np.array(5, f"{order}i2").tobytes() + bytes([len(row)])
        body += np.array(row, f"{order}i4").tobytes() + b"\x09"
    return head.encode() + body


def polygon_files():
    vertices, faces = bracket()
    places = "".join(" ".join(map(str, row)) + "\n" for row in vertices.tolist())
    size = sum(len(row) + 1 for row in faces)
    offsets = " ".join(
        map(
            str,
            np.cumsum([len(row) for row in faces]),
        )
    )
    arrays = (
        f'<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">{places}</DataArray></Points><Polys>'
        f'<DataArray type="Int64" Name="connectivity" format="ascii">{text_of(faces, False)}</DataArray>'
        f'<DataArray type="Int64" Name="offsets" format="ascii">{offsets}</DataArray></Polys>'
    )
    vtk = f"# vtk DataFile Version 3.0\nmade\nASCII\nDATASET POLYDATA\nPOINTS 16 float\n{places}POLYGONS 10 {size}\n"
    coloured = "".join(f"{row} 0.5 0.5 0.5 # grey\n" for row in text_of(faces).splitlines())
    return {
        "plain.off": f"OFF\n16 10 0\n{places}{text_of(faces)}".encode(),
        "coloured.off": f"OFF\n# made here\n\n16 10\n{places}{coloured}".encode(),
        "text.ply": ply_of(vertices, faces),
        "little.ply": ply_of(vertices, faces, "<"),
        "big.ply": ply_of(vertices, faces, ">"),
        "made.vtk": (vtk + text_of(faces)).encode(),
        "made.vtp": f'<VTKFile type="PolyData"><PolyData><Piece>{arrays}</Piece></PolyData></VTKFile>'.encode(),
    }


@pytest.mark.parametrize("name", polygon_files())
def test_concave_polygons_of_any_format_do_not_fold(name, tmp_path):
    content = polygon_files()[name]
    (tmp_path / name).write_bytes(content)
    mesh = load_mesh(tmp_path / name, LoadOptions(mend="never"))
    assert_array_equal(mesh.vertices, bracket()[0])
    assert mesh.volume == pytest.approx(10)
    assert mesh.area == pytest.approx(2 * 10 + 22)
    (tmp_path / name).write_bytes(content[: len(content) - len(content) // 8])
    with pytest.raises(MeshError, match=name):
        load_mesh(tmp_path / name)


def test_squares_are_what_trimesh_makes_of_them(tmp_path):
    faces = [
        [0, 3, 2, 1],
        [4, 5, 6, 7],
        [0, 1, 5, 4],
        [1, 2, 6, 5],
        [2, 3, 7, 6],
        [3, 0, 4, 7],
    ]
    square = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        float,
    )
    vertices = np.concatenate([square, square + np.array([0, 0, 1])])
    (tmp_path / "one.off").write_text(f"OFF\n8 6 0\n{lines(vertices)}{text_of(faces)}")
    for name, order in (("text", ""), ("little", "<"), ("big", ">")):
        (tmp_path / f"{name}.ply").write_bytes(ply_of(vertices, faces, order))
    for path in tmp_path.iterdir():
        found = load_mesh(path)
        expected = trimesh.load(path, process=False)
        assert_array_equal(found.vertices, expected.vertices)
        assert_array_equal(found.faces, expected.faces)


def test_files_are_known_by_the_longest_suffix_and_maps_on_surfaces_are_none():
    assert format_of("a.tar.gz").name == "an archive"
    assert format_of("A.OFF").name == "OFF"
    assert format_of("fsaverage/surf/lh.pial") is not None
    assert format_of("pial") is format_of("a.txt") is format_of("a.label.gii") is None
    assert is_searched("a.stl")
    assert not is_searched("a.zip")
    suffixes = [suffix for one in all_formats() for suffix in one.suffixes]
    assert len(set(suffixes)) == len(suffixes)
    for suffix in suffixes:
        assert suffix == suffix.lower()


def test_an_unknown_format_is_told_with_those_that_are_known(tmp_path):
    (tmp_path / "a.blend").write_bytes(b"x")
    with pytest.raises(MeshError, match=r"a\.blend: unknown file format.*\.off.*\.3mf"):
        read_surface(tmp_path / "a.blend")

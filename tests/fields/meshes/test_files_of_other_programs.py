"""Files as other programs write them: read as what they are, or refused by name."""

import json
import struct
import zipfile

import nibabel
import numpy as np
import pytest
import SimpleITK
import tifffile
import trimesh

from igps.fields.volumes.label_names import read_label_names
from igps.mesh.errors import MeshError
from igps.mesh.loading import each_body, load_mesh
from igps.mesh.options import LoadOptions

BOX = trimesh.creation.box((2, 3, 4))
FACES = BOX.faces.tolist()
VOLUME = 24.0


# STL as text


def stl_text(name="box"):
    lines = [f"solid {name}"]
    for corners in BOX.triangles:
        lines.append("facet normal 0 0 0")
        lines.append("outer loop")
        lines.extend(f"vertex {x} {y} {z}" for x, y, z in corners)
        lines.extend(["endloop", "endfacet"])
    return "\n".join([*lines, f"endsolid {name}\n"])


@pytest.mark.parametrize(
    "content",
    [
        stl_text().encode("utf-8-sig"),
        stl_text().encode("utf-16"),
        stl_text("vertex 1 2 3").encode(),
        stl_text().replace("\n", "\r\n").encode(),
        stl_text().replace("\n", " ").encode(),
    ],
)
def test_stl_as_text(content, tmp_path):
    (tmp_path / "box.stl").write_bytes(content)
    assert load_mesh(tmp_path / "box.stl").volume == pytest.approx(VOLUME)


def test_binary_stl_whose_header_reads_like_text(tmp_path):
    content = bytearray(BOX.export(file_type="stl"))
    content[:20] = b"solid facet vertex 1"
    (tmp_path / "box.stl").write_bytes(bytes(content) + b"end")
    assert load_mesh(tmp_path / "box.stl").volume == pytest.approx(VOLUME)


# OFF


@pytest.mark.parametrize("word", ["Off ", "", "COFF\n", "# a comment\noff\n"])
def test_off_with_its_word_in_any_case_or_without(word, tmp_path):
    text = BOX.export(file_type="off")
    assert text.startswith("OFF\n")
    (tmp_path / "box.off").write_text(word + text.removeprefix("OFF\n"))
    assert load_mesh(tmp_path / "box.off").volume == pytest.approx(VOLUME)


# PLY with texture coordinates


def ply(order, lists_first):
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    of_faces = ["property list uchar int vertex_indices", "property list uchar float texcoord"]
    if lists_first:
        of_faces.reverse()
    header = ["ply", f"format {kind} 1.0", f"element vertex {len(BOX.vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(FACES)}", *of_faces, "end_header\n"]
    body = b""
    for vertex in BOX.vertices:
        text = " ".join(map(str, vertex)) + "\n"
        body += struct.pack(f"{order}3f", *vertex) if order else text.encode()
    for polygon in FACES:
        uv = [0.5] * (2 * len(polygon))
        corners = struct.pack(f"{order or '<'}B{len(polygon)}i", len(polygon), *polygon)
        texture = struct.pack(f"{order or '<'}B{len(uv)}f", len(uv), *uv)
        lists = [corners, texture]
        words = [[len(polygon), *polygon], [len(uv), *uv]]
        if lists_first:
            lists.reverse()
            words.reverse()
        text = " ".join(str(word) for row in words for word in row) + "\n"
        body += b"".join(lists) if order else text.encode()
    return "\n".join(header).encode() + body


@pytest.mark.parametrize(
    ("order", "lists_first"),
    [("", True), ("<", False), (">", True)],
)
def test_ply_with_lists_of_texture_coordinates(order, lists_first, tmp_path):
    (tmp_path / "box.ply").write_bytes(ply(order, lists_first))
    mesh = load_mesh(tmp_path / "box.ply")
    assert mesh.volume == pytest.approx(VOLUME)
    assert len(mesh.faces) == 12


# 3MF: what is not material


SMALL = trimesh.creation.box((1, 2, 2))  # half of it stands out of the larger box
SMALL.apply_translation([1, 0, 0])
CUT = VOLUME - 2.0  # without the half of the small box that is within


def model(objects, items):
    start = '<?xml version="1.0"?><model unit="millimeter" xmlns="http://schemas.microsoft.com/'
    start += '3dmanufacturing/core/2015/02"><resources>'
    return f"{start}{objects}</resources><build>{items}</build></model>"


def mesh_xml(*meshes):
    whole = trimesh.util.concatenate(list(meshes))
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in whole.vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in whole.faces)
    return f"<mesh><vertices>{points}</vertices><triangles>{triangles}</triangles></mesh>"


def write_3mf(path, content, settings=None):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", content)
        for name, text in (settings or {}).items():
            archive.writestr(name, text)
    return path


def prusa(path, role, key="volume_type"):
    both = f'<object id="1" type="model">{mesh_xml(BOX, SMALL)}</object>'
    content = model(both, '<item objectid="1"/>')
    settings = (
        '<config><object id="1"><volume firstid="0" lastid="11"/><volume firstid="12" lastid="23">'
        f'<metadata type="volume" key="{key}" value="{role}"/></volume></object></config>'
    )
    return write_3mf(path, content, {"Metadata/Slic3r_PE_model.config": settings})


def orca(path, role):
    parts = f'<object id="1">{mesh_xml(BOX)}</object><object id="2">{mesh_xml(SMALL)}</object>'
    whole = '<object id="3"><components><component objectid="1"/><component objectid="2"/>'
    content = model(f"{parts}{whole}</components></object>", '<item objectid="3"/>')
    settings = (
        '<config><object id="3"><part id="1" subtype="normal_part"/>'
        f'<part id="2" subtype="{role}"/></object></config>'
    )
    return write_3mf(path, content, {"Metadata/model_settings.config": settings})


def test_negative_parts_are_cut_away(tmp_path):
    for path in (
        prusa(tmp_path / "prusa.3mf", "NegativeVolume"),
        orca(tmp_path / "orca.3mf", "negative_part"),
    ):
        mesh = load_mesh(path)
        assert mesh.volume == pytest.approx(CUT)
        assert "cut away 1 negative part" in mesh.notes


def test_modifiers_and_supports_are_left_out(tmp_path):
    for path in (
        prusa(tmp_path / "blocker.3mf", "SupportBlocker"),
        prusa(tmp_path / "slic3r.3mf", "1", key="modifier"),
        orca(tmp_path / "enforcer.3mf", "support_enforcer"),
    ):
        mesh = load_mesh(path)
        assert mesh.volume == pytest.approx(VOLUME)
        assert any(note.startswith("left out 1 part ") for note in mesh.notes)


def test_other_parts_are_united(tmp_path):
    for path in (
        prusa(tmp_path / "prusa.3mf", "ModelPart"),
        orca(tmp_path / "orca.3mf", "normal_part"),
    ):
        assert load_mesh(path).volume == pytest.approx(VOLUME + 2.0)


def test_items_that_are_not_to_be_printed_are_left_out(tmp_path):
    parts = f'<object id="1">{mesh_xml(BOX)}</object><object id="2">{mesh_xml(SMALL)}</object>'
    items = '<item objectid="1"/><item objectid="2" printable="0"/>'
    mesh = load_mesh(write_3mf(tmp_path / "box.3mf", model(parts, items)))
    assert mesh.volume == pytest.approx(VOLUME)
    assert mesh.notes == ("left out 1 item not to be printed",)
    only = model(parts, '<item objectid="2" printable="0"/>')
    with pytest.raises(MeshError, match="none of its items is to be printed"):
        load_mesh(write_3mf(tmp_path / "none.3mf", only))


def test_objects_of_type_support_are_left_out(tmp_path):
    parts = f'<object id="1">{mesh_xml(BOX)}</object>'
    parts += f'<object id="2" type="support">{mesh_xml(SMALL)}</object>'
    both = model(parts, '<item objectid="1"/><item objectid="2"/>')
    mesh = load_mesh(write_3mf(tmp_path / "box.3mf", both))
    assert mesh.volume == pytest.approx(VOLUME)
    assert any(note.startswith("left out 1 object ") for note in mesh.notes)
    alone = model(parts, '<item objectid="2"/>')
    with pytest.raises(MeshError, match=r"alone\.3mf.*nothing in it is material"):
        load_mesh(write_3mf(tmp_path / "alone.3mf", alone))


# glTF


def glb(path, **changes):
    """Write the box as one node of two primitives, and lines; `changes` replace entries of the scene."""
    faces = BOX.faces.astype("<u4")
    points = BOX.vertices.astype("<f4").tobytes()
    halves = [faces[:6].tobytes(), faces[6:].tobytes()]
    lines = np.array([0, 1, 1, 2], "<u4").tobytes()
    chunks = [points, *halves, lines]
    starts = np.cumsum([0, *map(len, chunks[:-1])]).tolist()
    views = []
    for start, chunk in zip(starts, chunks, strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(chunk)})
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"}]
    for number, count in ((1, 18), (2, 18), (3, 4)):
        accessor = {"bufferView": number, "componentType": 5125, "count": count, "type": "SCALAR"}
        accessors.append(accessor)
    primitives = [
        {"attributes": {"POSITION": 0}, "indices": 1},
        {"attributes": {"POSITION": 0}, "indices": 2},
        {"attributes": {"POSITION": 0}, "indices": 3, "mode": 1},
    ]
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "part"}],
        "meshes": [{"primitives": primitives}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(map(len, chunks))}],
    }
    text = json.dumps(scene | changes).encode()
    text += b" " * (-len(text) % 4)
    content = b"".join(chunks)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(content), b"BIN\0") + content
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def test_an_object_of_gltf_is_a_node_with_all_its_materials(tmp_path):
    path = glb(tmp_path / "box.glb")
    ((body, mesh),) = each_body(path, LoadOptions(bodies="objects"))
    assert body.part == "part"
    assert mesh.volume == pytest.approx(VOLUME)


def test_two_nodes_of_one_mesh_are_two_objects(tmp_path):
    nodes = [
        {"mesh": 0, "name": "part"},
        {"mesh": 0, "name": "part", "translation": [9, 0, 0]},
    ]
    path = glb(
        tmp_path / "boxes.glb",
        nodes=nodes,
        scenes=[{"nodes": [0, 1]}],
    )
    bodies = list(each_body(path, LoadOptions(bodies="objects")))
    names = sorted(str(ref.part) for ref, _ in bodies)
    assert len(set(names)) == 2
    for _, mesh in bodies:
        assert mesh.volume == pytest.approx(VOLUME)


INSTANCES = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"nodes": [{"mesh": 0, "skin": 0}]}, "a skin deforms it"),
        ({"nodes": [INSTANCES]}, "EXT_mesh_gpu_instancing copies parts"),
        ({"extensionsRequired": ["EXT_unheard_of"]}, "made with EXT_unheard_of"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "compressed by EXT_meshopt"),
    ],
)
def test_what_would_change_the_geometry_of_gltf_is_refused_by_name(changes, cause, tmp_path):
    with pytest.raises(MeshError, match=f"box.glb.*{cause}"):
        load_mesh(glb(tmp_path / "box.glb", **changes))


def test_morph_targets_are_refused_only_if_they_move_something(tmp_path):
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "targets": [{"POSITION": 0}]}
    other = {"attributes": {"POSITION": 0}, "indices": 2, "targets": [{"POSITION": 0}]}
    mesh = {"primitives": [primitive, other], "weights": [0.0]}
    still = glb(tmp_path / "still.glb", meshes=[mesh])
    assert load_mesh(still).volume == pytest.approx(VOLUME)
    moved = glb(tmp_path / "moved.glb", meshes=[mesh | {"weights": [0.5]}])
    with pytest.raises(MeshError, match="weights of morph targets"):
        load_mesh(moved)


def test_materials_that_a_scene_requires_do_not_matter(tmp_path):
    path = glb(tmp_path / "box.glb", extensionsRequired=["KHR_materials_unlit"])
    assert load_mesh(path).volume == pytest.approx(VOLUME)


# Lines, points, missing coordinates, open surfaces


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("line.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 1 1 1\nl 1 2 3 4\n"),
        (
            "line.vtk",
            "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n"
            "0 0 0 1 0 0 1 1 0 1 1 1\nLINES 1 5\n4 0 1 2 3\n",
        ),
        (
            "grid.vtk",
            "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n"
            "0 0 0 1 0 0 1 1 0 1 1 1\nCELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n4\n",
        ),
        (
            "line.vtp",
            '<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="3" NumberOfLines="1"><Points>'
            '<DataArray type="Float32" NumberOfComponents="3" format="ascii">0 0 0 1 0 0 1 1 0'
            '</DataArray></Points><Lines><DataArray type="Int32" Name="connectivity" format="ascii">'
            '0 1 2</DataArray><DataArray type="Int32" Name="offsets" format="ascii">3</DataArray>'
            "</Lines></Piece></PolyData></VTKFile>",
        ),
    ],
)
def test_lines_are_refused(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=f"{name}.*it holds lines"):
        load_mesh(tmp_path / name)


def write_ball(path, n_missing):
    """A ball of radius 1 as text, with vertices that have no coordinates."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    rows = [f"{x} {y} {z}" for x, y, z in ball.vertices]
    for number in range(n_missing):
        rows[17 * number] = "nan nan nan"
    faces = [f"3 {a} {b} {c}" for a, b, c in ball.faces]
    header = ["OFF", f"{len(rows)} {len(faces)} 0"]
    path.write_text("\n".join([*header, *rows, *faces]))
    return path


def test_a_few_vertices_without_coordinates_are_dropped(tmp_path):
    mesh = load_mesh(write_ball(tmp_path / "ball.off", 2))
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=5e-3)
    assert any(note.startswith("dropped 2 vertices without coordinates") for note in mesh.notes)


def test_many_vertices_without_coordinates_are_refused(tmp_path):
    path = write_ball(tmp_path / "ball.off", 100)
    with pytest.raises(MeshError, match=r"ball\.off: 100 vertices with NaN"):
        load_mesh(path)
    few = write_ball(tmp_path / "few.off", 2)
    with pytest.raises(MeshError, match=r"few\.off: 2 vertices with NaN"):
        load_mesh(few, LoadOptions(mend="never"))


def test_an_open_box_is_called_open(tmp_path):
    is_bottom = BOX.triangles_center[:, 2] < -1.99
    box = trimesh.Trimesh(
        BOX.vertices,
        BOX.faces[~is_bottom],
        process=False,
    )
    box.export(tmp_path / "box.off")
    mesh = load_mesh(tmp_path / "box.off")
    (note,) = [note for note in mesh.notes if note.startswith("open: ")]
    assert note.startswith("open: 12% of the surface is missing")  # 6 of 52
    assert "a shell around 24;" in note
    whole = BOX.export(tmp_path / "whole.off")
    assert whole
    for note in load_mesh(tmp_path / "whole.off").notes:
        assert "open" not in note


# Volumes: units and voxels


def block():
    labels = np.zeros((8, 8, 8), np.uint8)
    labels[2:6, 2:6, 2:6] = 1
    return labels


@pytest.mark.parametrize(
    ("unit", "millimetres"),
    [("Microns", 1e-3), ("millimetre", 1.0), ("Meter", 1e3)],
)
def test_units_of_nrrd_as_they_are_written(unit, millimetres, tmp_path):
    header = (
        "NRRD0004\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\nsizes: 8 8 8\n"
        "space directions: (2,0,0) (0,2,0) (0,0,2)\nencoding: raw\n"
        f'space units: "{unit}" "{unit}" "{unit}"\n\n'
    )
    (tmp_path / "block.nrrd").write_bytes(header.encode() + block().tobytes())
    mesh = load_mesh(tmp_path / "block.nrrd")
    assert mesh.unit == "mm"
    assert mesh.volume == pytest.approx(64 * (2 * millimetres) ** 3, rel=0.01)


@pytest.mark.parametrize("extra", ["", "axis mins: 0 0 0\naxis maxs: 16 16 16\n"])
def test_nrrd_without_spacing_claims_no_unit(extra, tmp_path):
    header = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 8 8 8\n{extra}encoding: raw\n\n"
    (tmp_path / "block.nrrd").write_bytes(header.encode() + block().tobytes())
    mesh = load_mesh(tmp_path / "block.nrrd")
    assert mesh.unit is None
    (note,) = [note for note in mesh.notes if "voxels were taken as 1 × 1 × 1" in note]
    assert ("minima and maxima" in note) == bool(extra)


def test_two_geometries_of_nifti_that_differ_are_both_named(tmp_path):
    image = nibabel.Nifti1Image(
        block(),
        np.diag([3.0, 3.0, 3.0, 1.0]),
    )
    image.set_qform(
        np.diag([6.0, 6.0, 6.0, 1.0]),
        1,
    )
    image.set_sform(
        np.diag([3.0, 3.0, 3.0, 1.0]),
        1,
    )
    image.to_filename(tmp_path / "block.nii.gz")
    mesh = load_mesh(tmp_path / "block.nii.gz")
    assert mesh.volume == pytest.approx(64 * 27, rel=0.01)
    (note,) = [note for note in mesh.notes if "sform" in note]
    assert "3 × 3 × 3 mm" in note
    assert "6 × 6 × 6 mm" in note


def test_geometries_that_agree_are_not_mentioned(tmp_path):
    image = SimpleITK.GetImageFromArray(block())
    image.SetSpacing((0.7, 0.7, 1.3))
    SimpleITK.WriteImage(image, str(tmp_path / "block.nii.gz"))
    for note in load_mesh(tmp_path / "block.nii.gz").notes:
        assert "sform" not in note


@pytest.mark.parametrize("ome", [True, False])
@pytest.mark.parametrize("share", [0.001, 0.03, 0.2])
def test_a_tiff_that_is_cut_short_is_refused(ome, share, tmp_path):
    sides = {f"PhysicalSize{axis}": 0.5 for axis in "XYZ"}
    imagej = {"axes": "ZYX", "spacing": 0.5, "unit": "um"}
    metadata = {"axes": "ZYX", **sides} if ome else imagej
    labels = np.repeat(
        np.repeat(block(), 4, axis=1),
        4,
        axis=2,
    )
    path = tmp_path / "block.tif"
    tifffile.imwrite(path, labels, ome=ome, imagej=not ome, metadata=metadata)
    whole = load_mesh(path)
    assert whole.unit == "mm"
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * (1 - share))])
    try:
        body = load_mesh(path)
    except MeshError:
        return
    # What was cut holds neither voxels nor their size.
    assert body.volume == whole.volume
    assert body.unit == whole.unit


# Surfaces of brains, and tables


def test_surfaces_of_freesurfer_under_any_ending(tmp_path):
    for name in ("lh.pial.T1", "rh.white.preaparc", "lh.midthickness"):
        nibabel.freesurfer.write_geometry(
            str(tmp_path / name),
            BOX.vertices,
            BOX.faces,
        )
        mesh = load_mesh(tmp_path / name)
        assert mesh.volume == pytest.approx(VOLUME)
        assert mesh.unit == "mm"
    nibabel.freesurfer.write_morph_data(str(tmp_path / "lh.thickness"), np.ones(8))
    with pytest.raises(MeshError, match=r"lh\.thickness: unknown file format"):
        load_mesh(tmp_path / "lh.thickness")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.csv", b"label;name\n1;liver\n2;spleen\n"),
        ("b.csv", b"label\tname\n1\tliver\n2\tspleen\n"),
        ("c.csv", b"label,name\n1.0,liver\n2.0,spleen\n"),
        ("d.csv", "label,name\n1,liver\n2,spleen\n".encode("utf-16")),
        ("e.csv", "\ufeffLabel;Name\r\n1;liver\r\n2;spleen\r\n".encode()),
        ("f.json", b'{"1.0": "liver", "2": "spleen"}'),
        ("g.json", b'{"labels": {"background": 0, "liver": 1, "spleen": 2.0}}'),
    ],
)
def test_tables_of_names_as_spreadsheets_save_them(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert read_label_names(tmp_path / name) == {1: "liver", 2: "spleen"}


def test_a_table_of_names_in_cp1252(tmp_path):
    (tmp_path / "names.csv").write_bytes("label,name\n1,Brücke\n".encode("cp1252"))
    assert read_label_names(tmp_path / "names.csv") == {1: "Brücke"}


@pytest.mark.parametrize("name", ["ball.vtp", "ball.vtk"])
def test_a_file_that_lost_its_cells_is_no_cloud_of_points(name, tmp_path):
    """Damage of one letter left the points alone, and a surface was made around them."""
    points = trimesh.creation.icosphere(subdivisions=2).vertices
    numbers = " ".join(f"{x:.6f}" for x in points.ravel())
    text = (
        f"# vtk DataFile Version 3.0\nball\nASCII\nDATASET POLYDATA\nPOINTS {len(points)} float\n"
    )
    text += f"{numbers}\nPOLYGANS 1 4\n3 0 1 2\n"
    if name.endswith("vtp"):
        counts = f'NumberOfPoints="{len(points)}" NumberOfPolys="320"'
        array = (
            f'<DataArray type="Float32" NumberOfComponents="3" format="ascii">{numbers}</DataArray>'
        )
        text = f'<VTKFile type="PolyData"><PolyData><Piece {counts}><Points>{array}</Points>'
        text += "<Palys/></Piece></PolyData></VTKFile>"
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=r"320 polys are declared, 0 are there|got 'POLYGANS'"):
        load_mesh(tmp_path / name)


def test_a_byte_order_that_damage_has_changed_is_refused(tmp_path):
    points = np.zeros((3, 3), np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    array = nibabel.gifti.GiftiDataArray
    arrays = [array(points, "NIFTI_INTENT_POINTSET"), array(faces, "NIFTI_INTENT_TRIANGLE")]
    content = (
        nibabel.GiftiImage(darrays=arrays).to_xml().replace(b'"LittleEndian"', b'"LitLittleEndian"')
    )
    (tmp_path / "ball.gii").write_bytes(content)
    with pytest.raises(MeshError, match=r"byte order .*, got 'LitLittleEndian'"):
        load_mesh(tmp_path / "ball.gii")


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("a.mha", "NDims = 3\nDimSize = 8 8 8\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"),
        (
            "a.nrrd",
            "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 8 8 8\nspacings: 1 1 nan\nencoding: raw\n\n",
        ),
    ],
)
def test_volumes_without_a_spacing_have_no_unit(name, header, tmp_path):
    mask = np.zeros((8, 8, 8), np.uint8)
    mask[2:6, 2:6, 2:6] = 1
    (tmp_path / name).write_bytes(header.encode() + mask.tobytes())
    ((_, mesh),) = each_body(tmp_path / name)
    assert mesh.unit is None
    assert any(note.endswith("voxels were taken as 1 × 1 × 1") for note in mesh.notes)

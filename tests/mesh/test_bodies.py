"""The bodies of a file: which there are, each by its name, and what one fault costs the others."""

import zipfile

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from tests.fields.cad.step_files import write_step

from igps.mesh.errors import MeshError
from igps.mesh.loading import each_body, list_bodies, load_bodies, load_mesh, read_surface
from igps.mesh.options import LoadOptions
from label_files import write_nifti

OBJECTS = LoadOptions(bodies="objects")
PIECES = LoadOptions(bodies="pieces")
CORNERS = "".join(
    f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
)
FACES = "".join(
    f'<triangle v1="{a}" v2="{b}" v3="{c}"/>'
    for a, b, c in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))
)
MESH = f"<mesh><vertices>{CORNERS}</vertices><triangles>{FACES}</triangles></mesh>"


def plate(path, objects, items, unit=' unit="inch"', **members):
    """A 3MF file."""
    names = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02" xmlns:p="http://p"'
    with zipfile.ZipFile(path, "w") as archive:
        text = (
            f"<model {names}{unit}><resources>{objects}</resources><build>{items}</build></model>"
        )
        archive.writestr("3D/3dmodel.model", text)
        for name, content in members.items():
            archive.writestr(
                f"3D/{name}.model", f"<model {names}><resources>{content}</resources></model>"
            )
    return path


def parts(path, options):
    return [body.part for body in list_bodies(path, options)]


def test_six_copies_on_a_plate_are_six_bodies_in_its_unit(tmp_path):
    items = "".join(
        f'<item objectid="1" transform="1 0 0 0 1 0 0 0 1 {3 * i} 0 0"/>' for i in range(6)
    )
    path = plate(tmp_path / "plate.3mf", f'<object id="1" name="part">{MESH}</object>', items)
    names = ["part", *(f"part ({i})" for i in range(2, 7))]
    assert parts(path, OBJECTS) == names
    found = [str(body) for body in list_bodies(path)]
    assert found == [str(path)]
    bodies = load_bodies(path, OBJECTS)
    assert [body.name for body in bodies] == [f"{path}#{name}" for name in names]
    for i, body in enumerate(bodies):
        found = body.vertices.min(axis=0)
        expected = [3 * i, 0, 0]
        assert_allclose(found, expected)
        assert body.volume == pytest.approx(1 / 6)
        assert body.unit == "in"
    assert len(load_bodies(path, PIECES)) == 6
    assert load_mesh(path, OBJECTS, part="part (3)").vertices[:, 0].min() == 6
    assert len(read_surface(path).faces) == 24


def test_an_object_of_objects_is_one_body_turned_and_mirrored_as_the_plan_says(tmp_path):
    """The second component lies in another member; mirrored, its faces still look outward."""
    mirrored = (
        '<component objectid="7" p:path="/3D/more.model" transform="-2 0 0 0 1 0 0 0 1 0 0 0"/>'
    )
    components = f'<component objectid="1"/>{mirrored}'
    objects = f'<object id="1">{MESH}</object><object id="2" name="pair"><components>{components}</components></object>'
    item = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 10 20 30"/>'
    path = plate(tmp_path / "pair.3mf", objects, item, "", more=f'<object id="7">{MESH}</object>')
    assert parts(path, OBJECTS) == ["pair"]
    raw = read_surface(path, OBJECTS, part="pair")
    assert raw.unit == "mm"
    corners = raw.vertices[raw.faces]
    volumes = np.linalg.det(corners - [10, 20, 30]).reshape(2, 4).sum(axis=1) / 6
    assert_allclose(volumes, [1 / 6, 1 / 3])
    # A quarter turn about z takes x to y: the second reaches from 20 back to 18.
    found = [
        corners[4:, :, 1].min(),
        corners[4:, :, 1].max(),
    ]
    assert_allclose(found, [18, 20])


def test_objects_that_are_made_of_themselves_or_of_thousands_are_refused(tmp_path):
    circle = '<object id="1"><components><component objectid="1"/></components></object>'
    with pytest.raises(MeshError, match="made of themselves"):
        load_mesh(plate(tmp_path / "circle.3mf", circle, '<item objectid="1"/>'))
    tower = f'<object id="0">{MESH}</object>'
    for i in range(1, 12):
        ten = f'<component objectid="{i - 1}"/>' * 10
        tower += f'<object id="{i}"><components>{ten}</components></object>'
    path = plate(tmp_path / "tower.3mf", tower, '<item objectid="11"/>')
    with pytest.raises(MeshError, match=r"tower\.3mf: unpacks to .*max_unpacked"):
        load_mesh(path, LoadOptions(max_unpacked=10**6))


def test_places_in_a_scene_are_bodies(tmp_path):
    scene = trimesh.Scene()
    box = trimesh.creation.box((1, 2, 3))
    for i, name in enumerate(("left", "right")):
        scene.add_geometry(
            box, node_name=name, geom_name="box", transform=np.diag([1, 1, 1 + i, 1.0])
        )
    scene.export(tmp_path / "pair.glb")
    assert sorted(map(str, parts(tmp_path / "pair.glb", OBJECTS))) == ["left", "right"]
    right = load_mesh(tmp_path / "pair.glb", OBJECTS, part="right")
    assert right.volume == pytest.approx(12)
    assert right.unit == "m"


def test_objects_of_an_obj_file_are_bodies_and_without_them_its_groups(tmp_path):
    first = trimesh.creation.box((1, 1, 1))
    second = trimesh.creation.box((1, 1, 2))
    text = ""
    for mark, surface in (("o größe", first), ("o same", second), ("o same", second)):
        text += f"{mark}\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in surface.vertices)
        text += "".join(f"f {a - 8} {b - 8} {c - 8}\n" for a, b, c in surface.faces)
    path = tmp_path / "objects.obj"
    path.write_text(text, encoding="utf-8")
    assert parts(path, OBJECTS) == ["größe", "same", "same (2)"]
    assert [len(body.vertices) for body in load_bodies(path, OBJECTS)] == [8, 8, 8]
    assert load_mesh(path, OBJECTS, part="same").volume == pytest.approx(2)
    path.write_text(text.replace("o ", "g "), encoding="utf-8")
    assert parts(path, OBJECTS) == ["größe", "same"]
    path.write_text(text.replace("o ", "# "), encoding="utf-8")
    assert parts(path, OBJECTS) == [None]


def test_pieces_are_what_is_not_connected_in_the_order_of_the_file(tmp_path):
    """Also in a file of loose triangles; a crumb is no piece, and points are one body."""
    sizes = [1.0, 3.0, 2.0, 0.01]
    boxes = [
        trimesh.creation.box([size] * 3).apply_translation([5 * i, 0, 0])
        for i, size in enumerate(sizes)
    ]
    whole = trimesh.util.concatenate(boxes)
    whole.unmerge_vertices()
    whole.export(tmp_path / "boxes.ply")
    assert parts(tmp_path / "boxes.ply", PIECES) == ["piece 1", "piece 2", "piece 3"]
    bodies = load_bodies(tmp_path / "boxes.ply", PIECES)
    assert_allclose([body.volume for body in bodies], [1, 27, 8], rtol=1e-6)
    for body in bodies:
        assert "left out 1 speck" in body.notes
    # Used by no face
    text = "".join(
        "v {} {} {}\n".format(*place) for place in [*whole.vertices.tolist(), [1e9, 0, 0]]
    )
    text += "".join("f {} {} {}\n".format(*face) for face in (whole.faces + 1).tolist())
    (tmp_path / "boxes.obj").write_text(text)
    assert parts(tmp_path / "boxes.obj", PIECES) == ["piece 1", "piece 2", "piece 3"]
    np.savetxt(
        tmp_path / "cloud.xyz",
        np.random.default_rng(0).random((20, 3)),
    )
    assert parts(tmp_path / "cloud.xyz", PIECES) == [None]


def test_one_bad_body_does_not_cost_the_others(tmp_path, caplog):
    flat = '<triangles><triangle v1="0" v2="0" v3="0"/></triangles>'
    flat = f'<mesh><vertices><vertex x="0" y="0" z="0"/></vertices>{flat}</mesh>'
    objects = f'<object id="1" name="good">{MESH}</object><object id="2" name="bad">{flat}</object>'
    path = plate(tmp_path / "two.3mf", objects, '<item objectid="2"/><item objectid="1"/>')
    assert [body.name for body in load_bodies(path, OBJECTS)] == [f"{path}#good"]
    assert "two.3mf#bad: " in caplog.text
    outcomes = dict(each_body(path, OBJECTS, parts=["bad"]))
    assert [ref.part for ref in outcomes] == ["bad"]
    for fault in outcomes.values():
        assert isinstance(fault, MeshError)
    with pytest.raises(MeshError, match=r"two\.3mf#bad: "):
        load_bodies(plate(tmp_path / "two.3mf", objects, '<item objectid="2"/>'), OBJECTS)


def test_several_bodies_and_unknown_parts_are_told_with_the_names_there_are(tmp_path):
    items = '<item objectid="1"/><item objectid="1"/>'
    path = plate(tmp_path / "two.3mf", f'<object id="1" name="part">{MESH}</object>', items)
    with pytest.raises(
        MeshError, match=r"holds 2 bodies: 'part', 'part \(2\)'\. Name one as part="
    ):
        load_mesh(path, OBJECTS)
    with pytest.raises(MeshError, match=r"has no body 'lid'; there are: 'part', 'part \(2\)'"):
        load_mesh(path, OBJECTS, part="lid")
    trimesh.creation.box().export(tmp_path / "box.off")
    with pytest.raises(
        MeshError, match=r"box\.off: is a single body, and has no body 'lid'\. Leave out the name\."
    ):
        load_mesh(tmp_path / "box.off", part="lid")
    with pytest.raises(ValueError, match="bodies: expected one of whole, labels"):
        LoadOptions(bodies="organs")


def test_what_a_format_does_not_have_is_its_usual_way(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.stl")
    for bodies in ("labels", "chains", "objects"):
        assert parts(tmp_path / "box.stl", LoadOptions(bodies=bodies)) == [None]


@pytest.mark.parametrize(
    ("unit", "scale"),
    [(".MILLI.", 1.0), ("$", 1000.0)],
)
def test_solids_of_a_step_file_are_bodies_in_millimetres(unit, scale, tmp_path):
    """A part of one solid, and one of two; the file is in millimetres or in metres."""
    path = tmp_path / "parts.step"
    pair = [
        ((5, 0, 0), (6, 1, 1)),
        ((10, 0, 0), (12, 2, 2)),
    ]
    write_step(
        path,
        {"lid": [((0, 0, 0), (1, 2, 3))], "pair": pair},
        unit,
    )
    bodies = {body.name.partition("#")[2]: body for body in load_bodies(path, OBJECTS)}
    volumes = {name: body.volume / scale**3 for name, body in bodies.items()}
    expected = pytest.approx(
        {"lid": 6, "pair": 1, "pair (2)": 8},
        rel=1e-6,
    )
    assert volumes == expected
    assert {body.unit for body in bodies.values()} == {"mm"}
    assert bodies["pair (2)"].vertices.max(axis=0) / scale == pytest.approx([12, 2, 2], rel=1e-6)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(MeshError, match=r"parts\.step: OpenCASCADE finds no solid in it"):
        load_mesh(path)


def test_labels_of_a_volume_are_bodies_and_one_too_small_costs_no_other(tmp_path):
    """Two boxes of voxels that touch, beside a label of seven voxels; the whole is both boxes."""
    labels = np.zeros((20, 20, 12), dtype=np.uint8)
    labels[2:8, 2:14, 2:10] = 1
    labels[8:14, 2:14, 2:10] = 5
    labels[18, 18, 2:9] = 9
    write_nifti(tmp_path / "organs.nii.gz", labels, np.diag([1.0, 1.0, 2.0, 1.0]))
    (tmp_path / "names.csv").write_text("label,name\n1,left\n5,right\n9,speck\n")
    path = tmp_path / "organs.nii.gz"
    options = LoadOptions(names=str(tmp_path / "names.csv"))
    assert parts(path, options) == ["left", "right", "speck"]
    outcomes = {ref.part: body for ref, body in each_body(path, options)}
    assert isinstance(outcomes["speck"], MeshError)
    assert str(outcomes["speck"]).startswith(f"{path}#speck: expected at least 8 voxels, got 7")
    for name in ("left", "right"):
        body = load_mesh(path, options, part=name)
        assert body.volume == pytest.approx(6 * 12 * 16, rel=1e-6)
        assert body.unit == "mm"
        np.testing.assert_array_equal(body.vertices, outcomes[name].vertices)
    assert load_mesh(path, LoadOptions(bodies="whole")).volume == pytest.approx(
        2 * 6 * 12 * 16, rel=0.02
    )


def test_chains_of_a_structure_are_bodies_in_angstrom(tmp_path):
    """Two zinc ions far from each other, balls of 1.39 Å."""
    line = "HETATM    {0} ZN    ZN {1}   1      {2:6.3f}   6.134  -6.504  1.00 20.00          ZN\n"
    path = tmp_path / "zinc.pdb"
    path.write_text(line.format(1, "A", 11) + line.format(2, "B", 41))
    assert parts(path, LoadOptions()) == ["chain A", "chain B"]
    for body in load_bodies(path):
        assert body.unit == "Å"
        expected = pytest.approx(
            4 / 3 * np.pi * 1.39**3,
            rel=0.05,
        )
        assert body.volume == expected
    assert parts(path, LoadOptions(bodies="models")) == ["model"]

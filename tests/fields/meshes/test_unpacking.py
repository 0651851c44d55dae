"""What is packed: no more is unpacked than allowed, nothing outside of its folder is read or written."""

import gzip
import io
import json
import sys
import tarfile
import zipfile

import numpy as np
import pytest
import trimesh

from igps.mesh.errors import MeshError
from igps.mesh.loading import each_body, list_bodies, load_mesh, read_surface
from igps.mesh.options import LoadOptions

BOX = trimesh.creation.box((1, 2, 3)).export(file_type="off").encode()
OBJECTS = LoadOptions(bodies="objects")
# A bomb that would unpack to more than is allowed; the test's own limit keeps it small.
LIMIT = 10**6
BOMB = b"# " + bytes(2 * 10**6)


def tar_of(members, compression=""):
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=f"w:{compression}") as archive:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return out.getvalue()


def zip_of(members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def packed(content):
    tars = {"a.tar.gz": tar_of(content, "gz"), "a.txz": tar_of(content, "xz")}
    return {"a.zip": zip_of(content), "a.tar": tar_of(content), **tars}


@pytest.mark.parametrize("name", ["a.zip", "a.tar.gz", "a.txz", "a.off.gz", "a.3mf"])
def test_more_than_is_allowed_is_refused_and_the_remedy_named(name, tmp_path):
    contents = packed({"a.off": BOMB}) | {
        "a.off.gz": gzip.compress(BOMB),
        "a.3mf": zip_of({"3D/3dmodel.model": BOMB}),
    }
    (tmp_path / name).write_bytes(contents[name])
    with pytest.raises(MeshError, match=rf"{name}: unpacks to .*LoadOptions\(max_unpacked="):
        load_mesh(tmp_path / name, LoadOptions(max_unpacked=LIMIT))
    # Nor is it a mesh where it may be unpacked
    with pytest.raises(MeshError, match="not readable"):
        load_mesh(tmp_path / name)


def test_a_size_that_lies_does_not_help(tmp_path):
    """The sizes that a ZIP declares are made small; no more than them is unpacked."""
    content = zip_of({"a.off": BOMB})
    declared = len(BOMB).to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(
        content.replace(
            declared,
            (100).to_bytes(4, "little"),
        )
    )
    with pytest.raises(MeshError, match=r"a\.zip: not readable"):
        load_mesh(tmp_path / "a.zip", LoadOptions(max_unpacked=LIMIT))


@pytest.mark.parametrize("name", ["a.zip", "a.tar.gz", "a.txz", "a.tar"])
def test_files_in_an_archive_are_bodies_and_none_is_written_outside(name, tmp_path):
    stl = trimesh.creation.icosphere(subdivisions=1).export(file_type="stl")
    outside = tmp_path / "outside"
    members = {"in/box.off": BOX, "ball.stl": stl, "notes.txt": b"x"}
    members |= {"../evil.off": BOX, f"{outside}/evil.off": BOX}
    (tmp_path / name).write_bytes(packed(members)[name])
    parts = [body.part for body in list_bodies(tmp_path / name, OBJECTS)]
    assert parts == ["in/box.off", "ball.stl"]
    assert load_mesh(tmp_path / name, OBJECTS, part="in/box.off").volume == pytest.approx(6)
    assert len(read_surface(tmp_path / name).faces) == 12 + 80
    assert not outside.exists()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_links_in_an_archive_lead_nowhere(tmp_path):
    (tmp_path / "secret.off").write_bytes(BOX)
    with tarfile.open(tmp_path / "a.tar", "w") as archive:
        link = tarfile.TarInfo("link.off")
        link.type = tarfile.SYMTYPE
        link.linkname = str(tmp_path / "secret.off")
        archive.addfile(link)
    with pytest.raises(MeshError, match=r"a\.tar: not readable as an archive.*no surface"):
        load_mesh(tmp_path / "a.tar")


def test_a_fault_in_an_archive_names_the_archive(tmp_path):
    (tmp_path / "a.zip").write_bytes(zip_of({"b.off": b"hello"}))
    with pytest.raises(MeshError, match=rf"^{tmp_path}/a\.zip: "):
        load_mesh(tmp_path / "a.zip")
    (tmp_path / "a.txt.gz").write_bytes(gzip.compress(b"hello"))
    with pytest.raises(MeshError, match=r"a\.txt has no suffix"):
        load_mesh(tmp_path / "a.txt.gz")


def test_no_body_of_an_archive_takes_vertices_of_another(tmp_path):
    beyond = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"
    (tmp_path / "a.zip").write_bytes(zip_of({"a.obj": beyond, "b.off": BOX}))
    with pytest.raises(MeshError, match=r"a\.zip: .*a\.obj refers to vertices that are not there"):
        read_surface(tmp_path / "a.zip")


def gltf(uri):
    """A tetrahedron with its numbers in a file beside."""
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "buffers": [{"uri": uri, "byteLength": 48 + 48}],
            "bufferViews": [
                {"buffer": 0, "byteLength": 48},
                {"buffer": 0, "byteOffset": 48, "byteLength": 48},
            ],
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                {"bufferView": 1, "componentType": 5125, "count": 12, "type": "SCALAR"},
            ],
        }
    )


@pytest.mark.parametrize(
    "how",
    [
        {"normalized": True},
        {"sparse": {"count": 1, "indices": {}, "values": {}}},
        {},
    ],
)
def test_coordinates_that_would_be_taken_for_others_are_refused(how, tmp_path):
    """Of a scene whose places are whole numbers, as tools that compress make them."""
    scene = json.loads(gltf("numbers.bin"))
    scene["accessors"][0] |= {"componentType": 5122, **how}
    scene["bufferViews"][0]["byteStride"] = 8
    rows = np.array(
        [[0, 0, 0, 0], [9, 0, 0, 0], [0, 9, 0, 0], [0, 0, 9, 0]],
        dtype="<i2",
    )
    faces = np.array(
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
        dtype="<u4",
    )
    numbers = rows.tobytes().ljust(48, b"\0") + faces.tobytes()
    (tmp_path / "numbers.bin").write_bytes(numbers)
    (tmp_path / "a.gltf").write_text(json.dumps(scene))
    if how:
        words = r"a\.gltf: not readable as glTF.*sparse or normalized"
        with pytest.raises(MeshError, match=words):
            load_mesh(tmp_path / "a.gltf")
    else:
        assert load_mesh(tmp_path / "a.gltf").volume == pytest.approx(9**3 / 6)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "not .*compressed by KHR_draco"),
        ({"mode": 6}, "not readable as .*fans of triangles"),
        ({"count": 10**9}, "unpacks to .*max_unpacked="),
        ({"primitives": 10**4}, "unpacks to .*max_unpacked="),
    ],
)
def test_a_scene_that_is_packed_otherwise_is_told(changed, told, tmp_path, monkeypatch):
    """An array without bytes is one that an extension would unpack. A mesh that stands nowhere uses one array often."""
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    scene = json.loads(gltf("numbers.bin"))
    if "primitives" in changed:
        scene["meshes"].append({"primitives": 10**4 * scene["meshes"][0]["primitives"]})
    elif "count" in changed:
        scene["accessors"].append({"componentType": 5126, "type": "VEC3", **changed})
    else:
        (scene["meshes"][0]["primitives"][0] if "mode" in changed else scene).update(changed)
    (tmp_path / "a.gltf").write_text(json.dumps(scene))
    (tmp_path / "numbers.bin").write_bytes(bytes(96))
    with pytest.raises(MeshError, match=rf"a\.gltf: {told}"):
        load_mesh(tmp_path / "a.gltf", LoadOptions(max_unpacked=LIMIT))


def test_a_scene_reads_files_beside_it_and_none_elsewhere(tmp_path):
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        dtype="<f4",
    )
    faces = np.array(
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
        dtype="<u4",
    )
    folder = tmp_path / "folder"
    folder.mkdir()
    for place in (folder, tmp_path):
        (place / "numbers.bin").write_bytes(vertices.tobytes() + faces.tobytes())
    (folder / "a.gltf").write_text(gltf("numbers.bin"))
    assert load_mesh(folder / "a.gltf").volume == pytest.approx(1 / 6)
    for elsewhere in ("../numbers.bin", str(tmp_path / "numbers.bin")):
        (folder / "a.gltf").write_text(gltf(elsewhere))
        words = r"a\.gltf: not readable as glTF.*outside of its folder"
        with pytest.raises(MeshError, match=words):
            load_mesh(folder / "a.gltf")


@pytest.mark.parametrize("name", ["a.zip"])
def test_hidden_files_that_a_mac_packs_beside_each_are_passed_over(name, tmp_path):
    content = {"b.off": BOX, "__MACOSX/._b.off": b"\0\5\x16\7\0\2Mac OS X", ".git/c.off": BOX}
    (tmp_path / name).write_bytes(packed(content)[name])
    assert load_mesh(tmp_path / name).volume == pytest.approx(6)
    assert [body.part for body in list_bodies(tmp_path / name, OBJECTS)] == ["b.off"]


def test_a_faulty_file_of_an_archive_leaves_the_others_and_is_missed_in_the_whole(tmp_path):
    (tmp_path / "a.zip").write_bytes(zip_of({"bad.off": b"OFF\n8 12 0\n0 0 0\n", "good.off": BOX}))
    with pytest.raises(MeshError, match=r"a\.zip: bad\.off: not readable as OFF"):
        load_mesh(tmp_path / "a.zip")
    (_, bad), (_, good) = each_body(tmp_path / "a.zip", OBJECTS)
    assert isinstance(bad, MeshError)
    assert "a.zip: bad.off: not readable as OFF" in str(bad)
    assert not isinstance(good, MeshError)
    assert good.volume == pytest.approx(6)

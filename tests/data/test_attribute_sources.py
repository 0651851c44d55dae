"""What a body brings along: images, grids, values at vertices, residues; and what is refused."""

import gzip
import logging
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.testing import assert_allclose
from trimesh.creation import icosphere

from bodies_on_disk import write_body
from igps.data.attribute_sources import (
    attribute_source,
    attribute_sources,
    fill_missing,
)
from igps.data.dataset import SignatureDataset
from igps.fields.meshes.vertex_attributes import VertexAttribute
from igps.fields.molecules.residue_attributes import ResidueAttribute
from igps.fields.volumes.image_attribute import ImageAttribute
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=50)
SLOPE = np.array([0.7, -1.3, 2.1])
# Turned, of unlike sides, and shifted: nothing agrees with the axes.
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
AFFINE = np.eye(4)
AFFINE[:3, :3] = TURN * [0.31, 0.23, 0.4]
AFFINE[:3, 3] = TURN @ [-3.1, -3.0, -3.3]
SHAPE = (22, 27, 17)
PLACES = np.moveaxis(np.indices(SHAPE), 0, -1)  # of voxels
INSIDE = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))


def linear(points):
    return points @ SLOPE + 0.4


def image():
    """The linear function at the centres of all voxels."""
    return linear(PLACES @ AFFINE[:3, :3].T + AFFINE[:3, 3])


def write_nifti(path, values):
    nibabel = pytest.importorskip("nibabel")
    made = nibabel.Nifti1Image(values, AFFINE)
    made.header.set_xyzt_units("mm")
    nibabel.save(made, path)


def write_itk(path, values):
    itk = pytest.importorskip("SimpleITK")
    made = itk.GetImageFromArray(np.ascontiguousarray(values.T))
    to_lps = np.diag([-1.0, -1.0, 1.0])
    spacing = norm(AFFINE[:3, :3], axis=0)
    made.SetSpacing(spacing.tolist())
    made.SetDirection((to_lps @ AFFINE[:3, :3] / spacing).ravel().tolist())
    made.SetOrigin((to_lps @ AFFINE[:3, 3]).tolist())
    itk.WriteImage(made, str(path))


@pytest.fixture
def body(tmp_path):
    write_body(tmp_path / "egg.off", 1.1, 1.3)
    return BodyRef(tmp_path / "egg.off")


@pytest.mark.parametrize(
    ("suffix", "write"),
    [(".nii.gz", write_nifti), (".nrrd", write_itk)],
)
def test_an_image_gives_a_linear_function_wherever_it_lies(body, suffix, write):
    write(body.path.with_name(f"egg{suffix}"), image())
    source = attribute_source(f"{{stem}}{suffix}")
    assert_allclose(source(body, INSIDE), linear(INSIDE), atol=1e-5)


@pytest.mark.parametrize("suffix", [".dx", ".mrc"])
def test_a_grid_gives_a_linear_function(body, suffix):
    grids = pytest.importorskip("gridData")
    delta = np.array([0.5, 0.25, 0.5])
    origin = np.array([-5.0, -3.0, -4.0])
    grid = grids.Grid(linear(PLACES * delta + origin), origin=origin, delta=delta)
    grid.export(str(body.path.with_name(f"a{suffix}")))
    assert_allclose(attribute_source(f"a{suffix}")(body, INSIDE), linear(INSIDE), atol=1e-4)


def test_axes_of_a_map_in_another_order_are_put_right(body):
    mrcfile = pytest.importorskip("mrcfile")
    delta = np.array([0.5, 0.25, 0.5])
    start = np.array([-10, -12, -8])
    values = linear((PLACES + start) * delta).astype(np.float32)
    with mrcfile.new(body.path.with_name("a.map")) as file:
        # Columns along z, rows along x, sections along y
        file.set_data(np.ascontiguousarray(values.transpose(1, 0, 2)))
        file.voxel_size = tuple(delta)
        file.header.mapc = 3
        file.header.mapr = 1
        file.header.maps = 2
        file.header.nxstart, file.header.nystart, file.header.nzstart = start[[2, 0, 1]]
    assert_allclose(attribute_source("a.map")(body, INSIDE), linear(INSIDE), atol=1e-4)


@pytest.mark.parametrize("told", ["start", "both"])
def test_a_map_is_placed_by_its_origin_or_else_by_its_start(told, body):
    """If both are given, only the origin counts, as in Chimera, EMAN and IMP. The oracle is a linear function."""
    mrcfile = pytest.importorskip("mrcfile")
    start = np.array([-10, -12, -8])
    with mrcfile.new(body.path.with_name("a.mrc")) as file:
        file.set_data(np.ascontiguousarray(linear((PLACES + start) * 0.5).astype(np.float32).T))
        file.voxel_size = 0.5
        if told != "start":
            file.header.origin = tuple(0.5 * start)
        if told != "origin":
            file.header.nxstart, file.header.nystart, file.header.nzstart = start
    assert_allclose(attribute_source("a.mrc")(body, INSIDE), linear(INSIDE), atol=1e-4)


@pytest.mark.parametrize(
    ("values", "size", "message"),
    [
        (np.ones((9, 9, 9), np.float32), 0, "voxels of .*0"),
        (np.ones((9, 9, 9), np.complex64), 0.5, "complex numbers"),
    ],
)
def test_a_map_of_no_use_is_refused(values, size, message, body):
    mrcfile = pytest.importorskip("mrcfile")
    with mrcfile.new(body.path.with_name("a.mrc")) as file:
        file.set_data(values)
        file.voxel_size = size
    with pytest.raises(
        MeshError, match=rf"a\.mrc: expected real numbers in voxels of known size, got {message}"
    ):
        attribute_source("a.mrc")(body, INSIDE)


def test_a_map_that_was_cut_short_is_to_be_exported_again(body):
    mrcfile = pytest.importorskip("mrcfile")
    path = body.path.with_name("a.mrc")
    with mrcfile.new(path) as file:
        file.set_data(np.ones((9, 9, 9), np.float32))
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(
        MeshError, match=r"a\.mrc: expected 3940 bytes, got 3936\. Export it again\.$"
    ):
        attribute_source("a.mrc")(body, INSIDE)


def write_ply(path, mesh, values):
    numbers = np.column_stack([mesh.vertices, values]).tolist()
    rows = "\n".join(" ".join(map(repr, row)) for row in numbers)
    faces = "\n".join("3 " + " ".join(map(str, face)) for face in mesh.faces)
    names = "\n".join(f"property double {name}" for name in ("x", "y", "z", "height"))
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(mesh.vertices)}\n{names}\nelement face {len(mesh.faces)}\n"
        f"property list uchar int vertex_indices\nend_header\n{rows}\n{faces}\n"
    )


def write_vtk(path, mesh, values):
    meshio = pytest.importorskip("meshio")
    arrays = {"height": values, "other": np.zeros((len(values), 3))}
    meshio.Mesh(mesh.vertices, [("triangle", mesh.faces)], point_data=arrays).write(path)


def write_vtk_of_vtk(path, mesh, values):
    """With the notes that VTK writes behind arrays of a field."""
    n = len(values)
    faces = len(mesh.faces)
    points, heights, triangles = (
        " ".join(map(str, a.ravel())) for a in (mesh.vertices, values, mesh.faces)
    )
    head = f"# vtk DataFile Version 5.1\nvtk output\nASCII\nDATASET POLYDATA\nPOINTS {n} double\n{points}\n"
    offsets = " ".join(map(str, range(0, 3 * faces + 1, 3)))
    cells = f"POLYGONS {faces + 1} {3 * faces}\nOFFSETS vtktypeint64\n{offsets}\nCONNECTIVITY vtkIdType\n{triangles}\n"
    notes = "METADATA\nINFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1 \n\n"
    field = f"FIELD FieldData 2\nother 1 {n} double\n{heights}\n{notes}height 1 {n} double\n{heights}\n{notes}"
    path.write_text(f"{head}{cells}\nPOINT_DATA {n}\n{field}")


def write_gifti(path, mesh, values):
    nibabel = pytest.importorskip("nibabel")
    array = nibabel.gifti.GiftiDataArray(
        values.astype(np.float32), intent="NIFTI_INTENT_SHAPE", meta={"Name": "height"}
    )
    nibabel.save(nibabel.gifti.GiftiImage(darrays=[array]), path)


def write_freesurfer(path, mesh, values):
    nibabel = pytest.importorskip("nibabel")
    nibabel.freesurfer.write_morph_data(str(path), values.astype(np.float32))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.ply#height", write_ply),
        ("a.vtk#height", write_vtk),
        ("a.vtk#height", write_vtk_of_vtk),
        ("a.shape.gii#height", write_gifti),
        ("lh.thickness", write_freesurfer),
    ],
)
def test_values_at_vertices_give_the_same_linear_function_inside(body, name, write):
    mesh = trimesh.load(body.path, process=False)
    path = body.path.with_name(name.partition("#")[0])
    write(path, mesh, linear(mesh.vertices))
    values = VertexAttribute(name)(body, INSIDE)
    assert_allclose(values, linear(INSIDE), atol=1e-3)
    finer = mesh.subdivide()
    write(path, finer, linear(finer.vertices))
    with pytest.raises(MeshError, match=r"has 642 values for 162 vertices"):
        VertexAttribute(name)(body, INSIDE)


@pytest.mark.filterwarnings("ignore:Unknown extension code")
@pytest.mark.parametrize(
    "head",
    [[2, 0, 20], [2, 1, 20], None],
)
def test_an_image_lies_where_it_does_beside_a_surface_of_freesurfer(tmp_path, head):
    """Its origin is in the middle of the image, and its axes are not the world's, unless the file says otherwise."""
    nibabel = pytest.importorskip("nibabel")
    made = nibabel.MGHImage(image().astype(np.float32), AFFINE)
    nibabel.save(made, tmp_path / "t1.mgz")
    ball = icosphere(subdivisions=1)
    mdc = made.header["Mdc"]  # rows are the directions of the axes of voxels
    keys = dict(
        zip(
            ("xras", "yras", "zras", "cras"),
            [*mdc, made.header["Pxyz_c"]],
            strict=True,
        )
    )
    told = {
        "head": head,
        "valid": "1  # volume info valid",
        "filename": "t1.mgz",
        "volume": SHAPE,
        **keys,
    }
    told["voxelsize"] = made.header["delta"]
    nibabel.freesurfer.write_geometry(
        tmp_path / "lh.pial", ball.vertices, ball.faces, volume_info=told if head else None
    )
    from_scanner = np.eye(4)
    if head == [2, 0, 20]:
        from_scanner = made.header.get_vox2ras_tkr() @ np.linalg.inv(made.affine)
    points = INSIDE @ from_scanner[:3, :3].T + from_scanner[:3, 3]
    found = attribute_source("t1.mgz")(BodyRef(tmp_path / "lh.pial"), points)
    assert_allclose(found, linear(INSIDE), atol=1e-4)


def test_values_at_vertices_survive_mending(tmp_path):
    """A ball with a triangle missing: the hole is closed, and a linear function stays one."""
    ball = icosphere(subdivisions=3)
    open_ball = trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False)
    write_ply(tmp_path / "ball.ply", open_ball, linear(open_ball.vertices))
    found = VertexAttribute("{file}#height")(BodyRef(tmp_path / "ball.ply"), INSIDE)
    assert_allclose(found, linear(INSIDE), atol=1e-2)


def test_values_at_the_vertices_of_a_whole_file_serve_each_of_its_bodies(tmp_path):
    """Two balls in one file, whose values jump between them; then values of the second ball alone."""
    ball = icosphere(subdivisions=3)
    away = trimesh.Trimesh(
        ball.vertices + np.array([5, 0, 0]),
        ball.faces,
        process=False,
    )
    both = trimesh.util.concatenate([ball, away])
    values = np.concatenate([linear(ball.vertices), linear(ball.vertices) + 100])
    write_ply(tmp_path / "both.ply", both, values)
    write_ply(tmp_path / "b.ply", away, linear(ball.vertices) + 7)
    rows = [f"v {x} {y} {z}" for x, y, z in both.vertices.tolist()]
    for name, start in (("a", 0), ("b", 1280)):
        rows.append(f"o {name}")
        faces = (both.faces[start : start + 1280] + 1).tolist()
        rows += [f"f {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "two.obj").write_text("\n".join(rows))
    for name, part, shift, added in (
        ("both", "a", 0, 0),
        ("both", "b", 5, 100),
        ("b", "b", 5, 7),
    ):
        source = VertexAttribute(f"{name}.ply#height", reading=LoadOptions(bodies="objects"))
        found = source(
            BodyRef(tmp_path / "two.obj", part),
            INSIDE + np.array([shift, 0, 0]),
        )
        assert_allclose(found, linear(INSIDE) + added, atol=1e-3)
    few = icosphere(subdivisions=1)
    write_ply(tmp_path / "few.ply", few, linear(few.vertices))
    with pytest.raises(
        MeshError, match=r"has 42 values for 642 vertices \(1284 in the whole file\)"
    ):
        replace(source, path="few.ply#height")(BodyRef(tmp_path / "two.obj", "a"), INSIDE)


def test_values_at_the_vertices_of_a_cavity_count(tmp_path):
    """2 on the cavity, 1 outside; in the wall, mean values by an integral over directions, weighted by 1 / distance."""
    ball = icosphere(subdivisions=4)
    pit = icosphere(subdivisions=4, radius=0.5)
    pit.invert()
    hollow = trimesh.util.concatenate([ball, pit])
    radii = norm(hollow.vertices, axis=1)
    hollow.vertex_attributes["heat"] = np.where(radii < 0.9, 2.0, 1.0)
    hollow.export(tmp_path / "ball.ply")
    (tmp_path / "bodies").mkdir()
    hollow.export(tmp_path / "bodies" / "ball.off")
    cosines = np.linspace(-1, 1, 20001)

    def in_wall(radius):
        across = radius**2 * cosines**2 - radius**2
        outside = 1 / (-radius * cosines + np.sqrt(across + 1))
        meets = (cosines < 0) & (across > -0.25)
        root = np.sqrt(np.where(meets, across + 0.25, 0))
        near, far = (
            meets / np.where(meets, -radius * cosines + side * root, 1) for side in (-1, 1)
        )
        return float((outside + 2 * (near - far)).sum() / (outside + near - far).sum())

    for cavities in ("keep", "fill"):
        dataset = SignatureDataset(
            tmp_path / "bodies",
            CONFIG,
            tmp_path / "cache",
            reading=LoadOptions(cavities=cavities),
            attributes={"heat": VertexAttribute("{stem}.ply", tmp_path)},
        )
        inside = dataset[0].signature.interior
        surface = dataset[0].signature.surface
        radii = norm(inside.points, axis=1)
        expected = [in_wall(radius) if cavities == "keep" else 1.0 for radius in radii]
        assert_allclose(inside.attributes["heat"], expected, atol=0.01)
        on_cavity = norm(surface.points, axis=1) < 0.9
        assert on_cavity.any() == (cavities == "keep")
        assert_allclose(surface.attributes["heat"], 1.0 + on_cavity, atol=1e-5)


def test_what_is_missing_is_taken_from_beside_and_told_or_refused(caplog):
    points = np.arange(40.0)[:, None] * [1, 0, 0]
    values = np.arange(40.0)
    for fill in (np.nan, 7e18):
        given = values.copy()
        given[[10, 39]] = fill
        with caplog.at_level(logging.WARNING):
            found = fill_missing(given, points, "here")
        assert found[39] == 38
        assert found[10] in (9, 11)
        np.testing.assert_array_equal(np.delete(found, [10, 39]), np.delete(values, [10, 39]))
        assert "here: 2 of 40 values were taken from the nearest point" in caplog.text
        given[:5] = fill
        with pytest.raises(
            MeshError,
            match=r"here: has no value at 7 of 40 points .* from \(0, 0, 0\) to \(39, 0, 0\)",
        ):
            fill_missing(given, points, "here")


def test_voxels_without_a_value_do_not_leak_into_their_neighbours(body):
    values = image()
    values[:, :, :8] = 7e18
    values[:10] = np.nan
    write_nifti(body.path.with_name("egg.nii"), values)
    source = ImageAttribute("egg.nii")
    found = source.values(body, body.path.with_name("egg.nii"), "", INSIDE)
    known = np.isfinite(found)
    assert 0 < known.sum() < len(known)
    index = (INSIDE - AFFINE[:3, 3]) @ np.linalg.inv(AFFINE[:3, :3]).T
    whole = (index[:, 0] > 10) & (index[:, 2] > 8)
    assert_allclose(found[whole], linear(INSIDE)[whole], atol=1e-5)
    assert known[whole].all()
    assert np.abs(found[known]).max() < 10


def test_an_image_of_another_subject_and_a_grid_beside_the_body_are_refused(body):
    write_nifti(body.path.with_name("egg.nii"), image())
    with pytest.raises(
        MeshError,
        match=r"egg\.nii: has no value at 200 of 200 points of the body, which extends from",
    ):
        ImageAttribute("{stem}.nii")(body, INSIDE + 100)
    with pytest.raises(MeshError, match=r"has no value at \d+ of 200 points"):
        ImageAttribute("{stem}.nii")(body, INSIDE + TURN @ [3.4, 0, 0])


@pytest.mark.parametrize(
    "suffix", [".nii.gz", ".nrrd", ".dx", ".mrc", ".ply", ".vtk", ".vtu", ".gii", ".thickness"]
)
def test_files_cut_short_are_one_sentence(body, suffix):
    path = body.path.with_name(f"a{suffix}")
    mesh = trimesh.load(body.path, process=False)
    if suffix == ".nii.gz":
        write_nifti(path, image())
    elif suffix == ".nrrd":
        write_itk(path, image())
    elif suffix in (".dx", ".mrc"):
        grids = pytest.importorskip("gridData")
        grids.Grid(image(), origin=[-5, -5, -5], delta=[0.5] * 3).export(str(path))
    else:
        writers = {".ply": write_ply, ".gii": write_gifti, ".thickness": write_freesurfer}
        write = writers.get(suffix, write_vtk)
        write(path, mesh, linear(mesh.vertices))
    content = path.read_bytes()
    for share in (0, 0.02, 0.4, 0.6):  # of a PLY file all values are in the first 0.69
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(MeshError, match=r"a\."):
            attribute_source(path.name)(body, INSIDE)


def test_patterns_name_the_file_and_lead_out_of_no_folder(tmp_path):
    write_body(tmp_path / "root" / "ball" / "one.scan.off", 1, 1)
    body = BodyRef(tmp_path / "root" / "ball" / "one.scan.off", "../../x")
    for place in ("images/one.nii", "ct/ball/one.scan.off.nii", "ball/x.nii"):
        (tmp_path / "root" / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "root" / place).write_text("")
    (tmp_path / "x.nii").write_text("")
    root = tmp_path / "root"

    def file(pattern, root=root):
        found, _ = ImageAttribute(pattern, root).file(body)
        return found.relative_to(tmp_path).as_posix()

    assert file("images/{stem}.nii") == "root/images/one.nii"
    assert file(f"{root}/images/{{stem}}.nii", None) == "root/images/one.nii"
    assert file("ct/{file}.nii") == "root/ct/ball/one.scan.off.nii"
    assert file("x.nii", None) == "root/ball/x.nii"
    for pattern in ("../x.nii", "images/{part}.nii", "ct/{part}.nii"):
        with pytest.raises(MeshError, match=r"lies outside of .*root. Put it into that folder"):
            file(pattern)
    with pytest.raises(MeshError, match=r"none\.nii does not exist. Check the pattern 'none.nii'"):
        file("none.nii")


def test_a_body_that_is_a_link_has_the_attribute_of_its_own_name(tmp_path):
    """As git-annex keeps files: all in one store, under other names; and folders that are links."""
    write_body(tmp_path / "root" / "store" / "KEY.off", 1, 1)
    for name in ("cat", "dog"):
        (tmp_path / "root" / name).mkdir()
        (tmp_path / "root" / name / "1.off").symlink_to("../store/KEY.off")
        (tmp_path / "root" / "ct" / name).mkdir(parents=True)
        (tmp_path / "root" / "ct" / name / "1.off.nii").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "root")
    (tmp_path / "root" / "cow").symlink_to(tmp_path / "root" / "dog")
    (tmp_path / "root" / "ct" / "cow").symlink_to(tmp_path / "root" / "ct" / "dog")
    for root, path in (
        ("root", "root/cat"),
        ("link", "root/dog"),
        ("root", "link/dog"),
        ("root", "root/cow"),
    ):
        source = ImageAttribute("ct/{file}.nii", tmp_path / root)
        found = source.file(BodyRef(tmp_path / path / "1.off"))[0]
        assert found.relative_to(tmp_path / root).as_posix() == f"ct/{path[-3:]}/1.off.nii"


@pytest.mark.parametrize(
    ("suffix", "content"),
    [("dx", b"delta"), ("thickness", b"\xff\xff\xff" + bytes(12)), ("nrrd", b"x")],
)
def test_what_is_wrong_with_a_file_names_the_body_whose_it_is(body, suffix, content):
    body.path.with_suffix(f".{suffix}").write_bytes(content)
    with pytest.raises(MeshError) as error:
        attribute_source(f"{{stem}}.{suffix}")(body, INSIDE)
    assert str(error.value).startswith(f"{body}: ")
    assert str(body.path.with_suffix(f".{suffix}")) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("is_absolute", [False, True])
def test_images_among_bodies_are_no_bodies(tmp_path, is_absolute):
    for name in ("ball", "cube"):
        (tmp_path / name).mkdir()
        icosphere(subdivisions=1).export(tmp_path / name / "x.off")
        image = tmp_path / "ct" / name / "x.off.nii.gz"
        image.parent.mkdir(parents=True)
        image.touch()
    pattern = f"{tmp_path}/ct/{{file}}.nii.gz" if is_absolute else "ct/{file}.nii.gz"
    images = attribute_source(pattern, tmp_path)
    dataset = SignatureDataset(tmp_path, cache_dir=tmp_path / ".cache", attributes={"ct": images})
    assert dataset.bodies.names == ("ball/x.off", "cube/x.off")
    assert dataset.classes == ("ball", "cube")
    files = [images.file(body)[0] for body in dataset.bodies]
    assert files == [tmp_path / "ct" / name / "x.off.nii.gz" for name in ("ball", "cube")]
    # What is itself a body's file stays one.
    own = {"thickness": attribute_source("{file}#thickness", tmp_path / "ball")}
    dataset = SignatureDataset(tmp_path / "ball", cache_dir=tmp_path / ".cache", attributes=own)
    assert dataset.bodies.names == ("x.off",)


def test_words_of_the_command_line_become_sources():
    found = attribute_sources(
        ["ct=a/{stem}.nii.gz", "q=charge", "t={file}#t", "e=a.vtu"], Path("root")
    )
    assert found == {
        "ct": ImageAttribute("a/{stem}.nii.gz", Path("root")),
        "q": ResidueAttribute("charge"),
        "t": VertexAttribute("{file}#t", Path("root")),
        "e": VertexAttribute("a.vtu", Path("root")),
    }
    assert pickle.loads(pickle.dumps(found)) == found
    for wrong in ("ct", "=a.nii", "a b=c.nii", "ct="):
        with pytest.raises(
            ValueError, match="attribute: expected a new name and a path, as in ct="
        ):
            attribute_sources([wrong], None)
    with pytest.raises(
        ValueError, match=r"attribute: expected a new name and a path, as in .*, got 'ct=b\.nii'"
    ):
        attribute_sources(["ct=a.nii", "ct=b.nii"], None)


def test_an_image_is_added_to_a_cached_collection_and_again_when_it_changes(tmp_path):
    for name in ("one", "two"):
        write_body(tmp_path / "bodies" / f"{name}.off", 1.1, 1.3)
        write_nifti(tmp_path / "bodies" / f"{name}.nii.gz", image())

    def dataset(**options):
        files = [tmp_path / "bodies" / f"{name}.off" for name in ("one", "two")]
        return SignatureDataset(files, CONFIG, tmp_path / "cache", **options)

    dataset().precompute(n_workers=1, progress=False)
    source = {"ct": ImageAttribute("{stem}.nii.gz")}
    assert dataset(attributes=source).precompute(n_workers=1, progress=False) == []
    with_image = dataset(attributes=source)
    for samples in (with_image[0].signature.interior, with_image[1].signature.surface):
        expected = linear(samples.points)
        assert_allclose(samples.attributes["ct"], expected, atol=1e-5)
    first = dataset(attributes=source).cached_keys()
    write_nifti(tmp_path / "bodies" / "one.nii.gz", image() + 1)
    assert dataset(attributes=source).cached_keys() == [None, first[1]]
    (tmp_path / "bodies" / "two.nii.gz").unlink()
    changed = dataset(attributes=source)
    (failure,) = changed.precompute(n_workers=1, progress=False)
    assert failure.path.name == "two.off"
    assert "two.nii.gz does not exist" in failure.error
    found = changed[0].signature.interior
    expected = linear(found.points) + 1
    assert_allclose(found.attributes["ct"], expected, atol=1e-5)


def test_residues_come_with_the_molecule_and_a_mesh_has_none(tmp_path):
    pytest.importorskip("gemmi")
    line = "ATOM  {:5d} {:<4} {:3} {}{:4d}    {:8.3f}{:8.3f}{:8.3f}  1.00 {:5.2f}           {}\n"
    rows = [
        ("N", 0.0, 1.4),
        ("CA", 0.0, 0.0),
        ("C", 1.5, 0.0),
        ("O", 2.0, 1.0),
    ]
    text = ""
    for chain, name, z in (("A", "LYS", 0.0), ("B", "ASP", 30.0)):
        for i in range(6):
            for j, (atom, x, y) in enumerate(rows):
                place = (x + 3.8 * i, y, z)
                text += line.format(
                    j,
                    f" {atom}",
                    name,
                    chain,
                    i,
                    *place,
                    10.0,
                    atom[0],
                )
    for path, content in (
        (tmp_path / "a.pdb", text.encode()),
        (tmp_path / "b.pdb.gz", gzip.compress(text.encode())),
    ):
        path.write_bytes(content)
        points = np.array([[5.0, 0, 0], [8.0, 0, 0]])
        charge = ResidueAttribute("charge")
        assert_allclose(charge(BodyRef(path, "chain A"), points), 1.0, atol=1e-6)
        assert_allclose(charge(BodyRef(path, "chain B"), points), -1.0, atol=1e-6)
        assert_allclose(charge(BodyRef(path, "model"), points), 1.0, atol=1e-6)
        above = points + np.array([0, 0, 30])
        assert_allclose(charge(BodyRef(path), above), -1.0, atol=1e-6)
    write_body(tmp_path / "egg.off", 1, 1)
    with pytest.raises(
        MeshError, match=r"egg\.off: expected a PDB, mmCIF, BinaryCIF or PQR file for 'charge'"
    ):
        charge(BodyRef(tmp_path / "egg.off"), points)
    with pytest.raises(ValueError, match=r"attribute: expected one of charge, .*, got 'mood'"):
        ResidueAttribute("mood")


@pytest.mark.parametrize(
    "name", ["ct.mha", "header.mhd"]
)  # the latter has its voxels in another file
def test_an_image_that_has_changed_is_read_again_though_its_time_is_the_same(name, tmp_path):
    itk = pytest.importorskip("SimpleITK")
    for value in (1.0, 2.0):
        itk.WriteImage(
            itk.GetImageFromArray(np.full((9, 9, 9), value)),
            str(tmp_path / name),
        )
        os.utime(tmp_path / name, (1e9, 1e9))
        found = attribute_source(name)(
            BodyRef(tmp_path / "egg.off"),
            np.array([[-2.0, -3.0, 4.0]]),
        )
        assert_allclose(found, value)


def test_a_molecule_that_has_changed_is_read_again_though_its_time_is_the_same(tmp_path):
    pytest.importorskip("gemmi")
    body = BodyRef(tmp_path / "one.pdb", "chain A")
    for name, charge in (("ASP", -1.0), ("LYS", 1.0)):
        body.path.write_text(
            f"ATOM      1  CA  {name} A   1       2.000   3.000   4.000  1.00 20.00           C\n"
        )
        os.utime(body.path, (1e9, 1e9))
        assert_allclose(ResidueAttribute("charge")(body, np.zeros((1, 3))), charge)


def test_what_is_known_of_amino_acids_alone_is_refused_of_nucleotides_in_these_words(tmp_path):
    pytest.importorskip("gemmi")
    atom = "ATOM      1  P    DA A   1       2.000   3.000   4.000  1.00 20.00           P\n"
    (tmp_path / "dna.pdb").write_text(atom)
    body = BodyRef(tmp_path / "dna.pdb", "chain A")
    assert ResidueAttribute("residue_shares")(body, INSIDE).shape == (200, 25)
    with pytest.raises(
        MeshError,
        match=r"dna\.pdb#chain A: 'hydropathy' is defined for none of its residues\. Choose",
    ):
        ResidueAttribute("hydropathy")(body, INSIDE)


def test_names_of_blocks_do_not_tell_what_a_body_is(tmp_path):
    pytest.importorskip("gemmi")
    columns = "id type_symbol label_atom_id label_alt_id label_comp_id label_asym_id auth_seq_id"
    places = ("Cartn_x", "Cartn_y", "Cartn_z", "pdbx_PDB_model_num")
    loop = "loop_\n" + "".join(f"_atom_site.{one}\n" for one in [*columns.split(), *places])
    rows = "1 C CA . LYS A 1 0 0 0 1\n2 C CA . ASP A 1 0 0 0 2\n"
    (tmp_path / "two.cif").write_text(
        "".join(f"data_{name}\n{loop}{rows}" for name in ("chain", "assembly"))
    )
    for name in ("chain", "assembly"):
        for number, charge in ((1, 1.0), (2, -1.0)):
            body = BodyRef(tmp_path / "two.cif", f"{name} model {number}")
            assert_allclose(ResidueAttribute("charge")(body, np.zeros((1, 3))), charge)


def with_functions(folder, **functions):
    return SignatureDataset(folder / "shapes", CONFIG, folder / "cache", attributes=functions)


def test_values_of_a_function_are_cached_under_its_tag(tmp_path):
    write_body(tmp_path / "shapes" / "a.off", 0.8, 0.9)
    calls = []

    def function(body, points):
        calls.append(len(points))
        return points[:, 0]

    for _ in range(2):  # without a tag, it is called at each access
        list(with_functions(tmp_path, along=function))
    assert len(calls) == 4
    calls.clear()
    function.cache_tag = "along 1"
    for _ in range(2):
        dataset = with_functions(tmp_path, along=function)
        list(dataset)
    assert len(calls) == 1
    first = dataset.cached_keys()
    function.cache_tag = "along 2"
    dataset = with_functions(tmp_path, along=function)
    list(dataset)
    assert len(calls) == 2
    assert None not in first
    assert dataset.cached_keys() != first


@pytest.mark.parametrize("tag", ["", 1])
def test_a_tag_that_is_no_text_is_refused(tmp_path, tag):
    def height(body, points):
        return points[:, 2]

    height.cache_tag = tag
    write_body(tmp_path / "shapes" / "a.off", 0.8, 0.9)
    with pytest.raises(ValueError, match="expected a text, or a method, as cache_tag of height"):
        with_functions(tmp_path, height=height)


def test_a_body_of_all_models_has_the_residues_of_all(tmp_path):
    pytest.importorskip("gemmi")
    atom = "ATOM      1  CA  {} A   1    {:8.3f}   0.000   0.000  1.00 20.00           C"
    lines = [("MODEL        1", "LYS", 0.0), ("MODEL        2", "ASP", 60.0)]
    text = "\n".join(f"{model}\n{atom.format(name, x)}\nENDMDL" for model, name, x in lines)
    (tmp_path / "two.pdb").write_text(text + "\nEND\n")
    points = np.array([[0.0, 0, 0], [60, 0, 0], [1, 0, 0]])
    charges = ResidueAttribute("charge")(BodyRef(tmp_path / "two.pdb"), points)
    assert_allclose(charges, [1, -1, 1], atol=1e-6)

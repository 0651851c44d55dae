"""What `examine` says of files that were damaged by hand."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from damaged_files import (
    N_FACES,
    N_VERTICES,
    free_edges,
    without_cascadio,
    write_box,
    write_clean,
    write_crossing,
    write_holed,
    write_soup,
    write_unusable,
)
from igps.analysis.doctor import examine, expected_cost
from igps.data.pipeline import SignaturePipeline
from igps.data.sources import find_bodies
from igps.failures import Limits
from igps.fields.volumes.label_measures import VoxelMeasures, thinnest_part
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, load_bodies
from igps.mesh.options import LoadOptions
from igps.report.tables import findings_table
from igps.signature.signature import SignatureConfig, compute_signature
from label_files import write_nifti
from own_descriptors import CONFIG


def pipeline_of(root, reading=LoadOptions(), config=CONFIG):
    return SignaturePipeline(config, reading, root.with_name(f"{root.name}-cache"))


def findings(root, reading=LoadOptions(), limits=None):
    files = find_bodies(root)
    pipeline = pipeline_of(root, reading)
    found = examine(files, pipeline, n_workers=1, progress=False, limits=limits)
    assert tuple(finding.id for finding in found) == files.names
    return {finding.id: finding for finding in found}


def test_each_fault_and_what_will_be_done(tmp_path):
    write_clean(tmp_path / "clean.off")
    soup = write_soup(tmp_path / "soup.off")
    holed = write_holed(tmp_path / "holed.off")
    write_box(tmp_path / "box.off")
    write_crossing(tmp_path / "crossing.off")
    found = findings(tmp_path)
    for one in found.values():
        assert one.error is None
    clean = found["clean.off"]
    assert clean.fault is None
    assert clean.steps == ()
    assert clean.notes == ()
    assert clean.error is None
    assert clean.n_vertices == clean.n_vertices_after == N_VERTICES

    assert found["soup.off"].steps == ("welded",)
    assert found["soup.off"].notes == (f"welded {3 * N_FACES - N_VERTICES} coincident vertices",)
    assert found["soup.off"].n_vertices == 3 * N_FACES
    assert found["soup.off"].n_vertices_after == N_VERTICES
    assert f"{free_edges(soup)} boundary edges" in str(found["soup.off"].fault)

    assert found["holed.off"].steps == ("filled",)
    assert found["holed.off"].notes == ("filled 1 small hole",)
    assert found["holed.off"].n_vertices == N_VERTICES - 1
    assert f"{free_edges(holed)} boundary edges" in str(found["holed.off"].fault)
    assert free_edges(holed) == 6

    # Eight vertices are a body, but not for twenty eigenpairs.
    assert found["box.off"].fault is None
    assert found["box.off"].steps == ("subdivided",)
    assert found["box.off"].n_vertices == 8
    assert (found["box.off"].n_vertices_after or 0) >= 22

    assert "2 connected components" in str(found["crossing.off"].fault)
    assert found["crossing.off"].steps[0] == "united"


def test_what_cannot_be_used_costs_the_others_nothing(tmp_path, monkeypatch):
    without_cascadio(monkeypatch)
    write_clean(tmp_path / "clean.off")
    sentences = write_unusable(tmp_path)
    found = findings(tmp_path)
    assert found["clean.off"].error is None
    assert len(found) == 1 + len(sentences)
    for name, sentence in sentences.items():
        assert found[name].error == f"{tmp_path / name}: {sentence}"
        assert found[name].seconds is None
        assert found[name].n_vertices_after is None
    # Some can be read at least.
    known = {"triangle.off": 3, "line.obj": 4, "five.xyz": 5, "empty.off": None}
    for name, n_vertices in known.items():
        assert found[name].n_vertices == n_vertices


def test_the_reading_decides(tmp_path):
    holed = write_holed(tmp_path / "holed.off")
    never = findings(tmp_path, reading=LoadOptions("never"))["holed.off"]
    assert never.error == never.fault
    assert str(never.error).startswith(f"{holed}: open surface with 6 boundary edges")
    always = findings(tmp_path, reading=LoadOptions("always"))["holed.off"]
    assert always.steps == ("watertight",)
    assert always.fault == never.fault
    allowed = findings(tmp_path, reading=LoadOptions("never", allow_open=True))["holed.off"]
    assert allowed.fault is None
    assert allowed.error is None
    assert allowed.steps == ()


def test_a_file_that_takes_too_long_is_told(tmp_path):
    write_clean(tmp_path / "clean.off")
    assert "time_limit" in str(findings(tmp_path, limits=Limits(seconds=1e-6))["clean.off"].error)


def test_the_cost_grows_with_vertices_and_eigenpairs():
    small = np.array(expected_cost(1_000, 50))
    assert (small < expected_cost(1_000, 250)).all()
    assert (small < expected_cost(10_000, 50)).all()


def test_the_cost_is_that_of_the_mesh_that_is_simplified(tmp_path):
    write_clean(tmp_path / "clean.off")
    files = find_bodies(tmp_path)
    (full,) = examine(
        files,
        pipeline_of(tmp_path),
        n_workers=1,
        progress=False,
    )
    fewer = SignatureConfig(
        n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60, max_vertices=60
    )
    pipeline = pipeline_of(tmp_path, config=fewer)
    (simplified,) = examine(files, pipeline, n_workers=1, progress=False)
    assert full.memory == expected_cost(N_VERTICES, 20)[1]
    assert simplified.memory == expected_cost(60, 20)[1]


def test_what_was_examined_is_not_read_again(tmp_path, monkeypatch):
    labels = np.zeros((16, 14, 12), dtype=np.uint8)
    write_nifti(tmp_path / "empty.nii", labels)
    labels[2:12, 2:12, 2:7] = 1
    labels[3:13, 3:11, 7:11] = 2
    write_nifti(tmp_path / "two.nii", labels)
    findings(tmp_path)
    other = replace(CONFIG, resolution=8, measures=True)
    meshes = load_bodies(tmp_path / "two.nii")
    pipeline = pipeline_of(tmp_path, config=other)
    for name in ("each_surface", "read_surface"):
        monkeypatch.delattr(f"igps.data.pipeline.{name}")
    for part, mesh in zip("12", meshes, strict=True):
        body = BodyRef(tmp_path / "two.nii", part, part)
        found = pipeline.signature(body)
        expected = compute_signature(mesh, other)
        np.testing.assert_array_equal(found.interior.points, expected.interior.points)
        assert found.measures == expected.measures
        assert (found.notes, found.unit) == (expected.notes, expected.unit)
        assert pipeline.mesh(body).frame == mesh.frame
    with pytest.raises(MeshError, match="no voxel has a label"):
        pipeline.signature(BodyRef(tmp_path / "empty.nii"))


def test_labels_of_a_volume_are_told_one_by_one_by_their_voxels(tmp_path):
    labels = np.zeros((30, 20, 20), dtype=np.uint8)
    labels[2:14, 4:16, 4:16] = labels[16:17, 2:3, 2:3] = 1  # a cube, and a voxel apart
    labels[17:29, 4:16, 4:6] = 2  # a plate of two voxels
    labels[17:24, 2, 18] = 3
    write_nifti(tmp_path / "x.nii.gz", labels)
    (tmp_path / "x.csv").write_text("label,name\n1,cube\n2,plate\n3,line\n")
    found = findings(tmp_path)
    assert list(found) == ["x.nii.gz#cube", "x.nii.gz#plate", "x.nii.gz#line"]
    measures = [one.voxels for one in found.values()]
    assert measures == [
        VoxelMeasures(12**3 + 1, 2, 10),
        VoxelMeasures(288, 1, 2),
        VoxelMeasures(7, 1, 1),
    ]
    cube, plate, line = found.values()
    assert cube.notes == ("left out 1 small piece apart: 1 voxel, 1 mm³, 0.1% of the label",)
    assert cube.remarks == cube.notes
    assert cube.unit == "mm"
    assert cube.unit_from == "default"
    assert cube.error is None
    assert plate.error is None
    assert plate.fault is None
    assert plate.steps == ()
    assert line.error == f"{tmp_path / 'x.nii.gz'}#line: " + (
        "expected at least 8 voxels, got 7, which have no shape. Leave out the label, or segment it on a finer grid."
    )
    table = findings_table(list(found.values())).splitlines()
    assert table[0].split()[:4] == ["voxels", "pieces", "thinnest", "vertices"]
    assert table[1].split()[1:4] == ["1729", "2", "10"]
    assert len(table) == 5
    assert table[4] == "1 mask left out: 1 of fewer than 8 voxels"


@pytest.mark.parametrize("thickness", [1, 2, 7])
def test_the_thinnest_part_is_measured_in_voxels(thickness):
    mask = np.zeros((30, 30, 30), dtype=bool)
    mask[3:27, 4:26, 5 : 5 + thickness] = True
    mask[8:20, 8:20, 5:15] = True
    assert thinnest_part(mask) == thickness


def test_the_thinnest_part_of_a_large_label_needs_little_memory():
    """As a whole it took 60 bytes a voxel: 20 GB of a jaw of a mouse in 700³ voxels. It took minutes, too."""
    mask = np.zeros((260, 260, 90), dtype=bool)
    mask[:, :, 40:46] = mask[100:108, 90:98] = True
    tracemalloc.start()
    found = thinnest_part(mask)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found in (5, 6)  # of even numbers the one below, in whole voxels
    assert peak < 8 * mask.size


def test_a_body_that_is_not_in_its_file_is_told(tmp_path):
    write_nifti(tmp_path / "x.nii", np.ones((9, 9, 9), dtype=np.uint8))
    (tmp_path / "labels.csv").write_text("file,body,label\nx.nii,x,a\nx.nii,liver,b\n")
    found = findings(tmp_path)
    assert found["x.nii#x"].error is None
    assert "has no such body" in str(found["x.nii#liver"].error)


def test_what_a_colleague_would_say_of_a_body(tmp_path):
    """Half of a box at the border of an image, a box without its bottom, and two boxes apart, in metres."""
    nibabel = pytest.importorskip("nibabel", reason="the extra [volumes]")
    mask = np.zeros((20, 20, 20), dtype=np.uint8)
    mask[:8, 4:12, 4:12] = 1
    image = nibabel.Nifti1Image(mask, np.eye(4))
    image.header.set_xyzt_units("mm")
    nibabel.save(image, tmp_path / "cut.nii.gz")
    box = trimesh.creation.box((2, 3, 4)).subdivide()
    is_bottom = box.triangles_center[:, 2] < -1.99
    trimesh.Trimesh(box.vertices, box.faces[~is_bottom]).export(tmp_path / "open.off")
    apart = box.copy()
    apart.apply_translation((9, 0, 0))
    trimesh.util.concatenate([box, apart]).export(tmp_path / "two.glb")
    found = findings(tmp_path)
    cut = found["cut.nii.gz#cut"]
    assert cut.unit == "mm"
    assert cut.unit_from == "header"
    share = 64 / (6 * 64)  # of a cube of 8 voxels; its edges are rounded a little
    (border,) = cut.remarks
    assert border.startswith("at the border of the image (left): 1")
    assert float(border.split()[7].rstrip("%")) == pytest.approx(100 * share, abs=2)
    assert found["open.off"].missing == pytest.approx(6 / 52)
    assert any(note.startswith("open: 12% of the surface") for note in found["open.off"].remarks)
    assert found["open.off"].unit is None
    assert found["two.glb"].unit == "m"
    assert found["two.glb"].unit_from == "format"
    assert found["two.glb"].n_pieces == 2
    assert found["two.glb"].remarks[0] == "2 pieces"

"""Files that hold several bodies: found by name, computed together, and one fault costs no other body its Signature."""

import os
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor

import nibabel
import numpy as np
import pytest
import trimesh
from trimesh.creation import icosphere

import igps.data.pipeline as pipeline_module
from igps.data.dataset import SignatureDataset
from igps.data.filling import compute
from igps.data.sources import bodies_of_files, find_bodies
from igps.failures import Limits
from igps.mesh.loading import BodyRef, load_mesh
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig, compute_signature
from label_files import write_nifti

CONFIG = SignatureConfig(n_eigenpairs=10, resolution=8, min_samples=0, n_surface_samples=20)
OBJECTS = LoadOptions(mend="never", bodies="objects")
PARTS = {"liver": (1.0, 1.2, 1.5), "spleen": (1.0, 1.0, 2.0)}


def egg(part, subject):
    body = icosphere(subdivisions=2)
    body.vertices *= np.array(PARTS[part]) * subject
    return body


def write_subject(path, subject, *broken):
    """The organs of a subject as objects of one file; the broken ones are single triangles."""
    lines = []
    first = 1
    for part in PARTS:
        body = egg(part, subject)
        lines.append(f"o {part}")
        lines += ["v " + " ".join(map(repr, map(float, vertex))) for vertex in body.vertices]
        faces = body.faces[:1] if part in broken else body.faces
        lines += ["f " + " ".join(map(str, face + first)) for face in faces]
        first += len(body.vertices)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def root(tmp_path):
    for i in (1, 2):
        write_subject(tmp_path / "subjects" / f"{i}.obj", 1.0 + 0.1 * i)
    return tmp_path / "subjects"


@pytest.fixture
def reads(monkeypatch):
    """Names of the files that are read for their bodies."""
    names = []
    for name in ("each_surface", "read_surface"):
        function = getattr(pipeline_module, name)

        def reading(path, *arguments, function=function, **options):
            names.append(path.name)
            return function(path, *arguments, **options)

        monkeypatch.setattr(pipeline_module, name, reading)
    return names


def test_bodies_are_found_by_file_and_part(root):
    bodies = find_bodies(root, OBJECTS)
    assert bodies.names == ("1.obj#liver", "1.obj#spleen", "2.obj#liver", "2.obj#spleen")
    assert list(bodies)[1] == bodies[1] == BodyRef(root / "1.obj", "spleen")
    assert bodies.labels is None
    assert bodies.subset([3]).parts == ("spleen",)
    assert find_bodies(root).names == ("1.obj", "2.obj")
    given = bodies_of_files([root / "2.obj"], ["second"], OBJECTS)
    assert given.names == (f"{root / '2.obj'}#liver", f"{root / '2.obj'}#spleen")
    assert given.labels == ("second", "second")


def test_the_class_is_the_folder_the_part_or_the_file(root):
    organs = ("liver", "spleen", "liver", "spleen")
    assert find_bodies(root, OBJECTS, classes="body").labels == organs
    assert find_bodies(root, OBJECTS, classes="file").labels == ("1.obj", "1.obj", "2.obj", "2.obj")
    assert find_bodies(root.parent, OBJECTS).labels == ("subjects",) * 4
    dataset = SignatureDataset(root, CONFIG, reading=OBJECTS, classes="body")
    assert dataset.labels.tolist() == [0, 1, 0, 1]
    with pytest.raises(
        ValueError,
        match=r"classes: expected files of several bodies with 'body', but 1\.obj is one",
    ):
        find_bodies(root, classes="body")
    with pytest.raises(
        ValueError, match="classes: expected 'folder', 'body' or 'file', got 'organ'"
    ):
        find_bodies(root, classes="organ")


def test_an_empty_mask_among_organs_costs_no_other_its_class(tmp_path):
    """As TotalSegmentator writes them: a file for each organ, of which some are out of view."""
    for subject, organ, value in (
        ("s1", "liver", 1),
        ("s1", "spleen", 0),
        ("s2", "liver", 1),
        ("s2", "spleen", 1),
    ):
        mask = np.zeros((14, 14, 14), dtype=np.uint8)
        mask[2:12, 3:10, 4:11] = value
        write_nifti(tmp_path / subject / f"{organ}.nii.gz", mask)
    dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache", classes="body")
    assert dataset.bodies.labels == ("liver", "spleen", "liver", "spleen")
    failures = dataset.precompute(n_workers=1, progress=False)
    assert [failure.id for failure in failures] == ["s1/spleen.nii.gz"]
    assert "no voxel has a label" in failures[0].error
    assert dataset.usable(failures).bodies.labels == ("liver", "liver", "spleen")


def test_a_table_names_bodies_and_may_tell_more(root):
    (root / "labels.csv").write_text("file,age,body,label\n2.obj,30,spleen,ill\n1.obj,40,,well\n")
    bodies = find_bodies(root, OBJECTS)
    assert bodies.names == ("2.obj#spleen", "1.obj#liver", "1.obj#spleen")
    assert bodies.labels == ("ill", "well", "well")
    assert find_bodies(root, OBJECTS, classes="body").labels == ("spleen", "liver", "spleen")
    (root / "labels.csv").write_text("file,body,label\n1.obj,spleen,ill\n1.obj,,well\n")
    with pytest.raises(ValueError, match=r"1\.obj#spleen is listed twice"):
        find_bodies(root, OBJECTS)


@pytest.mark.parametrize("value", ["", "n/a"])
def test_a_missing_value_is_none_but_a_class_may_have_its_name(root, value):
    (root / "labels.csv").write_text(f"file,label,sex\n2.obj,ill,f\n1.obj,well,{value}\n")
    bodies = find_bodies(root)
    assert bodies.columns == {"sex": ("f", None)}
    with pytest.raises(ValueError, match=r"sex: 1 of 2 bodies have no value, such as 1\.obj"):
        bodies.column("sex")
    (root / "labels.csv").write_text(f"file,label\n2.obj,ill\n1.obj,{value}\n")
    if value:
        assert find_bodies(root).labels == ("ill", value)
    else:
        with pytest.raises(ValueError, match="line 3 lacks the name of a file, or a label"):
            find_bodies(root)


def test_further_columns_stay_with_their_bodies(root, tmp_path):
    table = "file,age,body,label,scanner\n2.obj,30,spleen,ill,A\n1.obj, 41.5 ,,well,\n"
    (root / "labels.csv").write_text(table)
    bodies = find_bodies(root, OBJECTS)
    assert bodies.columns == {"age": ("30", "41.5", "41.5"), "scanner": ("A", None, None)}
    assert bodies.with_classes("body").columns == bodies.columns
    assert bodies.numbers("age") == [30, 41.5, 41.5]
    assert bodies.subset([0]).column("scanner") == ("A",)
    with pytest.raises(
        ValueError, match=r"scanner: 2 of 3 bodies have no value, such as 1\.obj#liver"
    ):
        bodies.column("scanner")
    with pytest.raises(
        ValueError, match=r"weight: no such column of labels\.csv; further columns: age, scanner"
    ):
        bodies.column("weight")
    (root / "labels.csv").unlink()
    with pytest.raises(ValueError, match=r"weight: .*further columns: none\. Add it"):
        find_bodies(root).column("weight")
    with pytest.raises(ValueError, match=r"scanner: expected numbers, got 'A' of 2\.obj#spleen"):
        bodies.subset([0]).numbers("scanner")
    dataset = SignatureDataset(bodies, CONFIG, tmp_path / "cache", reading=OBJECTS)
    assert dataset[["1.obj#spleen", "2.obj#spleen"]].bodies.columns["age"] == ("41.5", "30")


def test_a_folder_in_the_table_is_refused_with_its_line(root):
    (root / "s1").mkdir()
    (root / "labels.csv").write_text("file,label\n1.obj,well\ns1,ill\n")
    with pytest.raises(ValueError, match=r"labels\.csv: line 3 names the folder s1\. Give a line"):
        find_bodies(root)


def test_a_session_is_no_number(root):
    """To Python 01_02 is 102."""
    (root / "labels.csv").write_text("file,session\n1.obj,01_02\n2.obj,03_04\n")
    bodies = find_bodies(root)
    with pytest.raises(ValueError, match=r"session: expected numbers, got '01_02' of 1\.obj"):
        bodies.numbers("session")


def test_a_table_of_columns_alone_tells_no_classes(root):
    (root / "labels.csv").write_text("file,age\n1.obj,30\n2.obj\n")
    bodies = find_bodies(root, OBJECTS)
    assert bodies.labels is None
    assert bodies.columns == {"age": ("30", "30", None, None)}
    with pytest.raises(
        ValueError, match=r"no classes found\..* Or rename one of the columns age to label"
    ):
        find_bodies(root, OBJECTS, labelled=True)
    found = find_bodies(root, OBJECTS, classes="body", labelled=True)
    assert found.labels == ("liver", "spleen", "liver", "spleen")


def test_many_bodies_of_a_file_are_reported_some_at_a_time(tmp_path, reads):
    """Of 65 labels of a volume the first 64 are reported before the last is computed, for which it is read again."""
    labels = np.zeros((65 * 7, 8, 8), dtype=np.uint8)
    for i in range(65):
        labels[7 * i + 1 : 7 * i + 6, 1:6, 1:6] = i + 1
    write_nifti(tmp_path / "cells.nii.gz", labels)
    few = SignatureConfig(n_eigenpairs=5, resolution=4, min_samples=0, n_surface_samples=10)
    pipeline = SignatureDataset(tmp_path, few, tmp_path / "cache").pipeline
    outcomes = compute(
        pipeline, find_bodies(tmp_path), range(65), n_workers=1, executor=None, limits=Limits()
    )
    assert [next(outcomes)[0] for _ in range(64)] == list(range(64))
    assert len(reads) == 1
    assert [number for number, _ in outcomes] == [64]
    assert len(reads) == 2


@pytest.mark.parametrize("how", ["at once", "on first touch"])
def test_each_has_the_signature_of_its_own_surface(root, tmp_path, reads, how):
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache", reading=OBJECTS)
    if how == "at once":
        assert dataset.precompute(n_workers=1, progress=False) == []
        assert reads == ["1.obj", "2.obj"]  # once for both of its bodies
        reads.clear()
    for i, name in enumerate(dataset.bodies.names):
        part = name.split("#")[1]
        subject = 1.0 + 0.1 * int(name[0])
        body = egg(part, subject)
        expected = compute_signature(Mesh(body.vertices, body.faces), CONFIG)
        assert dataset[name].id == dataset[name].signature.name == name
        np.testing.assert_allclose(
            dataset[i].signature.eigenvalues, expected.eigenvalues, rtol=1e-9
        )
        assert dataset.mesh(i).volume == pytest.approx(body.volume)
    assert len({dataset.key(i) for i in range(4)}) == 4
    if how == "at once":
        assert reads == [f"{1 + i // 2}.obj" for i in range(4)]  # for the meshes alone


def test_a_file_that_hides_what_it_needs_costs_no_other(tmp_path):
    """Headers that stop the search for what is read beside them; again when the others are known."""
    pytest.importorskip("SimpleITK")
    header = "ObjectType = Image\nNDims = 3\nDimSize = 9 9 9\nElementType = MET_UCHAR\nElementDataFile = .\n"
    (tmp_path / "dot.mhd").write_text(header)
    (tmp_path / "deep.gltf").write_text("[" * 200_000)
    (tmp_path / "list.gltf").write_text('{"buffers": 7}')
    (tmp_path / "out.gltf").write_text('{"buffers": [{"uri": "../../x.bin"}]}')
    ball = icosphere(subdivisions=3)
    ball.export(tmp_path / "ball.off")
    for _ in range(2):
        dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache")
        failures = dataset.precompute(n_workers=1, progress=False)
        names = {failure.id for failure in failures}
        assert names == {"dot.mhd", "deep.gltf", "list.gltf", "out.gltf"}
        for failure in failures:
            assert "not readable as" in failure.error
        assert dataset.usable(failures)[0].signature.volume == pytest.approx(ball.volume)


def test_what_is_read_beside_a_file_counts(tmp_path, trust_recent_files):
    """Two subjects whose headers are alike, a table of names that is put right, and numbers of a scene beside it."""
    sitk = pytest.importorskip("SimpleITK")
    labels = np.zeros((20, 20, 20), dtype=np.uint8)
    labels[2:8, 4:16, 4:16] = 1
    labels[10:18, 4:16, 4:16] = 2

    def volumes(folder, names=None):
        dataset = SignatureDataset(
            tmp_path / folder, CONFIG, tmp_path / "cache", reading=LoadOptions(names=names)
        )
        dataset.precompute(n_workers=1, progress=False)
        return {name: round(dataset[name].signature.volume) for name in dataset.bodies.names}

    for subject, label in (("s1", 1), ("s2", 2)):
        (tmp_path / "meta" / subject).mkdir(parents=True)
        image = sitk.GetImageFromArray((labels == label).astype(np.uint8))
        sitk.WriteImage(image, str(tmp_path / "meta" / subject / "x.mhd"))
    headers = [(tmp_path / "meta" / subject / "x.mhd").read_bytes() for subject in ("s1", "s2")]
    assert headers[0] == headers[1]
    assert volumes("meta") == {"s1/x.mhd#x": 864, "s2/x.mhd#x": 1152}

    write_nifti(tmp_path / "nifti" / "x.nii.gz", labels)
    for table, names in (("nifti/x.csv", None), ("names.csv", str(tmp_path / "names.csv"))):
        (tmp_path / table).write_text("label,name\n1,liver\n2,spleen\n")
        assert volumes("nifti", names) == {"x.nii.gz#liver": 864, "x.nii.gz#spleen": 1152}
        (tmp_path / table).write_text("label,name\n2,liver\n1,spleen\n")
        assert volumes("nifti", names) == {"x.nii.gz#liver": 1152, "x.nii.gz#spleen": 864}

    (tmp_path / "nifti" / "x.csv").unlink()
    for table, order in (("one.csv", (1, 2)), ("two.csv", (2, 1))):
        (tmp_path / table).write_text("label,name\n{},liver\n{},spleen\n".format(*order))
        os.utime(tmp_path / table, (1e9, 1e9))
    # So that the tables tell nothing by their times and sizes
    (tmp_path / "nifti" / "x.nii.gz").touch()
    assert volumes("nifti", str(tmp_path / "one.csv"))["x.nii.gz#liver"] == 864
    assert volumes("nifti", str(tmp_path / "two.csv"))["x.nii.gz#liver"] == 1152

    (tmp_path / "gltf").mkdir()
    scene = trimesh.Scene(icosphere(subdivisions=2, radius=9))
    for name, content in scene.export(file_type="gltf").items():
        path = tmp_path / "gltf" / name.replace("buffer", "a buffer")
        path.write_bytes(content.replace(b"gltf_buffer", b"gltf_a%20buffer"))
    volume = volumes("gltf")["model.gltf"]
    [places] = [one for one in (tmp_path / "gltf").glob("*.bin") if one.stat().st_size == 162 * 12]
    doubled = 2 * np.frombuffer(places.read_bytes(), dtype=np.float32)
    places.write_bytes(doubled.tobytes())
    assert volumes("gltf")["model.gltf"] == pytest.approx(8 * volume, rel=1e-3)


@pytest.mark.parametrize("how", ["here", "by two workers"])
def test_a_bad_body_costs_no_other_of_its_file(root, tmp_path, how):
    write_subject(root / "1.obj", 1.1, "liver")
    (root / "3.obj").write_text("nothing")
    table = "file,body,label\n1.obj,liver,a\n1.obj,spleen,a\n2.obj,liver,b\n2.obj,heart,b\n2.obj,spleen,b\n3.obj,x,c\n"
    (root / "labels.csv").write_text(table)
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache", reading=OBJECTS)
    with ThreadPoolExecutor(2) as pool:
        workers = {"n_workers": 1} if how == "here" else {"executor": pool, "n_workers": 2}
        failures = dataset.precompute(**workers, progress=False)
    assert [failure.id for failure in failures] == ["1.obj#liver", "2.obj#heart", "3.obj#x"]
    assert [failure.path.name for failure in failures] == ["1.obj", "2.obj", "3.obj"]
    told = ("#liver: open surface with 3 boundary edges", "has no body 'heart'", "3.obj")
    for failure, words in zip(failures, told, strict=True):
        assert failure.error.startswith(str(failure.path))
        assert words in failure.error
    usable = dataset.usable(failures)
    assert [item.id for item in usable] == ["1.obj#spleen", "2.obj#liver", "2.obj#spleen"]


class Fragile(ThreadPoolExecutor):
    """Loses every job of several bodies, as a cluster does when one of them kills its worker."""

    def submit(self, function, /, *arguments, **options):
        if len(arguments[0]) == 1:
            return super().submit(function, *arguments, **options)
        lost = Future()
        lost.set_exception(RuntimeError("the worker is gone"))
        return lost


def test_where_a_job_of_several_bodies_is_lost_each_is_tried_alone(root, tmp_path):
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache", reading=OBJECTS)
    with Fragile(1) as executor:
        assert dataset.precompute(executor, n_workers=1, progress=False) == []
    assert len(list((tmp_path / "cache" / "signatures").rglob("*.safetensors"))) == 4


def test_a_name_that_is_too_long_for_a_file_costs_no_other(tmp_path):
    icosphere(2).export(tmp_path / "a.off")
    (tmp_path / "labels.csv").write_text(f"file,label\na.off,one\n{'x' * 300}.off,one\n")
    dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache")
    (failure,) = dataset.precompute(n_workers=1)
    assert failure.id == f"{'x' * 300}.off"
    assert "File name too long" in failure.error


def write_labels(path, *values):
    """A volume with a cube of 4³ voxels for each label."""
    path.parent.mkdir(parents=True, exist_ok=True)
    labels = np.zeros((20, 8, 8), np.uint8)
    for number, value in enumerate(values):
        labels[1 + 6 * number : 5 + 6 * number, 2:6, 2:6] = value
    nibabel.Nifti1Image(labels, np.eye(4)).to_filename(path)


def test_a_single_label_among_subjects_with_several_is_named_like_theirs(tmp_path):
    write_labels(tmp_path / "a.nii.gz", 1, 2)
    write_labels(tmp_path / "b.nii.gz", 1, 2)
    write_labels(tmp_path / "c.nii.gz", 1)
    bodies = find_bodies(tmp_path, classes="body")
    assert bodies.names == ("a.nii.gz#1", "a.nii.gz#2", "b.nii.gz#1", "b.nii.gz#2", "c.nii.gz#1")
    assert bodies.labels == ("1", "2", "1", "2", "1")
    assert load_mesh(tmp_path / "c.nii.gz", part="1").volume == pytest.approx(64, rel=0.01)


def test_masks_of_organs_are_named_after_their_files(tmp_path):
    for name in ("liver", "spleen"):
        write_labels(tmp_path / f"{name}.nii.gz", 1)
    write_labels(tmp_path / "all.nii.gz", 1, 2)
    names = find_bodies(tmp_path, classes="body").names
    assert names == ("all.nii.gz#1", "all.nii.gz#2", "liver.nii.gz#liver", "spleen.nii.gz#spleen")


def test_a_folder_for_each_subject(tmp_path):
    write_labels(tmp_path / "one" / "seg.nii.gz", 1, 2)
    write_labels(tmp_path / "two" / "seg.nii.gz", 1, 2)
    write_labels(tmp_path / "three" / "seg.nii.gz", 1)
    labels = find_bodies(tmp_path, classes="body").labels
    assert sorted(labels) == ["1", "1", "1", "2", "2"]


def test_empty_masks_are_told_in_one_line_and_read_once(
    tmp_path, caplog, trust_recent_files, monkeypatch
):
    root = tmp_path / "masks"
    root.mkdir()
    for name, n in {"liver": 8, "spleen": 7, "rib_1": 0, "rib_2": 0, "rib_3": 0, "lung": 1}.items():
        mask = np.zeros((10, 10, 10), dtype=np.uint8)
        mask[1 : 1 + n, 1 : 1 + n, 1 : 1 + n] = 1
        path = root / f"{name}.nii.gz"
        write_nifti(path, mask)
        os.utime(path, (1e9, 1e9))

    def run():
        caplog.clear()
        dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
        failures = dataset.precompute(n_workers=1, progress=False)
        return len(failures), [record.getMessage() for record in caplog.records]

    n_read = Counter()
    load = nibabel.load

    def counted(path):
        n_read[path.name] += 1
        return load(path)

    expected = 4, ["4 masks left out: 3 empty, 1 of fewer than 8 voxels"]
    monkeypatch.setattr(nibabel, "load", counted)
    assert run() == expected
    assert [n_read[f"rib_{i}.nii.gz"] for i in (1, 2, 3)] == [1, 1, 1]
    monkeypatch.setattr(nibabel, "load", lambda path: pytest.fail(f"{path} is read again"))
    assert run() == expected

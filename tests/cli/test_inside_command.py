"""`igps inside`: the table of images around generated labels, and what is said of images that cannot be used."""

import csv
import json
import shutil

import numpy as np
import pytest

from commands import run
from igps.analysis.inside import column_names
from igps.analysis.inside_collection import inside_config, inside_table
from igps.data.attribute_sources import attribute_source
from igps.data.dataset import SignatureDataset
from igps.signature.signature import SignatureConfig
from label_files import write_nifti

SMALL = ["--signature.n_surface_samples", "50"]
AFFINE = np.diag([1.0, 1.0, 2.0, 1.0])
SHAPE = (20, 22, 14)


def write(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_nifti(path, values, AFFINE)


def radius(scale):
    """The distance of each voxel from the centre of an ellipsoid, 1 on its surface."""
    x, y, z = (np.indices(SHAPE).T - (np.array(SHAPE) - 1) / 2).T
    return np.sqrt((x / 6 / scale) ** 2 + (y / 8) ** 2 + (2 * z / 9) ** 2)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Four ellipsoids, bright at the rim, bright in the core, constant, and one without an image of its own."""
    folder = tmp_path_factory.mktemp("inside") / "labels"
    images = (100 + 50 * radius(1.0), 100 - 50 * radius(1.1), np.full(SHAPE, 7.0))
    for name, scale in (("rim", 1.0), ("core", 1.1), ("same", 1.2), ("wrong", 0.9)):
        write(folder / f"{name}.nii.gz", (radius(scale) < 1).astype(np.uint8))
    for name, image in zip(("rim", "core", "same"), images, strict=True):
        write(folder / "ct" / f"{name}.nii.gz", image.astype(np.float32))
    image = np.where(np.indices(SHAPE)[0] < 12, 1.0, np.nan)  # covers only half of the body
    write(folder / "ct" / "wrong.nii.gz", image.astype(np.float32))
    return folder


def igps(root, *words):
    cache = ["--cache_dir", root.parent / "cache"]
    run(*words, *cache, *SMALL)


def test_the_table_is_what_python_computes(root, tmp_path, capsys):
    out = tmp_path / "inside.csv"
    igps(root, "inside", root, "--attribute", "ct=ct/{file}", "--out", out)
    printed = capsys.readouterr().out
    with out.open(newline="") as file:
        rows = {row["part"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"rim", "core", "same"}
    assert float(rows["rim"]["ct.rim.contrast"]) > 1
    assert float(rows["core"]["ct.rim.contrast"]) < -1
    assert float(rows["same"]["ct.mean"]) == 7
    assert rows["same"]["ct.moran"] == ""
    assert rows["rim"]["unit"] == "mm"
    assert "ct is constant in 1 of 3 bodies, such as same.nii.gz#same" in printed
    assert "1 of 4 bodies could not be used" in printed
    assert "has no value at" in printed

    sources = {"ct": attribute_source("ct/{file}", root)}
    config = inside_config(SignatureConfig(n_surface_samples=50))
    paths = [root / "core.nii.gz"]
    dataset = SignatureDataset(paths, config, root.parent / "other", attributes=sources)
    table = inside_table(dataset, ["ct"])
    expected = dict(zip(table.columns, table.rows[0], strict=True))
    assert list(expected) == column_names(["ct"])
    for name, number in expected.items():
        assert float(rows["core"][name]) == pytest.approx(number, rel=1e-6), name


def test_rows_are_cached_and_printed_as_json(root, monkeypatch, capsys):
    words = ["inside", root / "rim.nii.gz", "--attribute", f"ct={root}/ct/{{file}}", "--json"]
    igps(root, *words)
    first = json.loads(capsys.readouterr().out)
    monkeypatch.setattr("igps.analysis.inside_collection.inside_numbers", None)
    igps(root, *words)
    assert json.loads(capsys.readouterr().out) == first
    assert len(first) == 1


def test_one_image_of_two_subjects_and_another_unit_are_remarked(root, tmp_path, capsys):
    for i in range(4):
        write(
            tmp_path / f"s{i}.nii.gz",
            (radius(1 + i / 50) < 1).astype(np.uint8),
        )
        shutil.copy(root / "ct" / "rim.nii.gz", tmp_path / f"s{i}_ct.nii.gz")
    write(tmp_path / "s3_ct.nii.gz", (radius(1.0) / 1000).astype(np.float32))
    igps(root, "inside", tmp_path, "--attribute", "ct={stem}_ct.nii.gz")
    printed = capsys.readouterr().out
    assert "ct of s0.nii.gz and of s1.nii.gz is the same image" in printed
    assert "in s3.nii.gz#s3" in printed
    assert "its unit seems to differ" in printed


def test_a_body_of_three_voxels_and_no_attribute_are_refused_with_a_sentence(tmp_path, capsys):
    label = np.zeros(SHAPE, np.uint8)
    label[5:8, 5, 5] = 1
    write(tmp_path / "a.nii.gz", label)
    write(tmp_path / "ct" / "a.nii.gz", radius(1.0).astype(np.float32))
    with pytest.raises(SystemExit):
        igps(tmp_path, "inside", tmp_path, "--attribute", "ct=ct/{file}")
    assert "expected at least 8 voxels, got 3" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        igps(tmp_path, "inside", tmp_path)
    assert "attribute: expected at least one" in capsys.readouterr().err


def test_groups_tests_where_the_signal_lies_beside_shape(tmp_path, capsys):
    """Two groups of equal form and equal values, which lie at the rim in one and in the core of the other."""
    random = np.random.default_rng(0)
    for i in range(14):
        folder = tmp_path / "bodies" / ("rim", "core")[i % 2]
        scale = random.uniform(0.95, 1.05)
        away = radius(scale) if i % 2 else -radius(scale)
        image = np.argsort(np.argsort(away, axis=None)).reshape(SHAPE) + random.normal(size=SHAPE)
        write(folder / f"{i}.nii.gz", (radius(scale) < 1).astype(np.uint8))
        write(tmp_path / "bodies" / "ct" / f"{i}.nii.gz", image.astype(np.float32))
    words = ["groups", tmp_path / "bodies", "--attribute", "ct=ct/{stem}.nii.gz", "--inside"]
    words += ["--descriptor", "shape_dna", "--n_permutations", 499, "--out", tmp_path / "out"]
    igps(tmp_path, *words)
    printed = capsys.readouterr().out
    with (tmp_path / "out" / "groups.csv").open(newline="") as file:
        rows = {row["body"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"all", "all, inside", *(f"all, {name}" for name in column_names(["ct"]))}
    assert float(rows["all"]["permanova_p"]) > 0.05
    assert float(rows["all, inside"]["permanova_p"]) <= 0.01
    assert float(rows["all, ct.rim.contrast"]["permanova_q"]) <= 0.01
    n_numbers = len(column_names(["ct"]))
    assert f"the first of {n_numbers} numbers, q over all of them" in printed
    with pytest.raises(SystemExit):
        igps(tmp_path, "groups", tmp_path / "bodies", "--inside")
    assert "attribute: expected at least one" in capsys.readouterr().err

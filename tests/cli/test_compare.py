"""`igps compare`: its files and its table are what Python computes."""

import csv
import json
import logging

import numpy as np
import pytest
from matplotlib.image import imread

from commands import run
from igps.analysis.comparison import compare
from igps.data.dataset import SignatureDataset
from igps.descriptors import NAMES, descriptor
from igps.descriptors.registry import FIELD_NAMES
from igps.shapes import ArticulatedShapes
from own_descriptors import CONFIG, SMALL, small_interior, write_egg

KEYS = ["descriptor", "nn", "ft", "st", "e", "dcg", "adr", "adr_self", "map"]
KEYS += ["seconds_per_mesh", "n_models", "invariant_to"]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Three balls and three long eggs; the last ball is an egg by its height."""
    folder = tmp_path_factory.mktemp("collection")
    for label, heights in (("ball", (1.0, 1.1, 2.3)), ("egg", (2.2, 2.4, 2.6))):
        for i, height in enumerate(heights):
            write_egg(folder / "meshes" / label / f"{i}.off", height, subdivisions=2)
    return folder / "meshes"


def test_command_prints_and_writes_what_python_computes(root, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["shape_dna", "d2", "own_descriptors:small_interior"]
    cache = ["--cache_dir", root.parent / "cache"]
    run("compare", root, "--descriptors", *words, "--out", out, *cache, *SMALL)
    printed = capsys.readouterr().out.splitlines()

    chosen = [descriptor("shape_dna"), descriptor("d2"), small_interior()]
    dataset = SignatureDataset(root, CONFIG, root.parent / "cache")
    rows = json.loads((out / "compare.json").read_text())
    assert [list(row) for row in rows] == [KEYS] * 3
    assert [row["descriptor"] for row in rows] == ["shape_dna", "d2", "interior"]
    results = compare(dataset, chosen, n_workers=1, progress=False)
    for row, result in zip(rows, results, strict=True):
        name = result.descriptor.name
        expected = result.row()
        assert row.pop("seconds_per_mesh") >= 0
        expected.pop("seconds_per_mesh")
        assert row == expected
        (line,) = [line for line in printed if line.startswith(name)]
        assert line.split()[1:9] == [f"{100 * expected[key]:.1f}" for key in KEYS[1:9]]
        assert line.split()[9] == "6"
        with np.load(out / "distances" / f"{name}.npz") as archive:
            np.testing.assert_array_equal(archive["distances"], result.distances)
            assert tuple(archive["names"]) == result.names
            assert tuple(archive["labels"]) == result.labels
    assert not (out / "failures.csv").exists()
    assert imread(out / "precision_recall.png").std() > 0.05


def test_the_papers_the_learned_and_the_compared_run_side_by_side(tmp_path, capsys):
    ArticulatedShapes(n_classes=2, n_per_class=2, seed=5, n_vertices=500).write(tmp_path / "meshes")
    options = ["--signature.resolution", 12, "--signature.n_surface_samples", 100]
    options += ["--signature.min_samples", 100, "--n_workers", 1]
    options += ["--cache_dir", tmp_path / "cache", "--out", tmp_path / "out"]
    names = ["interior", "rich", "pretrained", "d2"]
    run("compare", tmp_path / "meshes", "--descriptors", *names, *options)
    printed = capsys.readouterr().out
    rows = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert [row["descriptor"] for row in rows] == names
    for row, name in zip(rows, names, strict=True):
        assert row["n_models"] == 4
        assert row["invariant_to"] == list(descriptor(name).invariant_to)
        assert f"{name:<10}" in printed
        with np.load(tmp_path / "out" / "distances" / f"{name}.npz") as archive:
            distances = archive["distances"]
            labels = archive["labels"]
        np.testing.assert_allclose(distances.diagonal(), 0, atol=1e-5)
        np.testing.assert_allclose(distances, distances.T, atol=1e-5)
        same = labels[:, None] == labels
        assert distances[same & ~np.eye(4, dtype=bool)].mean() < distances[~same].mean()
    assert rows[1]["nn"] == rows[2]["nn"] == 1


def test_command_lists_failures_by_descriptor_and_of_signatures(root, tmp_path, capsys):
    logging.disable(logging.WARNING)
    bad = root / "egg" / "bad.off"
    bad.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    arguments = ["compare", root, "--out", tmp_path, "--cache_dir", root.parent / "cache"]
    arguments += [*SMALL, "--descriptors"]
    chosen = ["own_descriptors:picky", "own_descriptors:broken"]
    try:
        run(*arguments, *chosen)
        rows = list(csv.reader((tmp_path / "failures.csv").open(newline="")))
        assert rows[0] == ["descriptor", "name", "error"]
        assert [row[:2] for row in rows[1:]] == [["all", "egg/bad.off"], ["picky", "egg/1.off"]]
        assert "a single triangle" in rows[1][2]
        assert "too much" in rows[2][2]
        printed = capsys.readouterr().out
        assert "2 bodies could not be used or described" in printed
        assert "broken: no scores: RuntimeError: out of order" in printed
        assert json.loads((tmp_path / "compare.json").read_text())[1]["nn"] is None

        bad.unlink()
        with pytest.raises(SystemExit, match="1"):
            run(*arguments, *chosen, "--strict")
        assert "igps: picky: " in capsys.readouterr().err

        run(*arguments, "own_descriptors:Height")
        assert not (tmp_path / "failures.csv").exists()
    finally:
        logging.disable(logging.NOTSET)
        bad.unlink(missing_ok=True)


def test_unknown_descriptor_is_named_before_anything_is_computed(root, tmp_path, capsys):
    words = ["compare", root, "--descriptors", "d2", "d5", "--cache_dir", tmp_path / "cache"]
    with pytest.raises(SystemExit, match="1"):
        run(*words)
    error = capsys.readouterr().err
    known = ", ".join([*NAMES, *FIELD_NAMES])
    assert f"expected one of {known}, or package.module:NAME" in error
    assert "got 'd5'" in error
    assert not (tmp_path / "cache").exists()

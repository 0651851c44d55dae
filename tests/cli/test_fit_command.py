"""`igps fit` makes a file that every command takes, and `igps classify` asks it."""

import csv
import json
import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import binomtest

import igps as library
from commands import run
from igps.learning.fitting import classify
from igps.nn.description import describe
from own_descriptors import write_egg

SMALL = ["--signature.resolution", 9, "--signature.min_samples", 0]
SMALL += ["--signature.n_surface_samples", 40]
HEIGHTS = {"flat": 0.5, "long": 2.0}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two classes of three eggs, and a model that was fitted to them by the command."""
    folder = tmp_path_factory.mktemp("fit_command")
    for label, height in HEIGHTS.items():
        for i in range(3):
            write_egg(folder / "eggs" / label / f"{i}.off", height * (1 + 0.05 * i), subdivisions=2)
    return folder


def call(root, *words):
    run(*words, "--cache_dir", root / "cache", "--n_workers", 1, *SMALL)


@pytest.fixture
def model(root):
    path = root / "out" / "mine.safetensors"
    if not path.exists():
        options = ["--descriptor", "rich", "--head", "classifier", "--out", path]
        call(root, "fit", root / "eggs", *options)
    return path


def dataset(root, model):
    config = library.SignatureConfig(resolution=9, min_samples=0, n_surface_samples=40)
    chosen = library.descriptor(model)
    return library.SignatureDataset(root / "eggs", config, root / "cache", descriptor=chosen)


def test_fit_writes_model_and_card(root, tmp_path, capsys):
    out = tmp_path / "mine.safetensors"
    call(root, "fit", root / "eggs", "--descriptor", "rich", "--out", out, "--json")
    told = json.loads(capsys.readouterr().out)
    card = library.load(out).card
    assert {**card, "n_refused": 0} == told
    assert card["classes"] == {"flat": 3, "long": 3}
    page = out.with_suffix(".md").read_text()
    assert "`rich` under the head" in page
    lowest = binomtest(6, 6).proportion_ci(method="exact").low
    assert f"of 6 bodies even 100 % means {lowest:.0%} to 100 %" in page
    own = card["held_out_scores"]["ft"]
    plain = card["held_out_scores_of_plain_numbers"]["ft"]
    assert f"| FT | {100 * own:.1f} | {100 * plain:.1f} |" in page
    # Eggs of two lengths: their axes tell them
    assert "the result says little about\nform" in page


def test_fit_writes_a_folder_to_share(root, tmp_path, capsys):
    words = ["fit", root / "eggs", "--descriptor", "rich", "--head", "classifier"]
    call(root, *words, "--out", tmp_path / "mine", "--json")
    told = json.loads(capsys.readouterr().out)
    files = {path.name for path in (tmp_path / "mine").iterdir()}
    assert files == {"model.safetensors", "README.md"}
    assert json.dumps(told["held_out_scores"]) in (tmp_path / "mine" / "README.md").read_text()
    call(root, "classify", root / "eggs", "--model", tmp_path / "mine", "--json")
    classes = [row["class"] for row in json.loads(capsys.readouterr().out)]
    assert classes == ["flat"] * 3 + ["long"] * 3


@pytest.mark.parametrize("cavities", ["fill", "keep"])
def test_bodies_that_are_read_otherwise_than_those_of_the_fit_are_told(
    root, model, capsys, cavities
):
    call(root, "classify", root / "eggs", "--model", model, "--cavities", cavities)
    is_told = "read with --cavities fill, not keep" in capsys.readouterr().out
    assert is_told == (cavities == "keep")


def test_every_command_takes_the_file(root, model, tmp_path, here, capsys):
    found = library.load(model)
    expected = describe(dataset(root, model), found)
    eggs = root / "eggs"
    by_model = ["--descriptor", model]
    call(root, "extract", eggs, *by_model, "--out", tmp_path / "features.npz")
    with np.load(tmp_path / "features.npz") as archive:
        assert_allclose(archive["features"], expected, atol=1e-6)
    call(root, "retrieve", eggs, *by_model, "--out", tmp_path / "retrieved")
    with np.load(tmp_path / "retrieved" / "distances.npz") as archive:
        distances = found.distances(expected, expected)
        assert_allclose(archive["distances"], distances, atol=1e-6)
    compared = ["compare", eggs, "--descriptors", model, "interior"]
    call(root, *compared, "--out", tmp_path / "compared")
    rows = json.loads((tmp_path / "compared" / "compare.json").read_text())
    assert [row["descriptor"] for row in rows] == ["rich_classifier", "interior"]
    call(root, "precompute", root / "eggs", "--descriptors", model)

    capsys.readouterr()
    query = ["query", root / "eggs" / "long" / "0.off", "--top", "3", "--json"]
    call(root, *query, "--gallery", root / "eggs", "--descriptor", model)
    nearest = json.loads(capsys.readouterr().out)
    assert [row["class"] for row in nearest] == ["long"] * 3
    call(root, "gallery", "build", eggs, *by_model, "--out", tmp_path / "eggs.igps")
    moved = tmp_path / "moved.safetensors"
    moved.write_bytes(model.read_bytes())
    for options in ([], ["--descriptor", "moved.safetensors"]):
        capsys.readouterr()
        words = [*query, "--gallery", "eggs.igps", *options, "--cache_dir", root / "cache"]
        run(*words)
        found = json.loads(capsys.readouterr().out)
        assert [row["name"] for row in found] == [row["name"] for row in nearest]


def test_classify_tells_what_python_computes(root, model, tmp_path, capsys):
    out = tmp_path / "classes.csv"
    call(root, "classify", root / "eggs", "--model", model, "--out", out, "--json")
    told = json.loads(capsys.readouterr().out)
    expected = classify(dataset(root, model), str(model))
    assert [one["name"] for one in told] == list(expected.names)
    assert [one["most_like"] for one in told] == ["flat"] * 3 + ["long"] * 3
    largest = expected.probabilities.max(dim=1).values.tolist()
    assert [one["probability"] for one in told] == pytest.approx(largest)
    with out.open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["name", "class", "most_like", "flat", "long"]
    for row, one in zip(rows, told, strict=True):
        assert row[:3] == [one["name"], one["class"] or "", one["most_like"]]
    written = np.array([row[3:] for row in rows], dtype=float)
    assert_allclose(written, expected.probabilities, atol=1e-6)


def test_what_is_unlike_everything_is_said(root, model, tmp_path, capsys):
    import trimesh

    box = trimesh.creation.box((1, 1, 12)).subdivide().subdivide().subdivide().subdivide()
    box.export(tmp_path / "rod.off")
    files = [tmp_path / "rod.off", root / "eggs" / "flat" / "1.off"]
    call(root, "classify", *files, "--model", model)
    lines = capsys.readouterr().out.splitlines()
    rod = next(line for line in lines if "rod.off" in line)
    assert "unlike every known class" in rod
    assert "%" not in rod
    assert next(line for line in lines if "1.off" in line).endswith("flat")
    assert lines[-1].startswith(
        "The model was fitted to 6 bodies. So few do not tell how sure it is"
    )


def test_wrong_files_cost_one_sentence(root, model, tmp_path, capsys):
    (tmp_path / "bad.safetensors").write_bytes(model.read_bytes()[:-10])
    eggs = root / "eggs"
    damaged = tmp_path / "bad.safetensors"
    in_format = "expected a descriptor in the format"
    absent = ["retrieve", eggs, "--descriptor", tmp_path / "no.safetensors"]
    for words, message in (
        (
            ["fit", eggs, "--out", tmp_path / "mine.pt"],
            "out: expected a file ending in .safetensors",
        ),
        (["classify", eggs, "--model", damaged], in_format),
        (["retrieve", eggs, "--descriptor", damaged], in_format),
        (absent, "no such file. Check the path."),
    ):
        with pytest.raises(SystemExit, match="1"):
            call(root, *words)
        told = capsys.readouterr().err.strip().splitlines()[-1]
        assert told.startswith("igps: ")
        assert message in told


def test_what_no_file_can_hold_is_refused_before_anything_is_computed(tmp_path, capsys):
    for label in "ab":
        write_egg(tmp_path / "eggs" / label / "0.off", 1.0)
    options = ["--descriptor", "own_descriptors:Height", "--out", tmp_path / "mine.safetensors"]
    with pytest.raises(SystemExit):
        call(tmp_path, "fit", tmp_path / "eggs", *options)
    assert "expected to be made of modules of igps" in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("goal", ["known", "new"])
def test_too_few_classes_are_told_before_anything_is_computed(
    goal, root, tmp_path, nothing_is_computed, capsys
):
    folder = tmp_path / "few"
    n_classes = 2 if goal == "new" else 1
    classes = [path for path in sorted((root / "eggs").iterdir()) if path.is_dir()]
    for body_class in classes[:n_classes]:
        shutil.copytree(body_class, folder / body_class.name)
    with pytest.raises(SystemExit, match="1"):
        run("fit", folder, "--goal", goal, "--out", tmp_path / "m.safetensors")
    told = f"classes: expected at least {2 * n_classes}, one of them"
    assert told in capsys.readouterr().err

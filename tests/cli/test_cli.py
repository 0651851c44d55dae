import csv
import importlib.metadata
import json
import logging
import re
import shutil
import subprocess
import sys
from typing import get_type_hints

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from safetensors import safe_open

from commands import error_of, run
from igps.cli.commands import COMMANDS, ENDINGS, load_command
from igps.data.dataset import SignatureDataset
from igps.descriptors import NAMES, descriptor
from igps.descriptors.literature.d2 import D2
from igps.descriptors.registry import FIELD_NAMES
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor
from igps.retrieval import chi_square, rerank, retrieval_scores
from own_descriptors import CONFIG, SMALL, small_interior

INTERIOR = "own_descriptors:small_interior"


@pytest.fixture
def root(tmp_path):
    """Three balls and three long eggs."""
    for label, ratio in (("ball", 1.0), ("egg", 2.2)):
        for i in range(3):
            body = trimesh.creation.icosphere(subdivisions=2)
            body.vertices *= [1.0, 1.0 + 0.06 * i, ratio]
            path = tmp_path / "meshes" / label / f"{i}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            body.export(path)
    return tmp_path / "meshes"


def test_retrieve_prints_and_writes_what_python_computes(root, tmp_path, capsys):
    out = tmp_path / "out"
    run(
        "retrieve",
        root,
        "--descriptor",
        INTERIOR,
        "--out",
        out,
        "--cache_dir",
        tmp_path / "cache",
        *SMALL,
    )
    printed = capsys.readouterr().out

    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    histograms = describe(dataset, small_interior())
    distances = chi_square(histograms, histograms)
    expected = retrieval_scores(distances, dataset.bodies.labels or ())

    scores = json.loads((out / "scores.json").read_text())
    assert {
        "nn",
        "ft",
        "st",
        "e",
        "dcg",
        "adr",
        "adr_self",
        "map",
        "n_queries",
        "per_class",
        "config",
        "plain_numbers",
    } | {
        "n_given",
        "n_used",
        "n_refused",
    } == set(scores)
    assert [scores[name] for name in ("n_queries", "n_given", "n_used", "n_refused")] == [
        6,
        6,
        6,
        0,
    ]
    found = {name: scores[name] for name in expected.mean()}
    assert found == pytest.approx(expected.mean())
    assert scores["per_class"]["egg"]["ft"] == pytest.approx(expected.per_class()["egg"]["ft"])
    assert scores["config"]["resolution"] == 10
    assert f"{100 * expected.mean()['ft']:.1f}" in printed
    for word in ("NN", "ADR self", "mAP", "ball", "egg", "6 queries"):
        assert word in printed

    with np.load(out / "distances.npz") as archive:
        assert_allclose(archive["distances"], distances, atol=1e-7)
        assert archive["names"].tolist() == list(dataset.bodies.names)
        assert archive["labels"].tolist() == ["ball"] * 3 + ["egg"] * 3
    rows = list(csv.DictReader((out / "ranking.csv").open(newline="")))
    assert len(rows) == 6 * 5
    for i, name in enumerate(dataset.bodies.names):
        ranked = [row for row in rows if row["query"] == name]
        others = [j for j in torch.argsort(distances[i], stable=True).tolist() if j != i]
        assert [row["model"] for row in ranked] == [dataset.bodies.names[j] for j in others]
        assert [row["relevant"] for row in ranked] == [str(int(i // 3 == j // 3)) for j in others]
    assert not (out / "failures.csv").exists()


def test_some_bodies_ask_the_others(root, tmp_path, capsys):
    """The second egg and ball ask the first and the third."""
    words = ["--descriptor", INTERIOR, "--cache_dir", tmp_path / "cache", *SMALL]
    out = tmp_path / "out"
    run("retrieve", root, "--queries", "*/1.off", "--out", out, *words)
    assert "2 queries, each against all that are no queries" in capsys.readouterr().out
    rows = list(csv.DictReader((out / "ranking.csv").open(newline="")))
    assert {row["query"] for row in rows} == {"ball/1.off", "egg/1.off"}
    for row in rows:
        assert row["model"].endswith(("0.off", "2.off"))
    assert len(rows) == 2 * 4
    with np.load(out / "distances.npz") as archive:
        distances = archive["distances"][[1, 4]][:, [0, 2, 3, 5]]
    expected = retrieval_scores(distances, ["ball", "egg"], ["ball", "ball", "egg", "egg"]).mean()
    scores = json.loads((out / "scores.json").read_text())
    assert {name: scores[name] for name in expected} == pytest.approx(expected)
    wrong = error_of(capsys, "retrieve", root, "--queries", "left/*", *words)
    assert "queries: expected a pattern that some bodies match, 0 of 6 match" in wrong


def test_bodies_of_which_no_two_share_a_class_are_ranked_without_scores(root, tmp_path, capsys):
    words = ["--descriptor", INTERIOR, "--cache_dir", tmp_path / "cache", *SMALL]
    out = tmp_path / "out"
    run("retrieve", root, "--classes", "file", "--out", out, *words)
    assert "no class has two bodies: rankings without scores" in capsys.readouterr().out
    rows = list(csv.DictReader((out / "ranking.csv").open(newline="")))
    assert [row["relevant"] for row in rows] == ["0"] * 6 * 5
    assert set(json.loads((out / "scores.json").read_text())) == {
        "n_given",
        "n_used",
        "n_refused",
        "config",
    }


def test_results_are_written_though_nobody_reads_what_is_printed(root, tmp_path, monkeypatch):
    def gone(*words):
        raise BrokenPipeError

    monkeypatch.setattr("igps.cli.retrieval_commands.print", gone, raising=False)
    with pytest.raises(SystemExit):
        run("retrieve", root, "--descriptor", "d2", "--out", tmp_path / "out", *SMALL)
    assert (tmp_path / "out" / "scores.json").exists()


def test_retrieve_reranks_in_a_table_of_its_own(root, tmp_path, capsys):
    options = ("--descriptor", INTERIOR, "--cache_dir", tmp_path / "cache", *SMALL)
    for name, further in (("plain", ()), ("both", ("--rerank",))):
        run("retrieve", root, "--out", tmp_path / name, *options, *further)
    printed = capsys.readouterr().out
    assert printed.count("re-ranked by the whole collection") == 1
    plain, both = (
        json.loads((tmp_path / name / "scores.json").read_text()) for name in ("plain", "both")
    )
    with np.load(tmp_path / "both" / "distances.npz") as archive:
        expected = rerank(torch.from_numpy(archive["distances"]))
        assert_allclose(archive["reranked"], expected, atol=1e-7)
        labels = archive["labels"].tolist()
    assert both.pop("reranked") == pytest.approx(retrieval_scores(expected, labels).mean())
    assert both == plain
    assert "reranked" not in plain


def test_gps_is_another_descriptor_on_the_same_cache(root, tmp_path):
    for name in ("interior", "gps"):
        arguments = [
            "--descriptor",
            f"own_descriptors:small_{name}",
            "--out",
            tmp_path / name,
            "--cache_dir",
            tmp_path / "cache",
            *SMALL,
        ]
        run("retrieve", root, *arguments)
    interior, gps = (
        json.loads((tmp_path / name / "scores.json").read_text()) for name in ("interior", "gps")
    )
    assert interior["config"].pop("descriptor") == INTERIOR
    assert gps["config"].pop("descriptor") == "own_descriptors:small_gps"
    assert interior["config"] == gps["config"]
    archives = [
        np.load(tmp_path / name / "distances.npz")["distances"] for name in ("interior", "gps")
    ]
    assert np.abs(archives[0] - archives[1]).max() > 1e-3
    kept = [
        path for path in (tmp_path / "cache").rglob("*.safetensors") if "signatures" in path.parts
    ]
    assert len(kept) == 6


def test_a_second_run_describes_nothing_and_leaves_the_same_table(root, tmp_path, monkeypatch):
    def retrieved(name):
        arguments = [
            "--descriptor",
            "d2",
            "--out",
            tmp_path / name,
            "--cache_dir",
            tmp_path / "cache",
            *SMALL,
        ]
        run("retrieve", root, *arguments)
        return {path.name: path.read_bytes() for path in (tmp_path / name).glob("*.[cj]s*")}

    first = retrieved("first")
    assert {"scores.json", "ranking.csv"} <= first.keys()

    def described(job):
        raise AssertionError("described again")

    monkeypatch.setattr("igps.nn.description.describe_timed", described)
    assert retrieved("second") == first


def test_only_the_eigenpairs_that_are_needed_are_computed(root, tmp_path):
    """Unless a number is given, and unless a cache has more."""
    for path in (
        *root.glob("egg/*"),
        root / "ball" / "2.off",
    ):  # 250 eigenpairs of each take a while
        path.unlink()
    options = [option for option in SMALL if option not in ("--signature.n_eigenpairs", "20")]

    def retrieved(cache, *more):
        out = tmp_path / "out"
        run(
            "retrieve",
            root,
            "--out",
            out,
            "--cache_dir",
            tmp_path / cache,
            *options,
            *more,
        )
        with np.load(out / "distances.npz") as archive:
            return json.loads((out / "scores.json").read_text())["config"]["n_eigenpairs"], archive[
                "distances"
            ]

    def computed(cache):
        found = set()
        for file in (tmp_path / cache).rglob("*.safetensors"):
            with safe_open(file, framework="numpy") as opened:
                if "eigenvalues" in opened.keys():  # noqa: SIM118
                    found.add(len(opened.get_tensor("eigenvalues")))
        return found

    n_eigenpairs, few = retrieved("cache", "--descriptor", "shape_dna")
    assert n_eigenpairs == 64
    assert computed("cache") == {64}
    retrieved("cache", "--descriptor", "interior")
    assert computed("cache") == {64, 250}
    retrieved("of interior", "--descriptor", "interior")
    n_eigenpairs, same = retrieved("of interior", "--descriptor", "shape_dna")
    assert n_eigenpairs == 64
    assert computed("of interior") == {64, 250}  # the first 64 of 250, under a key of their own
    assert_allclose(same, few, atol=1e-6)
    retrieved("explicit", "--descriptor", "shape_dna", "--signature.n_eigenpairs", "70")
    assert computed("explicit") == {70}


def test_bad_mesh_is_skipped_and_listed_or_stops_the_run(root, tmp_path, capsys):
    (root / "egg" / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    arguments = [
        "retrieve",
        root,
        "--descriptor",
        INTERIOR,
        "--cache_dir",
        tmp_path / "cache",
        "--out",
        tmp_path / "out",
        *SMALL,
    ]
    run(*arguments)
    assert "1 of 7 bodies could not be used" in capsys.readouterr().out
    (row,) = csv.DictReader((tmp_path / "out" / "failures.csv").open(newline=""))
    assert row["name"] == "egg/bad.off"
    assert "a single triangle" in row["error"]
    scores = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert [scores[name] for name in ("n_queries", "n_given", "n_used", "n_refused")] == [
        6,
        7,
        6,
        1,
    ]

    with pytest.raises(SystemExit, match="1"):
        run(*arguments, "--strict")
    error = capsys.readouterr().err
    assert "bad.off" in error
    assert "Traceback" not in error

    (root / "egg" / "bad.off").unlink()
    run(*arguments)
    assert not (tmp_path / "out" / "failures.csv").exists()


def test_extract_files_and_folder(root, tmp_path):
    files = [root / "egg" / "1.off", root / "ball" / "0.off"]
    common = ["--descriptor", INTERIOR, "--cache_dir", tmp_path / "cache", *SMALL]
    run("extract", *files, "--out", tmp_path / "two.npz", *common)
    run("extract", root, "--out", tmp_path / "deep" / "all.npz", *common)
    with np.load(tmp_path / "two.npz") as two, np.load(tmp_path / "deep" / "all.npz") as everything:
        assert two["names"].tolist() == [str(f) for f in files]
        assert two["features"].shape == (2, 10, 64)
        assert_allclose(two["features"].sum(axis=(1, 2)), 1, atol=1e-5)
        assert everything["labels"].tolist() == ["ball"] * 3 + ["egg"] * 3
        assert_allclose(two["features"], everything["features"][[4, 0]], atol=1e-7)


def test_extract_short_vectors(root, tmp_path, capsys):
    """Of `pretrained`, of which a database takes no more than 256 numbers; a histogram has none."""
    common = ["extract", root / "egg", "--cache_dir", tmp_path / "cache", "--n_workers", "1"]
    run(*common, "--out", tmp_path / "long.npz")
    run(*common, "--short", "--out", tmp_path / "short.npz")
    with np.load(tmp_path / "long.npz") as long, np.load(tmp_path / "short.npz") as short:
        assert long["features"].shape[1] > 256 >= short["features"].shape[1]
        assert_allclose(np.linalg.norm(short["features"], axis=1), 1, atol=1e-5)
        module = descriptor("pretrained")
        assert isinstance(module, EmbeddedDescriptor)
        expected = module.shorten(torch.from_numpy(long["features"])).numpy()
        assert_allclose(short["features"], expected, atol=1e-6)
    with pytest.raises(SystemExit, match="1"):
        run(
            *common,
            "--short",
            "--descriptor",
            INTERIOR,
            "--out",
            tmp_path / "none.npz",
        )
    assert "short: expected a descriptor of vectors, such as pretrained" in capsys.readouterr().err
    assert not (tmp_path / "none.npz").exists()
    run(*common, "--short", "--size", "keep", "--out", tmp_path / "sized.csv")
    assert "size.log_area to size.log_volume are no part of it" in capsys.readouterr().out
    with (tmp_path / "sized.csv").open(newline="") as table:
        row = next(csv.DictReader(table))
    vector = [float(row[name]) for name in row if name.startswith("short.")]
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-5)
    assert {"size.log_area", "size.log_volume"} < row.keys()


def test_query_lists_the_nearest(root, tmp_path, capsys):
    wanted = tmp_path / "wanted.off"
    wanted.write_bytes((root / "egg" / "1.off").read_bytes())
    run(
        "query",
        wanted,
        "--gallery",
        root,
        "--top",
        "4",
        "--descriptor",
        INTERIOR,
        "--cache_dir",
        tmp_path / "cache",
        *SMALL,
    )
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split() == ["rank", "distance", "body", "class"]
    assert len(lines) == 4
    assert lines[0].split() == ["1", "0", "egg/1.off", "egg"]
    histograms = describe(SignatureDataset(root, CONFIG, tmp_path / "cache"), small_interior())
    distances = chi_square(histograms[4:5], histograms)[0]
    names = [f"{label}/{i}.off" for label in ("ball", "egg") for i in range(3)]
    nearest = torch.argsort(distances, stable=True)[:4].tolist()
    assert [line.split()[2] for line in lines] == [names[i] for i in nearest]
    assert [float(line.split()[1]) for line in lines] == pytest.approx(
        distances[nearest].tolist(), rel=5e-3
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["retrieve", "nowhere"], "no such folder"),
        (["retrieve", "ROOT/egg"], "no classes found"),
        (
            ["retrieve", "ROOT", "--descriptor", "best"],
            f"expected one of {', '.join([*NAMES, *FIELD_NAMES])}, or .*, got 'best'",
        ),
        (
            ["retrieve", "ROOT"],
            "n_eigenpairs: this descriptor needs signatures of at least 90, got 20",
        ),
        (
            ["retrieve", "ROOT", "--signature.max_vertices", "0"],
            "max_vertices: expected more than .*, got 0",
        ),
        (["outliers", "ROOT", "--top", "-1"], "top: expected at least 0, got -1"),
        (["query", "ROOT/egg/1.off", "--gallery", "ROOT", "--top", "0"], "top"),
        (
            ["query", "nowhere.off", "--gallery", "ROOT", "--descriptor", "d2"],
            "no such file|cannot be read",
        ),
        (
            ["retrieve", "ROOT", "--paper", "--mend", "never", "--n_workers", "1"],
            "none of 6 bodies could be used.*expected at least 252 vertices for 250 eigenpairs",
        ),
    ],
)
def test_errors_are_one_line(root, tmp_path, capsys, arguments, message):
    logging.disable(logging.WARNING)
    options = [] if "--paper" in arguments else SMALL
    try:
        with pytest.raises(SystemExit, match="1"):
            run(
                *[a.replace("ROOT", str(root)) for a in arguments],
                "--cache_dir",
                tmp_path,
                *options,
            )
    finally:
        logging.disable(logging.NOTSET)
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("igps: ")]
    assert len(error) == 1
    assert re.search(message, error[0])


def test_too_few_eigenpairs_are_refused_in_the_same_words_as_in_python(root, tmp_path, capsys):
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    with pytest.raises(ValueError, match="needs signatures of at least 250, got 20") as raised:
        describe(dataset, descriptor("interior"))
    with pytest.raises(ValueError, match="got 20") as of_batch:
        descriptor("interior")(dataset.batch([0]))
    assert str(of_batch.value) == str(raised.value)
    for command in (
        ["retrieve", root],
        ["extract", root, "--out", tmp_path / "x.npz"],
        ["compare", root],
    ):
        chosen = ["--descriptors" if command[0] == "compare" else "--descriptor", "interior"]
        with pytest.raises(SystemExit, match="1"):
            run(*command, *chosen, "--cache_dir", tmp_path / "cache", *SMALL)
        assert f"igps: {raised.value}" in capsys.readouterr().err.splitlines()


def test_a_compared_descriptor_retrieves(root, tmp_path):
    out = tmp_path / "out"
    options = ["--cache_dir", tmp_path / "cache", *SMALL]
    run("retrieve", root, "--descriptor", "d2", "--out", out, *options)
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    described = describe(dataset, D2(), n_workers=1)
    expected = torch.cdist(described, described, p=1) / 2
    with np.load(out / "distances.npz") as archive:
        assert_allclose(archive["distances"], expected, atol=1e-6)
    scores = json.loads((out / "scores.json").read_text())
    assert scores["ft"] == pytest.approx(retrieval_scores(expected, dataset.labels).mean()["ft"])
    assert scores["config"]["descriptor"] == "d2"


def test_a_mesh_that_cannot_be_described_is_a_failure(root, tmp_path, capsys):
    logging.disable(logging.WARNING)
    (root / "egg" / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    arguments = [
        "retrieve",
        root,
        "--descriptor",
        "own_descriptors:picky",
        "--out",
        tmp_path / "out",
    ]
    arguments += ["--cache_dir", tmp_path / "cache", *SMALL]
    try:
        run(*arguments)
        assert "2 of 7 bodies could not be used" in capsys.readouterr().out
        rows = list(csv.DictReader((tmp_path / "out" / "failures.csv").open(newline="")))
        assert [row["name"] for row in rows] == ["egg/bad.off", "egg/1.off"]
        assert "too much" in rows[1]["error"]
        scores = json.loads((tmp_path / "out" / "scores.json").read_text())
        assert [scores[name] for name in ("n_queries", "n_given", "n_used", "n_refused")] == [
            5,
            7,
            5,
            2,
        ]
        (root / "egg" / "bad.off").unlink()
        with pytest.raises(SystemExit, match="1"):
            run(*arguments, "--strict")
        assert "too much" in capsys.readouterr().err
    finally:
        logging.disable(logging.NOTSET)


def test_an_interruption_is_told_in_a_line(own_commands, capsys):
    with pytest.raises(SystemExit, match="130"):
        run("wait")
    assert (
        capsys.readouterr().err
        == "igps: interrupted. Run again to continue: finished results are kept.\n"
    )


def test_what_takes_more_memory_than_there_is_is_told_in_a_line(own_commands, capsys):
    with pytest.raises(SystemExit, match="2"):
        run("ask")
    assert re.fullmatch(
        r"igps: out of memory \(.*1.00 PiB.*\). Reduce the input, .*\n", capsys.readouterr().err
    )


def test_the_version_is_that_of_the_distribution(capsys):
    with pytest.raises(SystemExit, match="0"):
        run("--version")
    assert capsys.readouterr().out.startswith(
        f"igps {importlib.metadata.version('interior-gps')}, signatures "
    )


def test_json_is_what_the_table_tells(root, tmp_path, capsys):
    options = ["--cache_dir", tmp_path / "cache", "--n_workers", "1", *SMALL]
    out = tmp_path / "out"
    run("retrieve", root, "--descriptor", INTERIOR, "--out", out, "--json", *options)
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((out / "scores.json").read_text())
    assert "ADR self" in printed.err  # the table, where progress goes

    wanted = root / "ball" / "1.off"
    run(
        "query",
        wanted,
        "--gallery",
        root,
        "--top",
        "3",
        "--descriptor",
        INTERIOR,
        "--json",
        *options,
    )
    rows = json.loads(capsys.readouterr().out)
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    histograms = describe(dataset, small_interior())
    distances = chi_square(histograms[1:2], histograms)[0]
    order = distances.argsort()[:3]
    assert [row["name"] for row in rows] == [dataset.bodies.names[i] for i in order]
    assert [row["distance"] for row in rows] == pytest.approx(distances[order].tolist(), abs=1e-6)
    assert rows[0]["rank"] == 1
    assert rows[0]["class"] == "ball"
    words = [
        "query",
        wanted,
        "--gallery",
        root / "ball",
        "--top",
        "1",
        "--descriptor",
        INTERIOR,
        "--json",
        *options,
    ]
    run(*words)
    assert json.loads(capsys.readouterr().out)[0]["class"] is None  # the folder tells none

    run("compare", root, "--descriptors", INTERIOR, "--json", *options)
    (row,) = json.loads(capsys.readouterr().out)
    expected = retrieval_scores(
        chi_square(histograms, histograms), dataset.bodies.labels or ()
    ).mean()
    assert {name: row[name] for name in expected} == pytest.approx(expected)


def test_json_has_no_numbers_that_json_does_not_know(root, tmp_path, capsys):
    """The scores of a class of one mesh are not defined."""
    for path in sorted((root / "egg").iterdir())[1:]:
        path.unlink()
    options = ["--cache_dir", tmp_path / "cache", "--n_workers", "1", *SMALL]
    run("retrieve", root, "--descriptor", INTERIOR, "--json", *options)

    def refuse(name):
        raise AssertionError(name)

    found = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert found["per_class"].get("egg", {"nn": None})["nn"] is None
    assert found["n_queries"] == 3


def test_json_of_two_bodies_and_of_copies(root, tmp_path, capsys):
    """A body, its copy at twice the size, and another."""
    ball = root / "ball" / "0.off"
    egg = root / "egg" / "0.off"
    larger = root / "egg" / "1.off"
    for path in sorted(root.rglob("*.off")):
        if path not in (ball, egg, larger):
            path.unlink()
    trimesh.load(egg, process=False).apply_scale(2).export(larger)
    options = ["--cache_dir", tmp_path / "cache", "--n_workers", "1", "--json"]
    run("duplicates", root, *options)
    found = json.loads(capsys.readouterr().out)
    assert found["groups"] == [["egg/0.off", "egg/1.off"]]
    assert found["n_files"] == 3
    assert found["n_skipped"] == 0
    (pair,) = found["pairs"]
    assert pair["files"] == ["egg/0.off", "egg/1.off"]
    for other in (larger, ball):
        run("explain", egg, other, *options)
        printed = capsys.readouterr()
        told = json.loads(printed.out)
        assert told["meaning"] in printed.err  # the sentence, where progress goes


WRITING = [name for name in COMMANDS if "out" in get_type_hints(load_command(name).function)]


@pytest.mark.usefixtures("nothing_is_computed")
@pytest.mark.parametrize("command", WRITING)
def test_a_place_that_cannot_be_written_is_told_before_anything_is_computed(
    command, root, tmp_path, monkeypatch, capsys
):
    endings = ENDINGS.get(command)
    given = [
        *command.split(),
        *([] if command == "demo" else [root]),
        *(["--model", "none"] if command == "classify" else []),
    ]
    name = f"there{(endings or ['.csv'])[0]}"

    def told(place):
        with pytest.raises(SystemExit, match="1"):
            run(*given, "--out", place)
        return capsys.readouterr().err.splitlines()[-1]

    (tmp_path / "file").touch()
    assert told(tmp_path / "file" / name) == (
        f"igps: out: expected a folder, {tmp_path / 'file'} is a file. Choose another path."
    )
    (tmp_path / name).touch() if endings is None else (tmp_path / name).mkdir()
    kind, other = ("folder", "file") if endings is None else ("file", "folder")
    assert (
        told(tmp_path / name)
        == f"igps: out: expected a {kind}, {tmp_path / name} is a {other}. Choose another path."
    )
    if endings:
        assert told(tmp_path / "there.zip").startswith("igps: out: expected a file ending in ")
    monkeypatch.setattr("os.access", lambda *_: False)
    assert told(tmp_path / "new" / name).startswith(
        f"igps: out: no permission to write to {tmp_path}."
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["retrieve", "ROOT", "--descriptor", "d2", "--with", "ct"],
            "attributes: expected 'ct' of each body",
        ),
        (["explain", "ROOT", "--level", "2"], "level: expected a number between 0 and 1, got 2.0"),
        (["groups", "ROOT", "--n_permutations", "0"], "n_permutations: expected at least 1, got 0"),
        (
            ["retrieve", "ROOT", "--classes", "file"],
            "root: expected a class of two bodies or more, got 6 classes of one.",
        ),
        (
            ["fit", "ROOT", "--out", "ROOT"],
            "out: expected a new or empty folder, or a model's, ROOT holds ",
        ),
        (["report", "TWO", "--meshes", "none"], "meshes: none: no such folder."),
        (["demo", "--n_workers", "0"], "n_workers: expected at least 1, got 0."),
        (
            ["retrieve", "ROOT", "--descriptor", ":"],
            "descriptor: expected package.module:NAME to be importable",
        ),
        (
            ["retrieve", "ROOT", "--descriptor", "own_descriptors:write_egg"],
            "descriptor: expected own_descriptors:",
        ),
        (
            ["retrieve", "ROOT", "--memory_limit", "-1"],
            "memory_limit: expected a positive number, got -1.0.",
        ),
        (
            ["retrieve", "ROOT", "--memory_limit", "1e400"],
            "memory_limit: expected a positive number, got inf.",
        ),
        (
            ["explain", "BALL"],
            "meshes: expected two files, or a folder of two groups, got 1 file.",
        ),
        (
            ["explain", "BALL", "BALL", "BALL"],
            "meshes: expected two files, or a folder of two groups, got 3 files.",
        ),
        (["explain", "ROOT", "ROOT"], "ROOT: expected a file, got a folder."),
        (["query", "none.off", "--gallery", "ROOT"], "none.off: no such file."),
        (
            ["clusters", "ROOT", "--n_clusters", "7"],
            "n_clusters: expected 1 to 6, the bodies of the folder, got 7.",
        ),
        (
            ["clusters", "ROOT", "--n_clusters", "0"],
            "n_clusters: expected 1 to 6, the bodies of the folder, got 0.",
        ),
        (["clusters", "ROOT", "--n_resamples", "-1"], "n_resamples: expected at least 0, got -1."),
        (["clusters", "TWO"], "root: expected three bodies or more, TWO has 2."),
        (["clusters", "ROOT", "--seed", "-1"], "seed: expected 0 to 4294967295, got -1."),
        (
            ["groups", "ROOT", "--seed", "4294967296"],
            "seed: expected 0 to 4294967295, got 4294967296.",
        ),
        (["clusters", "ROOT", "--layout", "umap"], "layout: umap needs umap-learn."),
        (
            ["retrieve", "ROOT", "--with", "ct=-1"],
            "descriptor: expected +NAME or +NAME=WEIGHT after the name of a descriptor, such as +ct=0.5",
        ),
        (
            ["classify", "ROOT", "--model", "plain.safetensors"],
            "model: expected a classifier, got d2.",
        ),
    ],
)
def test_what_is_missing_or_out_of_range_is_told_before_anything_is_computed(
    words, told, root, tmp_path, here, nothing_is_computed, monkeypatch, capsys
):
    descriptor("d2").save("plain.safetensors", {})
    shutil.copytree(root / "egg", tmp_path / "TWO")
    (tmp_path / "TWO" / "2.off").unlink()
    places = {"ROOT": str(root), "BALL": str(root / "ball" / "0.off")}
    monkeypatch.setitem(sys.modules, "umap", None)
    with pytest.raises(SystemExit, match="1"):
        run(*(places.get(word, word) for word in words))
    assert capsys.readouterr().err.startswith(f"igps: {told.replace('ROOT', str(root))}")


@pytest.mark.usefixtures("nothing_is_computed")
def test_a_list_of_failures_is_no_folder(root, tmp_path, capsys):
    with pytest.raises(SystemExit, match="1"):
        run("precompute", root, "--failures", tmp_path)
    assert (
        capsys.readouterr().err
        == f"igps: failures: expected a file, {tmp_path} is a folder. Choose another path.\n"
    )


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_knows_commands_and_options(shell, tmp_path, capsys):
    """The shell itself reads the script, and completes by it."""
    run("help", shell)
    script = capsys.readouterr().out
    for word in ("retrieve", "doctor", "--mend", "--cache_dir"):
        assert word in script
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    path = tmp_path / "script"
    path.write_text(script)
    subprocess.run([program, "-n", str(path)], check=True)
    typed = {
        "igps comp": ["compare"],
        "igps gallery r": ["remove"],
        "igps gallery build --des": ["--descriptor"],
        "igps doctor --js": ["--json"],
        "igps retrieve --mend a": ["auto", "always"],
    }
    for line, expected in typed.items() if shell == "bash" else ():
        words = line.split()
        ask = (
            f"source {path}; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; "
            + "$(complete -p igps | sed 's/.*-F \\([^ ]*\\).*/\\1/') "
            + f"igps {words[-1]} {words[-2]}; echo ${{COMPREPLY[@]}}"
        )
        done = subprocess.run(
            [program, "-c", ask],
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.split() == expected, line

"""`igps report` and `--report`: the page is made with the results, or of their folder afterwards."""

import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from commands import run
from igps.report.page import render_page
from igps.report.pictures import surfaces_of
from igps.report.results import read_results, read_sources
from label_files import write_nifti
from own_descriptors import SMALL, write_egg

INTERIOR = "own_descriptors:small_interior"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for label, height in (("ball", 1.0), ("egg", 2.0)):
        (tmp_path / "meshes" / label).mkdir(parents=True)
        for i in range(2):
            write_egg(tmp_path / "meshes" / label / f"{i}.off", height + 0.1 * i, 2)
    return tmp_path / "meshes"


def data_of(page: Path) -> dict:  # type: ignore[type-arg]
    found = re.search(
        r'<script type="application/json" id="data">(.*?)</script>', page.read_text("utf-8")
    )
    assert found is not None
    return json.loads(found[1])


def options(out: Path, *more: object) -> list[object]:
    return ["--out", out, "--cache_dir", out.parent / "cache", "--n_workers", "1", *SMALL, *more]


@pytest.fixture
def retrieved(root: Path, tmp_path: Path) -> Path:
    """Results without a page."""
    run("retrieve", root, "--descriptor", INTERIOR, *options(tmp_path / "out"))
    return tmp_path / "out"


def test_retrieve_with_its_page(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    run("retrieve", root, "--descriptor", INTERIOR, *options(out, "--report"))
    assert capsys.readouterr().out.splitlines()[-1] == f"page of results: {out / 'report.html'}"
    data = data_of(out / "report.html")
    assert [shape["name"] for shape in data["shapes"]] == [
        "ball/0.off",
        "ball/1.off",
        "egg/0.off",
        "egg/1.off",
    ]
    assert all(shape["mesh"][0] == 162 for shape in data["shapes"])  # an icosphere, divided twice
    assert data["systems"][0]["scores"] == pytest.approx(
        {
            name: value
            for name, value in json.loads((out / "scores.json").read_text()).items()
            if name in data["systems"][0]["scores"]
        },
        abs=1e-5,
    )
    dataset = read_sources(out)
    assert dataset is not None
    found = surfaces_of(dataset, n_workers=1)
    assert (out / "report.html").read_text("utf-8") == render_page(read_results(out), found)
    assert not re.search(
        re.escape(str(tmp_path)),
        (out / "report.html").read_text("utf-8"),
    )


def test_a_page_afterwards_wherever_the_meshes_are(
    root: Path, retrieved: Path, tmp_path: Path
) -> None:
    out = retrieved
    page = tmp_path / "pages" / "mine.html"
    assert not (out / "report.html").exists()
    moved = root.rename(tmp_path / "moved")

    def n_pictures(*more: object) -> int:
        run("report", out, "--out", page, "--n_workers", "1", *more)
        return sum("surface" in shape for shape in data_of(page)["shapes"])

    assert n_pictures() == 0
    assert n_pictures("--meshes", moved) == 4
    (out / "meshes.json").unlink()  # as in results of before there was one
    assert n_pictures() == 0
    assert len(data_of(page)["shapes"]) == 4


def test_compare_has_a_page(root: Path, tmp_path: Path) -> None:
    descriptors = ["--descriptors", INTERIOR, "own_descriptors:small_gps"]
    run("compare", root, *descriptors, *options(tmp_path / "compare", "--report"))
    data = data_of(tmp_path / "compare" / "report.html")
    rows = json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert [system["name"] for system in data["systems"]] == [row["descriptor"] for row in rows]
    for system, row in zip(data["systems"], rows, strict=True):
        for name in ("nn", "map"):  # of pairs the page has no tiers
            assert system["scores"][name] == pytest.approx(row[name])
    assert sum("surface" in shape for shape in data["shapes"]) == 4


def test_what_is_missing_is_told_before_anything_is_computed(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = ["--cache_dir", tmp_path / "cache"]
    for command in ("retrieve", "compare"):
        with pytest.raises(SystemExit, match="1"):
            run(command, root, "--report", *cache)
        assert "expected --out" in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()
    with pytest.raises(SystemExit, match="1"):
        run("report", tmp_path)
    assert "no results found" in capsys.readouterr().err


def test_sources_of_another_kind_are_refused(
    retrieved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong in ('{"format": "other"}', '{"format": "igps-meshes-1"}', "[]", "no JSON"):
        (retrieved / "meshes.json").write_text(wrong)
        with pytest.raises(SystemExit, match="1"):
            run("report", retrieved)
        assert "meshes.json: expected the format igps-meshes-1" in capsys.readouterr().err


def test_columns_of_the_labels_reach_the_page(root: Path, tmp_path: Path) -> None:
    names = [f"{label}/{i}.off" for label in ("ball", "egg") for i in range(2)]
    rows = [f"{name},{name[:3]},{i}" for i, name in enumerate(names)]
    (root / "labels.csv").write_text("\n".join(["file,label,age", *rows]))
    run(
        "retrieve",
        root,
        "--descriptor",
        INTERIOR,
        *options(tmp_path / "out", "--report"),
    )
    assert data_of(tmp_path / "out" / "report.html")["columns"] == {"age": ["0", "1", "2", "3"]}


def test_bodies_named_by_a_table_elsewhere_have_pictures(tmp_path: Path, here, monkeypatch) -> None:
    labels = np.zeros((24, 16, 16), np.uint8)
    labels[2:8, 3:12, 3:12] = 1
    labels[11:22, 5:9, 5:9] = 2
    for subject in range(2):
        write_nifti(tmp_path / "scans" / f"{subject}.nii.gz", labels[subject:])
    (tmp_path / "names.json").write_text('{"1": "block", "2": "bar"}')
    words = ["--classes", "body", "--names", "names.json", "--size", "ignore"]
    run(
        "retrieve",
        "scans",
        "--descriptor",
        INTERIOR,
        *words,
        *options(tmp_path / "out"),
    )
    with contextlib.chdir("/"):
        run("report", tmp_path / "out", "--n_workers", 1)
    names = {f"{subject}.nii.gz#{body}" for subject in range(2) for body in ("block", "bar")}
    shapes = data_of(tmp_path / "out" / "report.html")["shapes"]
    assert {shape["name"] for shape in shapes if "surface" in shape} == names

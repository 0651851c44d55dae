"""`igps report` and `--report`: the page is made with the results, or of their folder afterwards."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from igps.cli import main
from igps.report.page import page_of
from igps.report.results import read_results
from igps.report.surfaces import read_surfaces
from own_descriptors import SMALL, write_egg

INTERIOR = "own_descriptors:small_interior"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for label, height in (("ball", 1.0), ("egg", 2.0)):
        (tmp_path / "meshes" / label).mkdir(parents=True)
        for i in range(2):
            write_egg(tmp_path / "meshes" / label / f"{i}.off", height + 0.1 * i, 2)
    return tmp_path / "meshes"


def igps(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["igps", *map(str, words)])
    main()


def data_of(page: Path) -> dict:  # type: ignore[type-arg]
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text("utf-8"))
    assert found is not None
    return json.loads(found[1])


def options(out: Path, *more: object) -> list[object]:
    return ["--out", out, "--cache_dir", out.parent / "cache", "--n_workers", "1", *SMALL, *more]


@pytest.fixture
def retrieved(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results without a page."""
    igps(monkeypatch, "retrieve", root, "--descriptor", INTERIOR, *options(tmp_path / "out"))
    return tmp_path / "out"


def test_retrieve_with_its_page(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    igps(monkeypatch, "retrieve", root, "--descriptor", INTERIOR, *options(out, "--report"))
    assert capsys.readouterr().out.splitlines()[-1] == f"page of results: {out / 'report.html'}"
    data = data_of(out / "report.html")
    assert [shape["name"] for shape in data["shapes"]] == ["ball/0.off", "ball/1.off", "egg/0.off", "egg/1.off"]
    assert all(shape["mesh"][0] == 162 for shape in data["shapes"])  # an icosphere, divided twice
    assert data["systems"][0]["scores"] == pytest.approx(
        {name: value for name, value in json.loads((out / "scores.json").read_text()).items() if name in
         data["systems"][0]["scores"]}, abs=1e-5)  # fmt: skip
    kept = read_surfaces(out / "surfaces.npz")
    assert (out / "report.html").read_text("utf-8") == page_of(read_results(out), kept)
    assert not re.search(re.escape(str(tmp_path)), (out / "report.html").read_text("utf-8"))


def test_a_page_afterwards_wherever_the_meshes_are(
    root: Path, retrieved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, page = retrieved, tmp_path / "pages" / "mine.html"
    assert not (out / "report.html").exists()
    assert not (out / "surfaces.npz").exists()
    moved = root.rename(tmp_path / "moved")

    def n_pictures(*more: object) -> int:
        igps(monkeypatch, "report", out, "--out", page, "--n_workers", "1", *more)
        return sum("surface" in shape for shape in data_of(page)["shapes"])

    assert n_pictures() == 0
    assert n_pictures("--meshes", moved) == 4
    (out / "meshes.json").unlink()  # as in results of before there was one
    assert n_pictures() == 4
    (out / "surfaces.npz").unlink()
    assert n_pictures() == 0
    assert len(data_of(page)["shapes"]) == 4


def test_compare_has_a_page(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors = ["--descriptors", INTERIOR, "own_descriptors:small_gps"]
    igps(monkeypatch, "compare", root, *descriptors, *options(tmp_path / "compare", "--report"))
    data = data_of(tmp_path / "compare" / "report.html")
    rows = json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert [system["name"] for system in data["systems"]] == [row["descriptor"] for row in rows]
    assert [system["scores"]["ft"] for system in data["systems"]] == pytest.approx([row["ft"] for row in rows])
    assert sum("surface" in shape for shape in data["shapes"]) == 4


def test_what_is_missing_is_told_before_anything_is_computed(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = ["--cache_dir", tmp_path / "cache"]
    for command in ("retrieve", "compare"):
        with pytest.raises(SystemExit, match="1"):
            igps(monkeypatch, command, root, "--report", *cache)
        assert "expected --out" in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()
    with pytest.raises(SystemExit, match="1"):
        igps(monkeypatch, "report", tmp_path)
    assert "no results found" in capsys.readouterr().err


def test_sources_of_another_kind_are_refused(
    retrieved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong in ('{"format": "other"}', '{"format": "igps-meshes-1"}', "[]", "no JSON"):
        (retrieved / "meshes.json").write_text(wrong)
        with pytest.raises(SystemExit, match="1"):
            igps(monkeypatch, "report", retrieved)
        assert "meshes.json: expected the format igps-meshes-1" in capsys.readouterr().err

"""`igps damage`: what it prints and writes is what the study finds."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from training.studies.damage import damage as study
from training.studies.damages import DAMAGES
from training.study import main

from igps.data.dataset import SignatureDataset
from igps.signature.signature import SignatureConfig
from own_descriptors import SMALL, Root, write_egg

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)
ROOT = "own_descriptors:Root"


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    for label, heights in {"low": (1.0, 1.2), "high": (1.25, 3.0)}.items():
        for height in heights:
            write_egg(tmp_path / "meshes" / label / f"{height}.off", height, 2)
    return tmp_path / "meshes"


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: object) -> None:
    words = ["igps", "damage", *arguments, "--cache_dir", tmp_path / "cache", *SMALL]
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    main()


def test_table_and_file_say_what_the_study_finds(
    meshes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "deep" / "out"
    options = ["--descriptors", ROOT, "--damages", "soup", "fins", "--seed", "4", "--out", out]
    run(monkeypatch, tmp_path, meshes, *options)
    names, columns, *rows = capsys.readouterr().out.splitlines()
    written = json.loads((out / "damage.json").read_text())
    dataset = SignatureDataset(meshes, CONFIG, tmp_path / "cache")
    found = study(dataset, [Root()], damages=["soup", "fins"], seed=4, n_workers=1)["root"]
    assert written["results"] == {"root": {name: one.as_dict() for name, one in found.items()}}
    assert written["config"] == json.loads(json.dumps(CONFIG.as_dict()))
    assert written["damages"] == {name: one.description for name, one in DAMAGES.items()}
    assert names.split() == ["root"]
    assert columns.split() == ["used", "NN", "FT"]
    for row, (name, one) in zip(rows, found.items(), strict=False):
        used, nn, ft = row.split()[1:]
        assert row.split()[0] == name
        assert used == "100%"
        assert (float(nn), float(ft)) == pytest.approx(
            (100 * one.loss("nn"), 100 * one.loss("ft")), abs=0.051
        )
    assert f"  soup: {DAMAGES['soup'].description}" in rows
    assert not any(line.startswith("  holes") for line in rows)
    assert rows[-1] == f"written to {out}"


def test_never_mending_uses_nothing_of_a_soup(
    meshes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (meshes / "low" / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    run(
        monkeypatch,
        tmp_path,
        meshes,
        "--descriptors",
        ROOT,
        "--damages",
        "soup",
        "--mend_by",
        "never",
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split() == ["soup", "0%", "nan", "nan"]
    assert any(re.match(r"root, soup: 4 of 4 missing; .*boundary edges", line) for line in lines)
    assert any(line.startswith("not used: ") and "bad.off" in line for line in lines)


def test_every_so_many(
    meshes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run(
        monkeypatch,
        tmp_path,
        meshes,
        "--descriptors",
        ROOT,
        "--damages",
        "turned",
        "--every",
        "3",
        "--out",
        tmp_path,
    )
    result = json.loads((tmp_path / "damage.json").read_text())["results"]["root"]["turned"]
    assert result["n_given"] == 2
    assert capsys.readouterr().out.splitlines()[2].split()[:2] == ["turned", "100%"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--every", "0"], "every: expected at least 1, got 0"),
        (["--damages", "rust"], "damages: expected some of .*got 'rust'"),
        (["--descriptors", "interior"], "this descriptor needs signatures of at least 250, got 20"),
    ],
)
def test_errors_are_said_in_one_line(
    meshes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    chosen = [] if "--descriptors" in arguments else ["--descriptors", ROOT]
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch, tmp_path, meshes, *chosen, *arguments)
    assert re.search(f"igps: .*{message}", capsys.readouterr().err)


def test_help_explains_every_option(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["igps", "damage", "--help"])
    with pytest.raises(SystemExit, match="0"):
        main()
    text = capsys.readouterr().out
    for word in (
        "--damages",
        "--mend_by",
        "--every",
        "--seed",
        "--cache_dir",
        "--strict",
        "--signature.min_samples",
    ):
        assert word in text, word

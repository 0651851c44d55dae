"""`python -m training.study robustness`: what it prints and writes is what the study finds."""

from __future__ import annotations

import html
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from training.studies import robustness as study
from training.studies.disturbances import DISTURBANCES
from training.study import main

from igps.data.dataset import SignatureDataset
from igps.shapes import ArticulatedShapes
from igps.signature.signature import SignatureConfig
from own_descriptors import SMALL, Root, root_area, write_egg

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: object) -> dict:  # type: ignore[type-arg]
    out = tmp_path / "out"
    words = ["igps", "robustness", *arguments, "--out", out, "--cache_dir", tmp_path / "cache"]
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    main()
    return json.loads((out / "robustness.json").read_text())


def test_table_and_file_say_what_the_study_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = [write_egg(tmp_path / f"{height}.off", height) for height in (1.0, 1.5, 3.0)]
    written = run(monkeypatch, tmp_path, *meshes, "--descriptors", "own_descriptors:Root", *SMALL)
    header, row, *rest = capsys.readouterr().out.splitlines()
    found = study.robustness(
        SignatureDataset(meshes, CONFIG, tmp_path / "cache"), [Root()], n_workers=1
    ).as_dict()
    assert {key: written[key] for key in found} == json.loads(json.dumps(found))
    assert written["config"] == json.loads(json.dumps(CONFIG.as_dict()))
    size = np.array([root_area(path) for path in meshes])
    unit = np.median([size[1] - size[0], size[2] - size[0], size[2] - size[1]])
    assert written["median_between_classes"] == {"root": pytest.approx(unit)}
    assert header.split() == list(DISTURBANCES)
    cells = dict(zip(header.split(), row.split()[1:], strict=True))
    assert row.split()[0] == "root"
    assert cells["hole"] == cells["weld"] == "-"
    assert float(cells["scale"]) == pytest.approx(100 * np.mean(6 * size / unit), abs=0.06)
    assert "root, hole: 3 of 3 missing; a hole has no area" in rest
    assert any(
        re.match("root, weld: 3 of 3 missing; .*no two places face each other", line)
        for line in rest
    )
    for name, disturbance in DISTURBANCES.items():
        assert f"  {name}: {disturbance.description}" in rest


def test_gallery_and_poses_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = write_egg(tmp_path / "one.off", 1.2, 2)
    size = {}
    for label, heights in {"low": (1.0, 1.3), "high": (2.0, 5.0)}.items():
        size[label] = [
            root_area(write_egg(tmp_path / "gallery" / label / f"{x}.off", x, 2)) for x in heights
        ]
    poses = [root_area(write_egg(tmp_path / "poses" / f"{x}.off", x, 2)) for x in (1.0, 1.4)]
    (tmp_path / "poses" / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    options = ["--gallery", tmp_path / "gallery", "--poses", tmp_path / "poses"]
    written = run(
        monkeypatch, tmp_path, mesh, "--descriptors", "own_descriptors:Root", *options, *SMALL
    )
    unit = np.median([abs(low - high) for low in size["low"] for high in size["high"]])
    assert written["median_between_classes"]["root"] == pytest.approx(unit, rel=1e-4)
    assert written["movements"]["root"]["pose"]["each"] == {
        "1.0.off - 1.4.off": pytest.approx((poses[1] - poses[0]) / unit, rel=1e-3)
    }
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split()[-1] == "pose"
    assert any("from one pose of a body to another" in line for line in printed)
    assert any(line.startswith("not used: ") and "bad.off" in line for line in printed)


def test_rich_and_pretrained_are_measured_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ArticulatedShapes(n_classes=2, n_per_class=1, seed=3, n_vertices=1000).write(
        tmp_path / "meshes"
    )
    meshes = sorted((tmp_path / "meshes").rglob("*.off"))
    options = [
        "--signature.n_eigenpairs",
        "90",
        "--signature.resolution",
        "12",
        "--signature.min_samples",
        "0",
    ]
    options += ["--signature.n_surface_samples", "100", "--n_workers", "1"]
    written = run(monkeypatch, tmp_path, *meshes, "--descriptors", "rich", "pretrained", *options)
    rows = [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:3]]
    assert rows == ["rich", "pretrained"]
    for name in rows:
        movements = written["movements"][name]
        assert movements["scale"]["mean"] < 0.02
        assert movements["tenth"]["mean"] > movements["scale"]["mean"]
        assert all(
            len(movements[way]["each"]) + len(movements[way]["notes"]) == 2 for way in DISTURBANCES
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--descriptors", "magic"],
            "descriptor: expected one of interior, gps, .*spectral_gw, .*, got 'magic'",
        ),
        (["--descriptors", "d2"], "expected at least two.* or a gallery"),
        (
            ["--descriptors", "d2", "interior"],
            "this descriptor needs signatures of at least 250, got 20",
        ),
    ],
)
def test_errors_are_said_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch, tmp_path, write_egg(tmp_path / "egg.off", 1.5, 2), *arguments, *SMALL)
    assert re.search(f"igps: .*{message}", capsys.readouterr().err)


def test_robustness_has_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meshes = [write_egg(tmp_path / f"{height}.off", height) for height in (1.0, 2.0)]
    words = ["--descriptors", "own_descriptors:Root", "--report", "--n_workers", "1", *SMALL]
    written = run(monkeypatch, tmp_path, *meshes, *words)
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert found is not None
    data = json.loads(found[1])
    assert data["movements"] == written["movements"]
    assert [shape["name"] for shape in data["shapes"]] == list(map(str, meshes))
    assert sum("surface" in shape for shape in data["shapes"]) == 2
    assert all(one.description in html.unescape(page) for one in DISTURBANCES.values())


def test_robustness_without_a_folder_has_no_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = tmp_path / "cache"
    words = ["robustness", write_egg(tmp_path / "1.off", 1.0), "--report", "--cache_dir", cache]
    monkeypatch.setattr(sys, "argv", ["study", *map(str, words)])
    with pytest.raises(SystemExit, match="1"):
        main()
    assert "expected --out" in capsys.readouterr().err
    assert not cache.exists()

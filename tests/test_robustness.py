"""`igps robustness`: its table against distances worked out by hand, and what it says where there are none."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from conftest import horseshoe
from igps import baselines
from igps.baselines import Body
from igps.cli import main
from igps.geometry.disturbances import DISTURBANCES
from igps.geometry.reading import load_mesh

SMALL = ["--signature.n_eigenpairs", "20", "--signature.resolution", "10", "--signature.min_samples", "0"]
SMALL += ["--signature.n_surface_samples", "60", "--workers", "1"]


@dataclass(frozen=True)
class Root:
    """A system that sees the square root of the area, and refuses surfaces with a hole."""

    name: ClassVar[str] = "root"
    source: ClassVar[str] = "nobody"
    invariant_to: ClassVar[tuple[str, ...]] = ("motion",)

    def describe(self, body: Body) -> NDArray[np.float32]:
        if body.mesh.allow_open:
            raise ValueError("a hole has no area")
        assert body.mesh.area == pytest.approx(body.signature.area)
        return np.array([np.sqrt(body.mesh.area)], dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        return torch.cdist(queries, gallery)


@dataclass(frozen=True)
class Same:
    """A system that sees no difference at all."""

    name: ClassVar[str] = "same"
    source: ClassVar[str] = "nobody"
    invariant_to: ClassVar[tuple[str, ...]] = ("motion", "scale", "pose")

    def describe(self, body: Body) -> NDArray[np.float32]:
        return np.full(1, np.nan if body.signature.name.endswith("nan.off") else 0, dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        return torch.zeros(len(queries), len(gallery))


def write(path: Path, height: float, subdivisions: int = 3) -> Path:
    """An egg whose area differs with its height."""
    body = trimesh.creation.icosphere(subdivisions=subdivisions)
    body.vertices *= [1, 1, height]
    path.parent.mkdir(parents=True, exist_ok=True)
    body.export(path)
    return path


def root_area(path: Path) -> float:
    return float(np.sqrt(trimesh.load(path, process=False).area))


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: object) -> Mapping[str, Any]:
    out = tmp_path / "out"
    words = ["igps", "robustness", *arguments, "--out", out, "--cache", tmp_path / "cache", *SMALL]
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    main()
    return json.loads((out / "robustness.json").read_text())


@pytest.fixture
def simple(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the systems of this file."""
    known = {"root": Root(), "same": Same()}
    monkeypatch.setattr(baselines, "systems", lambda names=None: {name: known[name] for name in names or known})


@pytest.mark.usefixtures("simple")
def test_movements_are_shares_of_the_distance_between_the_meshes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = [write(tmp_path / f"{height}.off", height) for height in (1.0, 1.5, 3.0)]
    written = run(monkeypatch, tmp_path, *meshes, "--descriptors", "root")
    printed = capsys.readouterr().out
    size = np.array([root_area(path) for path in meshes])
    unit = np.median([size[1] - size[0], size[2] - size[0], size[2] - size[1]])
    assert written["median_between_classes"] == {"root": pytest.approx(unit)}
    movements = written["movements"]["root"]
    assert list(movements) == list(DISTURBANCES)
    expected = {str(path): 6 * one / unit for path, one in zip(meshes, size, strict=True)}
    assert movements["scale"]["each"] == pytest.approx(expected, rel=1e-5)
    assert movements["scale"]["mean"] == pytest.approx(np.mean(6 * size / unit), rel=1e-5)
    assert movements["motion"]["mean"] == pytest.approx(0, abs=1e-5)
    half = [np.sqrt(DISTURBANCES["half"].apply(load_mesh(path)).area) for path in meshes]
    moved = [abs(one - other) / unit for one, other in zip(half, size, strict=True)]
    assert list(movements["half"]["each"].values()) == pytest.approx(moved, rel=1e-3)

    assert movements["hole"] == {
        "mean": None,
        "each": {},
        "notes": dict.fromkeys(map(str, meshes), "a hole has no area"),
    }
    assert movements["weld"]["mean"] is None  # an egg has no gap
    header, row, *rest = printed.splitlines()
    assert header.split() == list(DISTURBANCES)
    cells = dict(zip(header.split(), row.split()[1:], strict=True))
    assert row.split()[0] == "root"
    assert cells["hole"] == cells["weld"] == "-"
    assert float(cells["scale"]) == pytest.approx(100 * np.mean(6 * size / unit), abs=0.06)
    assert "root, hole: 3 of 3 missing; a hole has no area" in rest
    assert any(re.match("root, weld: 3 of 3 missing; .*no two places face each other", line) for line in rest)
    for name, disturbance in DISTURBANCES.items():
        assert f"  {name}: {disturbance.description}" in rest


@pytest.mark.usefixtures("simple")
def test_gallery_tells_the_distance_between_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights = {"low": (1.0, 1.3), "high": (2.0, 2.4, 5.0)}
    size = {
        label: [root_area(write(tmp_path / "gallery" / label / f"{x}.off", x, 2)) for x in several]
        for label, several in heights.items()
    }
    mesh = write(tmp_path / "one.off", 1.2)
    arguments = [mesh, "--gallery", tmp_path / "gallery", "--descriptors", "root"]
    written = run(monkeypatch, tmp_path, *arguments)
    unit = np.median([abs(low - high) for low in size["low"] for high in size["high"]])
    assert written["median_between_classes"]["root"] == pytest.approx(unit, rel=1e-4)
    assert written["movements"]["root"]["scale"]["mean"] == pytest.approx(6 * root_area(mesh) / unit, rel=1e-4)


@pytest.mark.usefixtures("simple")
def test_poses_are_compared_within_each_body(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = [write(tmp_path / f"{height}.off", height, 2) for height in (1.0, 2.0)]
    unit = root_area(meshes[1]) - root_area(meshes[0])
    poses = [write(tmp_path / "poses" / f"{x}.off", x, 2) for x in (1.0, 1.1, 1.3)]
    size = [root_area(path) for path in poses]
    arguments = [*meshes, "--poses", tmp_path / "poses", "--descriptors", "root"]
    movement = run(monkeypatch, tmp_path, *arguments)["movements"]["root"]["pose"]
    expected = {
        "1.0.off - 1.1.off": (size[1] - size[0]) / unit,
        "1.0.off - 1.3.off": (size[2] - size[0]) / unit,
        "1.1.off - 1.3.off": (size[2] - size[1]) / unit,
    }
    assert movement["each"] == pytest.approx(expected, rel=1e-3)
    assert capsys.readouterr().out.splitlines()[0].split()[-1] == "pose"

    for name in ("a/1.off", "b/1.off", "b/2.off"):  # now two bodies, one of them in two poses
        write(tmp_path / "bodies" / name, 1 + 0.2 * len(name), 2)
    arguments[3] = tmp_path / "bodies"
    movement = run(monkeypatch, tmp_path, *arguments)["movements"]["root"]["pose"]
    assert list(movement["each"]) == ["b/1.off - b/2.off"]


@pytest.mark.usefixtures("simple")
def test_no_distance_between_classes_leaves_no_movement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = [write(tmp_path / name, 1.0) for name in ("a.off", "b.off", "nan.off")]
    written = run(monkeypatch, tmp_path, *meshes, "--descriptors", "same")
    assert written["median_between_classes"] == {"same": None}
    notes = written["movements"]["same"]["scale"]["notes"]
    assert "no distance between classes" in notes[str(meshes[0])]
    assert "not finite" in notes[str(meshes[2])]
    row = capsys.readouterr().out.splitlines()[1]
    assert set(row.split()[1:]) == {"-"}


def test_real_systems_on_a_body_with_a_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [write(tmp_path / "egg.off", 2.0), tmp_path / "ring.off"]
    ring = horseshoe(0.06)
    trimesh.Trimesh(ring.vertices, ring.faces, process=False).export(paths[1])
    movements = run(monkeypatch, tmp_path, *paths, "--descriptors", "interior", "d2")["movements"]
    for name in ("interior", "d2"):
        assert movements[name]["scale"]["mean"] < 1e-3
        assert set(movements[name]["hole"]["each"]) == set(map(str, paths))
        assert set(movements[name]["weld"]["each"]) == {str(paths[1])}
    # The weld makes the ring whole, which distances along the body notice and straight ones do not.
    assert movements["interior"]["weld"]["mean"] > 2 * movements["d2"]["weld"]["mean"]
    assert movements["interior"]["noise"]["mean"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--descriptors", "magic"], "no system is called magic"), ([], "expected at least two.* or a gallery")],
)
def test_errors_are_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    arguments: list[str], message: str,
) -> None:  # fmt: skip
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch, tmp_path, write(tmp_path / "egg.off", 1.5), *arguments)
    assert re.search(f"igps: .*{message}", capsys.readouterr().err)

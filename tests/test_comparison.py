"""`compare` and `igps compare`: rows, failures, files and figures of systems side by side."""

from __future__ import annotations

import contextlib
import csv
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from torch import Tensor

from igps import baselines, figures
from igps.baselines import Body, Result, compare, comparison, systems
from igps.cli import main
from igps.data.dataset import SignatureDataset
from igps.figures.comparison import precision_recall
from igps.geometry.signature import SignatureConfig
from igps.retrieval import precision_recall_curve, retrieval_scores

KEYS = ["descriptor", "nn", "ft", "st", "e", "dcg", "adr", "adr_self", "map"]
KEYS += ["seconds_per_mesh", "n_models", "invariant_to"]
CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)
SMALL = ["--signature.n_eigenpairs", "20", "--signature.resolution", "10", "--signature.min_samples", "0"]
SMALL += ["--signature.n_surface_samples", "60", "--workers", "1"]


@dataclass(frozen=True)
class Height:
    """A system that sees the height of a mesh, and does to one of its meshes what the test says."""

    name: ClassVar[str] = "height"
    source: ClassVar[str] = "nobody"
    invariant_to: ClassVar[tuple[str, ...]] = ("motion",)

    bad: str = "no such mesh"
    fault: str = "raise"

    def describe(self, body: Body) -> NDArray[np.float32]:
        height = np.ptp(body.mesh.vertices[:, 2])
        if body.signature.name.endswith(self.bad):
            if self.fault == "raise":
                raise ValueError(f"a height of {height:.1f} is too much")
            if self.fault == "kill":
                os._exit(1)
            if self.fault == "shape":
                return np.zeros(3, dtype=np.float32)
            return np.array([np.nan], dtype=np.float32)
        return np.array([height], dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        return (queries - gallery[:, 0]).abs()


class Broken(Height):
    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        raise RuntimeError("out of order")


@dataclass(frozen=True)
class Slow(Height):
    """Sleeps, works and reads the mesh: only the work is processor time."""

    def describe(self, body: Body) -> NDArray[np.float32]:
        time.sleep(0.3)
        end = time.process_time() + 0.05
        while time.process_time() < end:
            pass
        return super().describe(body)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three balls and three long eggs; the last ball is an egg by its height."""
    folder = tmp_path_factory.mktemp("collection")
    for label, heights in (("ball", (1.0, 1.1, 2.3)), ("egg", (2.2, 2.4, 2.6))):
        for i, height in enumerate(heights):
            surface = trimesh.creation.icosphere(subdivisions=2)
            surface.vertices *= [1.0, 1.0, height]
            path = folder / "meshes" / label / f"{i}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            surface.export(path)
    return folder / "meshes"


@pytest.fixture(scope="module")
def dataset(root: Path) -> SignatureDataset:
    collection = SignatureDataset(root, CONFIG, root.parent / "cache")
    assert collection.precompute(n_workers=1, progress=False) == []
    return collection


def run(dataset: SignatureDataset, n_workers: int = 1, **chosen: Any) -> dict[str, Result]:
    results = list(compare(dataset, chosen, n_workers=n_workers, progress=False))
    assert [result.name for result in results] == list(chosen)
    return {result.name: result for result in results}


def test_result_is_what_heights_give(dataset: SignatureDataset) -> None:
    result = run(dataset, tall=Height())["tall"]
    heights = torch.tensor([1.0, 1.1, 2.3, 2.2, 2.4, 2.6]) * 2
    assert result.distances is not None
    torch.testing.assert_close(result.distances, (heights[:, None] - heights).abs(), atol=1e-5, rtol=0)
    assert result.names == dataset.files.names
    assert result.labels == ("ball", "ball", "ball", "egg", "egg", "egg")
    row = result.row()
    assert list(row) == KEYS
    expected = retrieval_scores((heights[:, None] - heights).abs(), result.labels).mean()
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert 0 < row["nn"] < 1
    assert (row["descriptor"], row["n_models"], row["invariant_to"]) == ("tall", 6, ["motion"])
    assert not result.failures
    assert result.error is None


@pytest.mark.parametrize(("fault", "reason"), [("raise", "a height of 4.8 is too much"), ("nan", "not finite")])
def test_a_mesh_that_one_system_cannot_describe_is_its_failure_alone(
    dataset: SignatureDataset, fault: str, reason: str
) -> None:
    results = run(dataset, picky=Height("egg/1.off", fault), fine=Height())
    (failure,) = results["picky"].failures
    assert failure.id == "egg/1.off"
    assert reason in failure.error
    assert "1.off" in failure.error
    assert results["picky"].row()["n_models"] == 5
    assert results["picky"].labels == ("ball", "ball", "ball", "egg", "egg")
    alone = run(dataset.subset([0, 1, 2, 3, 5]), fine=Height())["fine"]
    assert results["picky"].row()["map"] == pytest.approx(alone.row()["map"])
    assert results["fine"].row()["n_models"] == 6


def test_strict_stops_at_the_first_failure(dataset: SignatureDataset) -> None:
    results = compare(
        dataset, {"fine": Height(), "picky": Height("egg/1.off")}, n_workers=1, strict=True, progress=False
    )
    assert next(results).name == "fine"
    with pytest.raises(ValueError, match=r"picky: .*too much"):
        next(results)


@pytest.mark.parametrize(
    ("system", "described", "reason"),
    [
        (Height("off"), 0, "no mesh could be described"),
        (Broken(), 6, "RuntimeError: out of order"),
        (Height("egg/1.off", "shape"), 6, "shape"),
    ],
)
def test_a_system_without_scores_does_not_stop_the_others(
    dataset: SignatureDataset, system: Height, described: int, reason: str
) -> None:
    results = run(dataset, hopeless=system, fine=Height())
    row = results["hopeless"].row()
    assert list(row) == KEYS
    assert all(row[key] is None for key in KEYS[1:9])
    assert row["n_models"] == described
    assert reason in (results["hopeless"].error or "")
    assert results["fine"].scores is not None


def test_seconds_are_the_processor_time_of_a_description(dataset: SignatureDataset) -> None:
    seconds = run(dataset.subset([0, 1]), slow=Slow())["slow"].seconds_per_mesh
    assert seconds is not None
    assert 0.05 <= seconds < 0.3


def test_distances_by_blocks_are_the_same(dataset: SignatureDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run(dataset, tall=Height())["tall"].distances
    sizes: list[tuple[int, int]] = []
    plain = Height.distances

    def remember(self: Height, queries: Tensor, gallery: Tensor) -> Tensor:
        sizes.append((len(queries), len(gallery)))
        return plain(self, queries, gallery)

    monkeypatch.setattr(Height, "distances", remember)
    monkeypatch.setattr(comparison, "_BLOCK_ENTRIES", 24)
    parts = run(dataset, tall=Height())["tall"].distances
    assert sizes == [(4, 6), (2, 6)]
    assert whole is not None
    assert parts is not None
    torch.testing.assert_close(parts, whole, rtol=0, atol=0)


def test_processes_give_what_one_does_and_one_that_is_killed_costs_one_mesh(dataset: SignatureDataset) -> None:
    few = dataset.subset([0, 1, 3, 4])
    results = run(few, n_workers=2, fine=Height(), deadly=Height("egg/1.off", "kill"))
    (failure,) = results["deadly"].failures
    assert failure.id == "egg/1.off"
    assert "killed" in failure.error
    assert results["deadly"].names == ("ball/0.off", "ball/1.off", "egg/0.off")
    expected = run(few, fine=Height())["fine"].distances
    assert expected is not None
    assert results["fine"].distances is not None
    torch.testing.assert_close(results["fine"].distances, expected, rtol=0, atol=0)


class FakePool:
    """An executor of this process that is broken by some jobs, after so many others in the same pool."""

    def __init__(self, deadly: Sequence[str], n_workers: int, log: list[int]) -> None:
        self.deadly, self.n_workers, self.log = deadly, n_workers, log

    def submit(self, function: Callable[[], Any]) -> Any:
        class Done:
            def result(self) -> Any:
                return function()

        return Done()

    def map(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Any]:
        self.log.append(self.n_workers)
        # With several workers the results before the deadly job may be lost too.
        names = [job[1].files.names[0] for job in jobs]
        lost = 1 if self.n_workers > 1 else 0
        for place, job in enumerate(jobs):
            if any(name in self.deadly for name in names[place : place + 1 + lost]):
                raise BrokenProcessPool
            yield function(job)


def test_every_deadly_mesh_is_found_and_the_rest_is_described(
    dataset: SignatureDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    log: list[int] = []
    deadly = ("ball/0.off", "egg/0.off", "egg/1.off", "egg/2.off")

    @contextlib.contextmanager
    def pool(n_workers: int) -> Iterator[FakePool]:
        yield FakePool(deadly, n_workers, log)

    monkeypatch.setattr(comparison, "process_pool", pool)
    result = run(dataset, n_workers=2, tall=Height())["tall"]
    assert [failure.id for failure in result.failures] == list(deadly)
    assert result.names == ("ball/1.off", "ball/2.off")
    assert log == [2, 1] * 4


def test_collection_without_classes_is_refused(root: Path) -> None:
    plain = SignatureDataset([root / "egg" / "0.off"], CONFIG, root.parent / "cache")
    with pytest.raises(ValueError, match="classes"):
        next(compare(plain, {"tall": Height()}))


def igps(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["igps", *map(str, arguments)])
    main()


def test_command_prints_and_writes_what_python_computes(
    root: Path, dataset: SignatureDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    out = tmp_path / "out"
    chosen = ["shape_dna", "d2", "interior"]
    cache = ["--cache", root.parent / "cache"]
    igps(monkeypatch, "compare", root, "--descriptors", *chosen, "--out", out, *cache, *SMALL)
    printed = capsys.readouterr().out.splitlines()

    results = run(dataset, **{name: systems()[name] for name in chosen})
    rows = json.loads((out / "compare.json").read_text())
    assert [list(row) for row in rows] == [KEYS] * 3
    for row, (name, result) in zip(rows, results.items(), strict=True):
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


def test_command_lists_failures_by_system_and_of_signatures(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logging.disable(logging.WARNING)
    bad = root / "egg" / "bad.off"
    bad.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    monkeypatch.setattr(baselines, "systems", lambda names: {"picky": Height("egg/1.off"), "broken": Broken()})
    arguments = ["compare", root, "--out", tmp_path, "--cache", root.parent / "cache", *SMALL]
    try:
        igps(monkeypatch, *arguments)
        rows = list(csv.reader((tmp_path / "failures.csv").open(newline="")))
        assert rows[0] == ["descriptor", "file", "error"]
        assert [row[:2] for row in rows[1:]] == [["all", "egg/bad.off"], ["picky", "egg/1.off"]]
        assert "boundary" in rows[1][2]
        assert "too much" in rows[2][2]
        printed = capsys.readouterr().out
        assert "2 meshes could not be used or described" in printed
        assert "broken: no scores: RuntimeError: out of order" in printed
        assert json.loads((tmp_path / "compare.json").read_text())[1]["nn"] is None

        bad.unlink()
        with pytest.raises(SystemExit, match="1"):
            igps(monkeypatch, *arguments, "--strict")
        assert "igps: picky: " in capsys.readouterr().err

        monkeypatch.setattr(baselines, "systems", lambda names: {"tall": Height()})
        igps(monkeypatch, *arguments)
        assert not (tmp_path / "failures.csv").exists()
    finally:
        logging.disable(logging.NOTSET)
        bad.unlink(missing_ok=True)


def test_unknown_system_is_named_before_anything_is_computed(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="1"):
        igps(monkeypatch, "compare", root, "--descriptors", "d2", "d5")
    assert "no system is called d5. There are interior, gps, d2" in capsys.readouterr().err


def test_curves_are_drawn_in_percent_and_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Figure] = []
    make = figures._figure

    def remember(width: float, height: float) -> Figure:
        made.append(make(width, height))
        return made[-1]

    monkeypatch.setattr("igps.figures.comparison._figure", remember)
    labels = [0, 0, 0, 1, 1, 1]
    draws = np.random.default_rng(0).random((12, 6, 6))
    curves = {f"system {i}": precision_recall_curve(torch.from_numpy(draw), labels) for i, draw in enumerate(draws)}
    precision_recall(curves, tmp_path / "deep" / "curves.png")
    (axes,) = made[0].axes
    assert len(axes.lines) == 12
    for line, (name, curve) in zip(axes.lines, curves.items(), strict=True):
        assert line.get_label() == name
        np.testing.assert_allclose(line.get_xdata(), 100 * curve.recall)
        np.testing.assert_allclose(line.get_ydata(), 100 * curve.precision)
    looks = {(line.get_color(), line.get_linestyle()) for line in axes.lines}
    assert len(looks) == 12
    assert "%" in axes.get_xlabel()
    assert "%" in axes.get_ylabel()
    assert [text.get_text() for text in made[0].legends[0].get_texts()] == list(curves)
    assert imread(tmp_path / "deep" / "curves.png").std() > 0.05

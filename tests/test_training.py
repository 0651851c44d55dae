"""The scripts of training/, run as a user runs them, on generated shapes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file

from igps.shapes import ArticulatedShapes

PROJECT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("training")
    ArticulatedShapes(n_classes=4, n_per_class=6, n_vertices=700).write(root / "meshes")
    return root


def run(script: str, *arguments: object) -> str:
    command = [sys.executable, str(PROJECT / "training" / script), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "src")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_splits_and_classification(root: Path) -> None:
    table = run(
        "evaluate.py", "splits", root / "meshes", "--descriptor", "rich", "--n_train", 3, "--n_splits", 2,
        "--cache", root / "cache",
    )  # fmt: skip
    assert re.search(r"none +\d+\.\d ± .*\nwhitened +\d+\.\d ± .*\nkernel +\d+\.\d ± ", table), table
    unseen = run(
        "evaluate.py", "splits", root / "meshes", "--descriptor", "interior", "--protocol", "unseen", "--n_train", 2,
        "--n_splits", 2, "--cache", root / "cache",
    )  # fmt: skip
    assert re.search(r"unseen, n_train=2, 2 splits.*\n.*\nnone .*\nwhitened ", unseen), unseen
    accuracy = run("classify.py", root / "meshes", "--n_train", 3, "--n_splits", 2, "--cache", root / "cache")
    assert float(accuracy.split()[1]) > 50, accuracy  # by chance 25


def test_checkpoint_to_table_figure_and_classifier(root: Path) -> None:
    out = root / "out"
    run(
        "train.py", "fit", "--config", PROJECT / "configs/default.yaml", "--config", PROJECT / "configs/smoke.yaml",
        "--data.root", root / "meshes", "--data.cache_dir", root / "cache_plain", "--data.n_train", 4,
        "--data.n_validation", 2, "--data.shapes_per_class", 2, "--trainer.default_root_dir", out,
    )  # fmt: skip
    (checkpoint,) = out.rglob("*.ckpt")
    table = run("evaluate.py", "checkpoint", checkpoint, "--out", out / "evaluation")
    scores = {line.split()[0]: [float(x) for x in line.split()[1:]] for line in table.splitlines()[1:5]}
    assert set(scores) == {"plain", "learned", "whitened", "kernel"}
    assert all(0 < value <= 100 for row in scores.values() for value in row)
    assert (out / "evaluation/layout.png").stat().st_size > 10_000
    accuracy = run("classify.py", root / "meshes", "--checkpoint", checkpoint)
    assert float(accuracy.split()[1]) > 40, accuracy


def test_ablation_prints_every_head_of_every_layout(root: Path) -> None:
    table = run(
        "ablate.py", root / "meshes", "--n_train", 3, "--n_splits", 1, "--n_epochs", 1, "--n_training_samples", 50,
        "--cache", root / "cache",
    )  # fmt: skip
    rows = re.findall(r"^(interior|euclidean|oriented) +(nothing|bins|spectrum|bins \+ spectrum)  +(.*)$", table, re.M)
    assert len({row[:2] for row in rows}) == 8, table
    assert all(len(re.findall(r"\d+\.\d ± ", row[2])) == 3 for row in rows), table


def test_pretraining_saves_a_metric_and_measures_it(root: Path, tmp_path: Path) -> None:
    out = run(
        "pretrain.py", "--root", tmp_path / "generated", "--n_classes", 7, "--n_per_class", 3, "--n_held_out", 3,
        "--n_eigenpairs", 50, "--n_directions", 4, "--cache", root / "cache", "--out", tmp_path / "metric.safetensors",
        "--data", root / "meshes", "--figures", tmp_path / "figures", "--n_epochs", 1, "--n_training_samples", 50,
    )  # fmt: skip
    stored = load_file(tmp_path / "metric.safetensors")
    head = {name: tuple(value.shape) for name, value in stored.items() if name.startswith("head.")}
    assert head == {"head.mean": (27420,), "head.directions": (4, 27420), "head.gains": (3, 4)}
    learned = [value for name, value in stored.items() if name.endswith(("log_gain", "log_gap"))]
    assert learned
    assert all((value != 0).any() for value in learned)
    for name in ("pretrain.png", "pretrain_layout.png"):
        assert (tmp_path / "figures" / name).stat().st_size > 5_000
    assert "3 held-out generated classes" in out
    assert "   4 generated classes: FT" in out
    assert "1 labels a class" in out
    assert "5 labels a class" not in out  # a single shape of each class would be left to score

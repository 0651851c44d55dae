"""A run of training/train.py: three values in a file, a curve, an early end, and going on after an interruption."""

from __future__ import annotations

import csv
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from training.running import Run

from igps.nn.learner import RetrievalLearner
from igps.shapes import ArticulatedShapes

OWN = Path(__file__).parents[2] / "configs" / "own.yaml"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("running")
    ArticulatedShapes(n_classes=3, n_per_class=8, n_vertices=500).write(root / "meshes")
    return root


def train(root: Path, out: Path, *more: object, epochs: int = 4) -> None:
    """A run whose file is configs/own.yaml with its three values changed, on small signatures."""
    own = {
        **yaml.safe_load(OWN.read_text()),
        "root": str(root / "meshes"),
        "out": str(out),
        "epochs": epochs,
    }
    file = out.with_suffix(".yaml")
    file.write_text(yaml.safe_dump(own))
    small = [
        "--data.config.n_eigenpairs=40",
        "--data.config.resolution=15",
        "--data.config.min_samples=0",
    ]
    quiet = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
    options = [
        "--data.cache_dir",
        root / "cache",
        "--data.n_workers",
        1,
        "--trainer.check_val_every_n_epoch",
        2,
        "--trainer.accelerator",
        "cpu",
        "--data.shapes_per_class",
        2,
        *small,
        *quiet,
        *more,
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", "fit", "--config", str(file), *map(str, options)])
        Run()


def curve(out: Path) -> list[dict[str, str]]:
    with (out / "curve.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def state(out: Path) -> dict[str, Any]:
    return torch.load(out / "checkpoints" / "last.ckpt", weights_only=True)


def test_an_interrupted_run_that_is_resumed_ends_as_one_that_ran_through(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(root, tmp_path / "whole")
    step = RetrievalLearner.training_step

    def interrupted(self: RetrievalLearner, batch: Any, batch_index: int) -> Any:
        if self.trainer.current_epoch == 2 and batch_index == 1:
            raise RuntimeError("the power fails")
        return step(self, batch, batch_index)

    with monkeypatch.context() as patch:
        patch.setattr(RetrievalLearner, "training_step", interrupted)
        with pytest.raises(RuntimeError, match="the power fails"):
            train(root, tmp_path / "broken")
    assert len(curve(tmp_path / "broken")) == 2
    with pytest.raises(FileExistsError, match="--resume last"):
        train(root, tmp_path / "broken")
    train(root, tmp_path / "broken", "--resume", "last", "--seed_everything", 7)

    whole, resumed = state(tmp_path / "whole"), state(tmp_path / "broken")
    start = RetrievalLearner.load_from_checkpoint(
        tmp_path / "whole" / "checkpoints" / "last.ckpt"
    ).descriptor
    assert not torch.equal(
        start.histograms[0].axes[1].centres(), start.histograms[0].axes[1].centres.start
    )
    assert (whole["epoch"], whole["global_step"]) == (resumed["epoch"], resumed["global_step"])
    assert whole["lr_schedulers"] == resumed["lr_schedulers"]
    assert whole["state_dict"].keys() == resumed["state_dict"].keys()
    for name, values in whole["state_dict"].items():
        torch.testing.assert_close(
            resumed["state_dict"][name], values, rtol=1e-6, atol=1e-7, msg=name
        )
    rows = curve(tmp_path / "whole")
    assert [row["epoch"] for row in rows] == ["0", "1", "2", "3"]
    assert [bool(row["val_ft"]) for row in rows] == [False, True, False, True]
    for row, again in zip(rows, curve(tmp_path / "broken"), strict=True):
        assert {key: float(value or -1) for key, value in row.items()} == pytest.approx(
            {key: float(value or -1) for key, value in again.items()}
        )
    assert (tmp_path / "whole" / "curve.svg").read_text().startswith("<?xml")
    assert (tmp_path / "whole" / "config.yaml").is_file()


def test_training_stops_when_validation_no_longer_improves(root: Path, tmp_path: Path) -> None:
    # Nothing is learned at a rate of 0, so that no validation is better than the first.
    still = ["--model.learning_rate", 0, "--model.bin_rate", 0, "--early_stopping.patience", 2]
    train(root, tmp_path / "still", *still, "--trainer.check_val_every_n_epoch", 1, epochs=30)
    rows = curve(tmp_path / "still")
    assert len(rows) == 3
    best = torch.load(tmp_path / "still" / "checkpoints" / "best.ckpt", weights_only=True)
    assert best["epoch"] == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("evaluate checkpoint none.ckpt", "No such file or directory: 'none.ckpt'"),
        (
            "evaluate checkpoint text.ckpt",
            "text.ckpt: expected a checkpoint, got another or a damaged file.",
        ),
        (
            "train test --root ROOT --ckpt_path none.ckpt",
            "ckpt_path: expected a checkpoint, got none.ckpt, which does not exist.",
        ),
        (
            "train fit --root ROOT --ckpt_path none.ckpt",
            "ckpt_path: expected a checkpoint, got none.ckpt, which does not exist.",
        ),
        ("classify ROOT --checkpoint none.ckpt", "No such file or directory: 'none.ckpt'"),
    ],
)
def test_scripts_tell_what_is_wrong_with_a_checkpoint_in_one_sentence(
    words: str,
    told: str,
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.ckpt").write_text("words")
    script, *given = words.replace("ROOT", str(root)).split()
    monkeypatch.setattr(sys, "argv", [script, *given])
    with pytest.raises(SystemExit, match="1"):
        runpy.run_module(f"training.{script}", run_name="__main__")
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("igps: ")
    assert last.endswith(told)


def test_a_missing_checkpoint_to_resume_is_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"resume, ckpt_path: .*last\.ckpt"):
        train(root, tmp_path / "none", "--resume", "last")

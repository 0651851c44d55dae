"""Training by a file of values: a curve, an early end, and going on after an interruption."""

import csv
import runpy
import sys
from pathlib import Path

import pytest
import torch
import yaml

import igps
from commands import run as command
from igps.data.datamodule import SignatureDataModule
from igps.data.splits import Split
from igps.learning.training import DEFAULTS, train
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.learner import RetrievalLearner
from igps.retrieval import chi_square, retrieval_scores
from igps.shapes import ArticulatedShapes

SMALL = {"n_eigenpairs": 250, "resolution": 15, "min_samples": 0}
COLUMNS = ("ft", "nn", "dcg", "st", "adr", "map")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("running")
    ArticulatedShapes(n_classes=3, n_per_class=8, n_vertices=500).write(root / "meshes")
    return root


def settings(root, out, epochs=4):
    """The default values for small signatures and quick epochs."""
    values = yaml.safe_load(DEFAULTS.read_text())
    values["data"] |= {
        "root": str(root / "meshes"),
        "cache_dir": str(root / "cache"),
        "config": SMALL,
        "n_workers": 1,
    }
    values["data"]["batches"]["n_per_class"] = 2
    values["trainer"] |= {
        "default_root_dir": str(out),
        "max_epochs": epochs,
        "accelerator": "cpu",
        "check_val_every_n_epoch": 2,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    return values


def run(values, *, resume=False):
    """Train by a file of these values."""
    file = Path(values["trainer"]["default_root_dir"]).with_suffix(".yaml")
    file.write_text(yaml.safe_dump(values))
    return train(file, resume=resume)


def curve(out):
    with (out / "curve.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def checkpoint(out, name="last"):
    return torch.load(out / "checkpoints" / f"{name}.ckpt", weights_only=True)


def test_an_interrupted_run_that_is_resumed_ends_as_one_that_ran_through(root, tmp_path):
    run(settings(root, tmp_path / "whole"))
    broken = settings(root, tmp_path / "broken")
    failing = settings(root, tmp_path / "broken")
    failing["trainer"]["callbacks"].append({"class_path": "own_callback.PowerFailure"})
    with pytest.raises(RuntimeError, match="the power fails"):
        run(failing)
    assert len(curve(tmp_path / "broken")) == 2
    with pytest.raises(FileExistsError, match="Give --resume"):
        run(broken)
    run({**broken, "seed_everything": 7}, resume=True)

    whole = checkpoint(tmp_path / "whole")
    resumed = checkpoint(tmp_path / "broken")
    trained = RetrievalLearner.load_from_checkpoint(tmp_path / "whole/checkpoints/last.ckpt")
    centres = trained.descriptor.histograms[0].axes[1].centres
    assert not torch.equal(centres(), centres.start)
    for name in ("epoch", "global_step", "lr_schedulers"):
        assert whole[name] == resumed[name]
    assert whole["state_dict"].keys() == resumed["state_dict"].keys()
    for name, values in whole["state_dict"].items():
        again = resumed["state_dict"][name]
        torch.testing.assert_close(again, values, rtol=1e-6, atol=1e-7, msg=name)
    rows = curve(tmp_path / "whole")
    assert [row["epoch"] for row in rows] == ["0", "1", "2", "3"]
    found = [bool(row["val_ft"]) for row in rows]
    expected = [False, True, False, True]
    assert found == expected
    for row, again in zip(rows, curve(tmp_path / "broken"), strict=True):
        numbers = {key: float(value or -1) for key, value in row.items()}
        assert numbers == pytest.approx({key: float(value or -1) for key, value in again.items()})
    assert (tmp_path / "whole" / "config.yaml").is_file()


def test_training_stops_when_validation_no_longer_improves(root, tmp_path):
    values = settings(root, tmp_path / "still", epochs=30)
    # Nothing is learned at a rate of 0, so that no validation is better than the first.
    values["model"] |= {"learning_rate": 0.0, "bin_rate": 0.0}
    values["trainer"]["check_val_every_n_epoch"] = 1
    values["trainer"]["callbacks"][-1]["init_args"]["patience"] = 2
    run(values)
    assert len(curve(tmp_path / "still")) == 3
    assert checkpoint(tmp_path / "still", "best")["epoch"] == 0


def test_a_missing_checkpoint_to_resume_is_named(root, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"resume: .*last\.ckpt"):
        run(settings(root, tmp_path / "none"), resume=True)


def test_an_unknown_value_and_a_missing_file_are_named(root: Path, tmp_path: Path) -> None:
    values = settings(root, tmp_path / "run")
    values["data"]["rot"] = "meshes"
    with pytest.raises(ValueError, match=r"run\.yaml: .*rot.*train\.yaml lists every value"):
        run(values)
    with pytest.raises(FileNotFoundError, match=r"config: expected a YAML file, .*none\.yaml"):
        train(tmp_path / "none.yaml")


def evaluate(monkeypatch, path):
    """What `python -m training.evaluate` does."""
    monkeypatch.setattr(sys, "argv", ["evaluate", str(path)])
    runpy.run_module("training.evaluate", run_name="__main__")


def test_a_checkpoint_is_scored_as_by_the_librarys_parts(root, tmp_path, monkeypatch, capsys):
    """From a folder to a checkpoint to its scores."""
    out = tmp_path / "out"
    file = tmp_path / "values.yaml"
    file.write_text(yaml.safe_dump(settings(root, out)))
    command("train", file)
    path = out / "checkpoints" / "last.ckpt"
    capsys.readouterr()
    evaluate(monkeypatch, path)
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split() == ["FT", "NN", "DCG", "ST", "ADR", "mAP"]
    printed = {line.split()[0]: [float(x) for x in line.split()[1:]] for line in lines}
    assert list(printed) == ["plain", "learned", "whitened", "kernel"]

    learner = RetrievalLearner.load_from_checkpoint(path).eval()
    data = SignatureDataModule.load_from_checkpoint(path)
    labels = data.dataset.labels
    histograms = igps.describe(data.dataset, learner.descriptor)
    layout = igps.load(out / "layout.safetensors")
    best = RetrievalLearner.load_from_checkpoint(out / "checkpoints" / "best.ckpt").eval()
    expected = igps.describe(data.dataset, best.descriptor)
    torch.testing.assert_close(igps.describe(data.dataset, layout), expected)
    split = Split(
        data.split.train + data.split.validation,
        (),
        data.split.test,
    )
    train_part = torch.tensor(split.train)
    test = torch.tensor(split.test)
    tested = histograms[test]
    flat = histograms.flatten(1)
    with torch.no_grad():
        embedded = learner.distance.head(tested)
        plain = chi_square(tested, tested)
        cosine = 1 - embedded @ embedded.T
        learned = plain / learner.distance.plain_unit + cosine / learner.distance.learned_unit
    distances = {"plain": plain, "learned": learned}
    for name, head in (("whitened", WhitenedHead()), ("kernel", KernelHead())):
        head.fit(flat[train_part], labels[train_part], learner.part_cells)
        vectors = head(flat[test])
        distances[name] = 1 - vectors @ vectors.T
    for name, matrix in distances.items():
        scores = retrieval_scores(matrix.clamp_min(0), labels[test]).mean()
        expected = [100 * scores[column] for column in COLUMNS]
        assert printed[name] == pytest.approx(expected, abs=0.06), name


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.ckpt", "No such file or directory: 'none.ckpt'"),
        ("text.ckpt", "text.ckpt: expected a checkpoint, got another or a damaged file."),
    ],
)
def test_a_file_that_is_no_checkpoint_is_named_in_one_sentence(
    name, message, tmp_path, here, monkeypatch, capsys
):
    (tmp_path / "text.ckpt").write_text("words")
    with pytest.raises(SystemExit, match="1"):
        evaluate(monkeypatch, name)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == f"igps: {message}" or last.endswith(message)

"""The scripts of training/, run as a user runs them, on generated shapes."""

from __future__ import annotations

import contextlib
import io
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev

import numpy as np
import pytest
import torch
from torch import Tensor
from training.graded import GradedShape, GradedShapes, body_of
from training.studies import pretraining

import igps
from igps.data.datamodule import SignatureDataModule
from igps.data.splits import Split, split_seen, split_unseen
from igps.descriptors.pretrained.descriptor import pretrained
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.learner import RetrievalLearner
from igps.retrieval import chi_square, retrieval_scores
from igps.shapes import ArticulatedShapes

PROJECT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("training")
    ArticulatedShapes(n_classes=4, n_per_class=6, n_vertices=700).write(root / "meshes")
    return root


def run_apart(script: str, *arguments: object) -> str:
    """What a script prints in a process of its own, which takes as many others as there are cores."""
    command = [sys.executable, "-m", f"training.{script}", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": f"{PROJECT / 'src'}{os.pathsep}{PROJECT}"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run(script: str, *arguments: object) -> str:
    """The same in this process and without others: to start one takes longer than the work of these tests."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setenv("LOKY_MAX_CPU_COUNT", "1")
        patch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_module(f"training.{script}", run_name="__main__")
    return printed.getvalue()


def described(root: Path, name: str) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Flat histograms, classes, and the cells of the parts, by the library, from the cache that the scripts filled."""
    module = igps.descriptor(name)
    assert isinstance(module, igps.HistogramDescriptor)
    dataset = igps.SignatureDataset(root / "meshes", descriptor=module, cache_dir=root / "cache")
    return igps.describe(dataset, module).flatten(1), dataset.labels, module.part_cells


def expected(
    histograms: Tensor, labels: Tensor, split: Split, part_cells: Sequence[int]
) -> dict[str, dict[str, float]]:
    """Scores of the test part in percent, of the plain distance and of each head."""
    train, test = torch.tensor(split.train), torch.tensor(split.test)
    seen, found = histograms[train], histograms[test]
    whitened = WhitenedHead().fit(seen, labels[train], part_cells)(found)
    kernel = KernelHead().fit(seen, labels[train], part_cells)(found)
    distances = {
        "none": chi_square(found, found),
        "whitened": 1 - whitened @ whitened.T,
        "kernel": 1 - kernel @ kernel.T,
    }
    return {
        name: {
            key: 100 * value
            for key, value in retrieval_scores(one.clamp_min(0), labels[test]).mean().items()
        }
        for name, one in distances.items()
    }


def rows(table: str) -> dict[str, list[float]]:
    """The numbers of each line that begins with a word."""
    lines = [line.split() for line in table.splitlines() if re.match(r"\w+ +\d", line)]
    return {words[0]: [float(word) for word in words[1:] if word != "±"] for words in lines}


@pytest.mark.parametrize(("name", "protocol"), [("interior", "unseen"), ("rich", "seen")])
def test_splits_are_scored_as_by_the_librarys_parts(root: Path, name: str, protocol: str) -> None:
    n_train = 3 if protocol == "seen" else 2
    table = run(
        "evaluate",
        "splits",
        root / "meshes",
        "--descriptor",
        name,
        "--protocol",
        protocol,
        "--n_train",
        n_train,
        "--n_splits",
        2,
        "--cache_dir",
        root / "cache",
    )
    assert f"{name}, {protocol}, n_train={n_train}, 2 splits from seed 100" in table
    histograms, labels, part_cells = described(root, name)
    found = []
    for seed in (100, 101):
        split = (
            split_seen(labels, 3, seed=seed)
            if protocol == "seen"
            else split_unseen(labels, 2, seed=seed)
        )
        assert not set(split.train) & set(split.test)
        found.append(expected(histograms, labels, split, part_cells))
    printed = rows(table)
    assert list(printed) == ["none", "whitened", "kernel"]
    for head, numbers in printed.items():
        values = [
            [one[head][key] for one in found] for key in ("ft", "nn", "dcg", "st", "adr", "map")
        ]
        assert numbers == pytest.approx([x for v in values for x in (mean(v), stdev(v))], abs=0.06)
    # A shuffled labelling would not do: a third of 8 shapes, or of 11, are of the query's class.
    assert printed["none"][0] > 55
    assert any(one["none"]["ft"] != one["whitened"]["ft"] for one in found)


def test_a_metric_is_the_prior_of_the_heads(root: Path) -> None:
    table = run(
        "evaluate",
        "splits",
        root / "meshes",
        "--descriptor",
        "pretrained",
        "--protocol",
        "unseen",
        "--n_train",
        2,
        "--n_splits",
        1,
        "--cache_dir",
        root / "cache",
    )
    module = igps.descriptor("pretrained")
    assert isinstance(module, EmbeddedDescriptor)
    dataset = igps.SignatureDataset(root / "meshes", descriptor=module, cache_dir=root / "cache")
    vectors, histograms = (
        igps.describe(dataset, module),
        igps.describe(dataset, module.descriptor).flatten(1),
    )
    split = split_unseen(dataset.labels, 2, seed=100)
    train, test = torch.tensor(split.train), torch.tensor(split.test)
    cells = module.descriptor.part_cells
    whitened = WhitenedHead().fit(histograms[train], dataset.labels[train], cells)(histograms[test])
    own, prior = 1 - whitened @ whitened.T, 1 - vectors[test] @ vectors[test].T
    by_row = {
        "prior": module.distances(vectors[test], vectors[test]),
        "whitened": (own + prior) / 2,
    }
    printed = rows(table)
    assert list(printed) == ["none", "prior", "whitened", "kernel"]
    for name, distances in by_row.items():
        wanted = retrieval_scores(distances.clamp_min(0), dataset.labels[test]).mean()
        expected = [
            x for key in ("ft", "nn", "dcg", "st", "adr", "map") for x in (100 * wanted[key], 0)
        ]
        assert printed[name] == pytest.approx(expected, abs=0.06), name


def test_classification_counts_what_the_kernel_head_finds(root: Path) -> None:
    printed = run(
        "classify", root / "meshes", "--n_train", 3, "--n_splits", 2, "--cache_dir", root / "cache"
    )
    histograms, labels, part_cells = described(root, "rich")
    shares = []
    for seed in (100, 101):
        split = split_seen(labels, 3, seed=seed)
        train, test = torch.tensor(split.train), torch.tensor(split.test)
        predicted = (
            KernelHead().fit(histograms[train], labels[train], part_cells).predict(histograms[test])
        )
        shares.append(100 * float((predicted == labels[test]).double().mean()))
    _, accuracy, _, spread, *_ = printed.split()
    assert float(accuracy) == pytest.approx(mean(shares), abs=0.06)
    assert float(spread) == pytest.approx(stdev(shares), abs=0.06)
    assert mean(shares) > 75  # by chance 25


def test_checkpoint_to_table_figure_and_classifier(root: Path) -> None:
    out = root / "out"
    run_apart(
        "train",
        "fit",
        "--config",
        PROJECT / "configs/default.yaml",
        "--config",
        PROJECT / "configs/smoke.yaml",
        "--data.root",
        root / "meshes",
        "--data.cache_dir",
        root / "cache_plain",
        "--data.n_train",
        4,
        "--data.n_validation",
        2,
        "--data.shapes_per_class",
        2,
        "--trainer.default_root_dir",
        out,
    )
    checkpoint = out / "checkpoints" / "last.ckpt"
    table = run_apart("evaluate", "checkpoint", checkpoint, "--out", out / "evaluation")
    printed = rows(table)
    assert list(printed) == ["plain", "learned", "whitened", "kernel"]

    learner = RetrievalLearner.load_from_checkpoint(checkpoint).eval()
    data = SignatureDataModule.load_from_checkpoint(checkpoint)
    start = learner.descriptor.histograms[0].axes[1].centres
    assert not torch.allclose(start(), start.start), "bins were trained"
    labels, test = data.dataset.labels, torch.tensor(data.split.test)
    histograms = igps.describe(data.dataset, learner.descriptor)
    split = Split(data.split.train + data.split.validation, (), data.split.test)
    scores = expected(histograms.flatten(1), labels, split, learner.part_cells)
    part = histograms[test]
    with torch.no_grad():
        embedded = learner.distance.head(part)
        plain, learned = chi_square(part, part), 1 - embedded @ embedded.T
        both = plain / learner.distance.plain_unit + learned / learner.distance.learned_unit
    learned_scores = retrieval_scores(both.clamp_min(0), labels[test]).mean()
    by_row = {
        "plain": scores["none"],
        "learned": {key: 100 * value for key, value in learned_scores.items()},
        "whitened": scores["whitened"],
        "kernel": scores["kernel"],
    }
    for name, numbers in printed.items():
        wanted = [by_row[name][key] for key in ("ft", "nn", "dcg", "st", "adr", "map")]
        assert numbers == pytest.approx(wanted, abs=0.06), name
    assert (out / "evaluation/layout.png").stat().st_size > 10_000

    accuracy = run("classify", root / "meshes", "--checkpoint", checkpoint)
    train = torch.tensor(split.train)
    head = KernelHead().fit(histograms[train].flatten(1), labels[train], learner.part_cells)
    share = 100 * float((head.predict(part.flatten(1)) == labels[test]).double().mean())
    assert float(accuracy.split()[1]) == pytest.approx(share, abs=0.06)


def test_ablation_prints_every_head_of_every_layout(root: Path) -> None:
    table = run(
        "ablate",
        root / "meshes",
        "--n_train",
        3,
        "--n_splits",
        1,
        "--n_epochs",
        1,
        "--n_training_samples",
        50,
        "--cache_dir",
        root / "cache",
    )
    pattern = r"^(interior|euclidean|oriented) +(nothing|bins|spectrum|bins \+ spectrum)  +(.*)$"
    found = {
        row[:2]: re.findall(r"(\d+\.\d) ± ", row[2]) for row in re.findall(pattern, table, re.M)
    }
    assert len(found) == 8, table
    assert all(len(numbers) == 3 for numbers in found.values()), table
    # What is not learned can be had without training: the paper's layout with soft classes, of 50 eigenpairs.
    histogram = igps.PairHistogram(
        [Potential(4, soft=True), InteriorDistance(64)],
        igps.SpectralEmbedding(n_eigenpairs=50),
        n_samples=1000,
    )
    module = igps.HistogramDescriptor(histogram)
    dataset = igps.SignatureDataset(
        root / "meshes", descriptor=igps.descriptor("rich"), cache_dir=root / "cache"
    )
    split = split_seen(dataset.labels, 3, seed=100)
    scores = expected(
        igps.describe(dataset, module).flatten(1), dataset.labels, split, module.part_cells
    )
    wanted = [scores[head]["ft"] for head in ("none", "whitened", "kernel")]
    assert [float(x) for x in found["interior", "nothing"]] == pytest.approx(wanted, abs=0.06)


class QuickShapes(GradedShapes):
    """Graded shapes by name and label; the surface is a small articulated one, stretched, which is quicker to make."""

    def __getitem__(self, index: int) -> GradedShape:
        n = self.n_bodies * self.n_poses
        place, one = divmod(index, n)
        shape = ArticulatedShapes(n_classes=4, n_per_class=n, n_vertices=700)[place % 4 * n + one]
        vertices, name = shape.vertices * [1, 1 + 0.05 * place, 1], self.names[index]
        return GradedShape(
            vertices, shape.faces, self.labels[index], body_of(name), name, 0, np.eye(3), ()
        )


def test_pretraining_saves_a_metric_and_measures_it(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pretraining, "GradedShapes", QuickShapes)
    monkeypatch.setattr(pretraining, "N_VERTICES", (1500, 1500))
    out = run(
        "pretrain",
        "--root",
        tmp_path / "generated",
        "--n_classes",
        23,
        "--n_bodies",
        2,
        "--n_poses",
        2,
        "--n_parts",
        2,
        "--n_scored",
        4,
        "--individuals",
        "[17, 1, 2, 2]",
        "--cache_dir",
        root / "cache",
        "--data",
        root / "meshes",
        "--plain",
        '["shape_dna"]',
        "--out",
        tmp_path / "metric.safetensors",
    )
    vectors = igps.describe(
        igps.SignatureDataset(root / "meshes", cache_dir=root / "cache", descriptor=pretrained()),
        pretrained(tmp_path / "metric.safetensors"),
    )
    torch.testing.assert_close(vectors.norm(dim=1), torch.ones(len(vectors)), atol=1e-4, rtol=0)
    assert "2 parts of the families" in out
    assert re.search(r"shape_dna +body NN \d+\.\d FT \d+\.\d ± \d+\.\d", out)
    assert re.search(r"shape_dna +individual NN \d+\.\d FT \d+\.\d ± \d+\.\d", out)
    assert out.count("without look-alikes") == 3  # classes, individuals, and the collection
    assert "1 labels a class" in out
    assert "5 labels a class" not in out  # a single shape of each class would be left to score

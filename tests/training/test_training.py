"""Pretraining, and the scores of heads over splits, on generated shapes."""

import re
from dataclasses import replace
from pathlib import Path
from statistics import mean, stdev

import numpy as np
import pytest
import torch
import yaml
from docs.benchmarks import learning
from training.shapes import GradedShapes
from training.shapes.benchmark import GradedShape, body_of, looks_alike
from training.shapes.kinds import body_classes

import igps
from igps.data.splits import split_seen, split_unseen
from igps.descriptors.pretrained.descriptor import pretrained
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.retrieval import chi_square, retrieval_scores
from igps.shapes import ArticulatedShapes
from training import pretrain

CONFIGS = Path(__file__).parents[2] / "configs"
COLUMNS = ("ft", "nn", "dcg", "st", "adr", "map")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("training")
    ArticulatedShapes(n_classes=4, n_per_class=5, n_vertices=700).write(root / "meshes")
    return root


def scores_by_row(table):
    """The numbers of each line that begins with a word."""
    lines = [line.split() for line in table.splitlines() if re.match(r"\w+ +\d", line)]
    return {words[0]: [float(word) for word in words[1:] if word != "±"] for words in lines}


def percents(distances, labels):
    scores = retrieval_scores(distances.clamp_min(0), labels).mean()
    return [100 * scores[column] for column in COLUMNS]


def expected_scores(histograms, labels, split, part_cells):
    """Scores of the test part in percent, of the plain distance and of each head."""
    train = torch.tensor(split.train)
    test = torch.tensor(split.test)
    tested = histograms[test]
    scores = {"none": percents(chi_square(tested, tested), labels[test])}
    for name, head in (("whitened", WhitenedHead()), ("kernel", KernelHead())):
        vectors = head.fit(
            histograms[train],
            labels[train],
            part_cells,
        )(tested)
        scores[name] = percents(1 - vectors @ vectors.T, labels[test])
    return scores


@pytest.mark.parametrize(
    ("name", "protocol"),
    [("interior", "unseen"), ("rich", "seen")],
)
def test_splits_are_scored_as_by_the_librarys_parts(root, name, protocol, capsys):
    n_train = 3 if protocol == "seen" else 2
    seeds = (100, 101)
    learning.splits(root / "meshes", name, protocol, n_train, seeds, root / "cache")
    table = capsys.readouterr().out
    assert f"{name}, {protocol}, n_train={n_train}, seeds (100, 101)" in table
    module = igps.descriptor(name)
    dataset = igps.SignatureDataset(root / "meshes", descriptor=module, cache_dir=root / "cache")
    labels = dataset.labels
    histograms = igps.describe(dataset, module).flatten(1)
    expected = []
    for seed in seeds:
        draw = split_seen if protocol == "seen" else split_unseen
        split = draw(labels, n_train, seed=seed)
        assert not set(split.train) & set(split.test)
        expected.append(expected_scores(histograms, labels, split, module.part_cells))
    printed = scores_by_row(table)
    assert list(printed) == ["none", "whitened", "kernel"]
    for head, numbers in printed.items():
        first, second = (of_split[head] for of_split in expected)
        wanted = []
        for pair in zip(first, second, strict=True):
            wanted += [mean(pair), stdev(pair)]
        assert numbers == pytest.approx(wanted, abs=0.06)
    # With shuffled labels, at most four of nine others would be of the query's class.
    assert printed["none"][0] > 55
    assert any(of_split["none"] != of_split["whitened"] for of_split in expected)


def test_a_metric_is_the_prior_of_the_heads(root, capsys):
    learning.splits(root / "meshes", "pretrained", "unseen", 2, [100], root / "cache")
    printed = scores_by_row(capsys.readouterr().out)
    assert list(printed) == ["none", "prior", "whitened", "kernel"]
    module = igps.descriptor("pretrained")
    dataset = igps.SignatureDataset(root / "meshes", descriptor=module, cache_dir=root / "cache")
    labels = dataset.labels
    vectors = igps.describe(dataset, module)
    histograms = igps.describe(dataset, module.descriptor).flatten(1)
    split = split_unseen(labels, 2, seed=100)
    train = torch.tensor(split.train)
    test = torch.tensor(split.test)
    head = WhitenedHead().fit(
        histograms[train],
        labels[train],
        module.descriptor.part_cells,
    )
    whitened = head(histograms[test])
    own = 1 - whitened @ whitened.T
    prior = 1 - vectors[test] @ vectors[test].T
    by_row = {
        "prior": module.distances(vectors[test], vectors[test]),
        "whitened": (own + prior) / 2,
    }
    for name, distances in by_row.items():
        means = printed[name][::2]
        deviations = printed[name][1::2]
        assert means == pytest.approx(
            percents(distances, labels[test]),
            abs=0.06,
        ), name
        assert not any(deviations)


class QuickShapes(GradedShapes):
    """Eight families by name, of which two look like classes of SHREC'07, so that three others are left in each part.

    The surface is a small articulated one, stretched, which is quicker to make.
    """

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        others = [one for one in body_classes(self.seed) if not looks_alike(one.name)]
        self._classes = self._classes[:2] + others[:6]

    def __getitem__(self, index):
        n = self.n_bodies * self.n_poses
        place, number = divmod(index, n)
        articulated = ArticulatedShapes(n_classes=4, n_per_class=n, n_vertices=700)
        shape = articulated[place % 4 * n + number]
        vertices = shape.vertices * [1, 1 + 0.05 * place, 1]
        name = self.names[index]
        label = self.labels[index]
        return GradedShape(
            vertices,
            shape.faces,
            label,
            body_of(name),
            name,
            0,
            np.eye(3),
            (),
        )


def test_pretraining_saves_a_metric_and_measures_it(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pretrain, "GradedShapes", QuickShapes)
    out = tmp_path / "metric.safetensors"
    shipped = yaml.safe_load((CONFIGS / "pretrain.yaml").read_text())
    settings = replace(
        pretrain.Settings(**shipped),
        root=tmp_path / "generated",
        n_classes=8,
        n_bodies=1,
        n_poses=2,
        n_parts=2,
        n_scored=4,
        individuals=(8, 1, 2, 2),
        n_vertices=(1500, 1500),
        plain=("shape_dna",),
        out=out,
        data=root / "meshes",
        cache_dir=root / "cache",
        n_workers=1,
    )
    pretrain.pretrain(settings)
    printed = capsys.readouterr().out
    dataset = igps.SignatureDataset(
        root / "meshes", cache_dir=root / "cache", descriptor=pretrained()
    )
    lengths = igps.describe(dataset, pretrained(out)).norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(len(lengths)), atol=1e-4, rtol=0)
    assert "2 parts of the families" in printed
    assert re.search(r"shape_dna +body NN \d+\.\d FT \d+\.\d ± \d+\.\d", printed)
    assert re.search(r"shape_dna +individual NN \d+\.\d FT \d+\.\d ± \d+\.\d", printed)
    # Scored on classes, on individuals, and on the collection.
    assert printed.count("without look-alikes") == 3
    assert "1 labels a class" in printed
    # With five labels, no shape of a class would be left to score.
    assert "5 labels a class" not in printed

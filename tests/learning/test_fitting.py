"""From a labelled folder to a model: the head that is chosen, honest scores, and answers to new bodies."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sklearn.metrics import roc_auc_score

import igps
from igps.learning.fitting import classification_scores, classify
from igps.learning.shortcuts import shortcuts
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.heads import ClassifierHead, KernelHead, WhitenedHead
from igps.nn.heads.classifier import folds
from own_descriptors import small_interior, write_egg

CONFIG = igps.SignatureConfig(n_eigenpairs=20, resolution=9, min_samples=0, n_surface_samples=30)
HEIGHTS = {"flat": 0.5, "round": 1.0, "long": 1.8, "rod": 3.0}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Four classes of four eggs, of which none is as another."""
    root = tmp_path_factory.mktemp("fitting")
    for label, height in HEIGHTS.items():
        for i in range(4):
            write_egg(
                root / "eggs" / label / f"{i}.off",
                height * (1 + 0.04 * i),
                subdivisions=2,
            )
    found = igps.SignatureDataset(root / "eggs", CONFIG, root / "cache")
    assert found.precompute(n_workers=1, progress=False) == []
    return found


def histograms(dataset):
    return igps.describe(dataset, small_interior()).flatten(1)


def test_a_classifier_is_fitted_saved_and_asked(dataset, tmp_path):
    train = dataset.subset([i for i in range(16) if i % 4])
    test = dataset.subset(range(0, 16, 4))
    model = igps.fit(train, small_interior(), head="classifier")
    model.save(tmp_path / "mine.safetensors")
    for one in (model, tmp_path / "mine.safetensors"):
        found = classify(test, one)
        assert found.classes == tuple(sorted(HEIGHTS))
        assert found.names == test.bodies.names
        expected = KernelHead().fit(histograms(train), train.labels).predict(histograms(test))
        assert found.probabilities.argmax(dim=1).tolist() == expected.tolist()
    loaded = igps.load(tmp_path / "mine.safetensors")
    assert loaded.scale == model.scale == pytest.approx(model.card["scale"])
    card = loaded.card
    assert card["classes"] == dict.fromkeys(sorted(HEIGHTS), 3)
    assert card["head"] == "classifier"
    assert card["goal"] == "known"
    assert card["prior"] is False


def test_a_classifier_without_names_tells_numbers(dataset):
    head = ClassifierHead().fit(histograms(dataset), dataset.labels)
    model = EmbeddedDescriptor(small_interior(), head)
    assert classify(dataset, model).classes == ("0", "1", "2", "3")
    head.names = ("a",)
    with pytest.raises(ValueError, match="expected names of 4 classes, got 1"):
        classify(dataset, model)


def test_held_out_scores_are_of_what_was_held_out(dataset):
    """Accuracy by hand, of a kernel head that is fitted without each fold in turn."""
    model = igps.fit(dataset, small_interior(), head="classifier")
    cells = histograms(dataset)
    labels = dataset.labels
    hits = []
    sure = []
    areas = []
    for number, out in enumerate(folds(labels, 2)):  # of four bodies two
        head = ClassifierHead().fit(cells[~out], labels[~out])
        hits += (head.predict(cells[out]) == labels[out]).tolist()
        sure += head.probabilities(cells[out]).max(dim=1).values.tolist()
        new = labels == number  # one class is left out of each
        less = ClassifierHead().fit(
            cells[~out & ~new],
            labels[~out & ~new],
            calibrate=False,
        )
        areas.append(
            roc_auc_score(
                new[out],
                less.strangeness(cells[out]),
            )
        )
    scores = model.card["held_out_scores"]
    assert scores["accuracy"] == pytest.approx(sum(hits) / 16)
    # Of each bin of a tenth, how far what was expected and what was right are apart
    gaps = np.bincount(
        np.ceil(np.array(sure) * 10).astype(int),
        np.subtract(sure, hits),
    )
    error = np.abs(gaps).sum() / 16
    assert scores["calibration_error"] == pytest.approx(error, abs=1e-5)
    assert scores["unknown_auc"] == pytest.approx(np.mean(areas))


def test_the_prior_stands_beside_the_new_head_or_not(dataset):
    base = small_interior()
    prior = WhitenedHead().fit(histograms(dataset), dataset.labels)
    with_prior = EmbeddedDescriptor(base, prior)
    for wanted in (True, False):
        model = igps.fit(dataset, with_prior, head="classifier", prior=wanted)
        assert isinstance(model.head, ClassifierHead)
        assert (model.head.prior is prior) == wanted == model.card["prior"]


def test_a_metric_for_new_classes_is_chosen_by_classes_that_are_held_out(dataset):
    model = igps.fit(dataset, small_interior(), goal="new")
    assert set(model.card["held_out_scores"]) == {"nn", "ft", "dcg"}
    assert model.card["head"] in ("whitened", "as_is")
    scores = {}
    for name in ("whitened", "as_is"):
        card = igps.fit(dataset, small_interior(), goal="new", head=name).card
        scores[name] = card["held_out_scores"]["ft"]
    chosen = scores[model.card["head"]]
    assert chosen == pytest.approx(max(scores.values()), abs=0.1)
    with pytest.raises(ValueError, match="model: expected a classifier, got interior"):
        classify(dataset, model)


@pytest.mark.parametrize("head", ["as_is", "whitened"])
def test_the_descriptor_that_is_given_stays_as_it_was(dataset, head):
    given = small_interior()
    model = igps.fit(dataset, given, goal="new", head=head)
    assert model.scale == model.card["scale"]
    assert model.card["head"] == head
    assert given.scale is None
    assert dict(given.card) == {}


def test_too_little_to_fit_to_is_said(dataset):
    words = r"classes: expected at least 2, .* of two bodies, got \{'flat': 4\}"
    with pytest.raises(ValueError, match=words):
        igps.fit(dataset.subset(range(4)), small_interior())
    with pytest.raises(ValueError, match="classes: expected at least 4"):
        igps.fit(
            dataset.subset(range(8)),
            small_interior(),
            goal="new",
        )
    with pytest.raises(ValueError, match="goal: expected one of known, new, got 'both'"):
        igps.fit(dataset, small_interior(), goal="both")
    words = "head: expected one of auto, classifier, linear, whitened, as_is, got 'best'"
    with pytest.raises(ValueError, match=words):
        igps.fit(dataset, small_interior(), head="best")
    with pytest.raises(ValueError, match="descriptions: expected histograms"):
        igps.fit(dataset, Below(), head="whitened")


@pytest.mark.parametrize(
    "sizes",
    [(5, 5, 5, 1), (5, 1, 1), (2, 2)],
)
def test_no_sizes_of_classes_are_too_uneven(dataset, sizes):
    """Folds may lack two training bodies of any class, or hold out no class that the classifier knows."""
    labels = []
    for name, n in zip(HEIGHTS, sizes, strict=False):
        labels += [name] * n
    bodies = replace(
        dataset.bodies.subset(range(len(labels))),
        labels=tuple(labels),
    )
    again = igps.SignatureDataset(bodies, dataset.config, dataset.pipeline.cache_dir)
    for head in ("auto", "classifier", "whitened"):
        model = igps.fit(again, small_interior(), head=head)
        assert sorted(model.card["classes"].values()) == sorted(sizes)
        # With a class held out, two classes of at least two bodies must remain
        detects_unknown = head != "whitened" and sum(n > 1 for n in sizes) >= 3
        assert ("unknown_auc" in model.card["held_out_scores"]) == detects_unknown


def test_fit_takes_size_where_only_size_tells_the_classes_and_says_so(tmp_path):
    for i in range(16):
        egg = trimesh.creation.icosphere(subdivisions=2)
        egg.vertices *= [1, 1, 1 + 0.03 * (i // 2)]
        egg.vertices *= 1 + i % 2
        folder = tmp_path / "eggs" / ("small", "large")[i % 2]
        folder.mkdir(parents=True, exist_ok=True)
        egg.export(folder / f"{i}.off")
    dataset = igps.SignatureDataset(tmp_path / "eggs", CONFIG, tmp_path / "cache")
    model = igps.fit(dataset, small_interior(), n_workers=1)
    assert "size" in model.card["parts"]
    assert model.card["held_out_scores"]["balanced_accuracy"] >= 0.9
    assert model.card["held_out_scores"]["auc"] >= 0.9
    assert model.card["held_out_scores_of_plain_numbers"]["auc"] >= 0.9
    by_parts = model.card["candidates"]
    assert by_parts["linear of numbers, size, without prior"]["auc"] >= 0.9
    assert by_parts["linear of form, without prior"]["auc"] < 0.9
    assert model.card["shortcuts"] == []
    model.save(tmp_path / "mine.safetensors")
    found = classify(dataset, tmp_path / "mine.safetensors")
    assert found.probabilities.argmax(dim=1).tolist() == dataset.labels.tolist()


def test_plain_numbers_are_left_out_if_a_body_has_none(dataset):
    some = dataset.subset(range(8))
    some.transform = lambda signature: replace(
        signature, measures={} if signature.name.endswith("3.off") else signature.measures
    )
    parts = igps.fit(some, small_interior(), n_workers=1).card["candidates"]
    assert not any("numbers" in name for name in parts)


def test_balanced_accuracy_and_area_count_small_classes_as_much_as_large_ones():
    probabilities = torch.tensor(
        [
            [0.9, 0.1],
            [0.8, 0.2],
            [0.6, 0.4],
            [0.7, 0.3],
        ]
    )
    labels = torch.tensor([3, 3, 3, 8])
    scores = classification_scores(probabilities, labels, torch.tensor([3, 8]))
    assert scores["accuracy"] == 0.75
    assert scores["balanced_accuracy"] == 0.5
    # The body of the second class is more likely to be of it than two of the three others.
    assert scores["auc"] == pytest.approx(2 / 3)


def test_what_tells_the_classes_without_form_is_said(dataset):
    assert shortcuts(dataset) == []
    scanners = ["A" if label in ("flat", "round") else label for label in dataset.bodies.labels]
    columns = {
        "scanner": tuple(scanners),
        "age": tuple(map(str, range(16))),
    }
    told = copy.copy(dataset)
    told.bodies = replace(dataset.bodies, columns=columns)
    assert shortcuts(told) == []  # two of four classes have one scanner
    two = told.subset([i for i in range(16) if i // 4 not in (0, 3)])
    [sentence] = shortcuts(two)
    assert sentence.startswith("the column 'scanner' tells the classes of 100% of the bodies")


class Below(igps.Descriptor):
    """Gives negative numbers."""

    def describe(self, batch):
        return -batch.eigenvalues[:, :3].float()

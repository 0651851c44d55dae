"""Calibrated probabilities and what is unknown, on histograms whose classes are known."""

import math

import pytest
import torch
from sklearn.metrics import log_loss
from torch.testing import assert_close

from igps.nn.heads import ClassifierHead, KernelHead, WhitenedHead
from igps.nn.heads.classifier import folds

PARTS = (12, 8)


def drawn(n_classes, n_of_each, noise=0.6, seed=0):
    """Histograms about a mean of each class, which is the same for every seed; classes 10, 11, ..."""
    means = torch.rand(n_classes, sum(PARTS), generator=torch.Generator().manual_seed(9)) ** 3
    labels = torch.arange(n_classes).repeat_interleave(n_of_each)
    generator = torch.Generator().manual_seed(seed)
    cells = means[labels] + noise * torch.rand(len(labels), sum(PARTS), generator=generator) ** 3
    return cells / cells.sum(dim=1, keepdim=True), labels + 10


def test_folds_hold_out_each_shape_once_and_leave_every_class():
    labels = torch.tensor([4] * 7 + [2] * 3 + [9])
    masks = list(folds(labels))
    assert torch.stack(masks).sum(dim=0).tolist() == [1] * 10 + [0]
    for mask in masks:
        assert set(labels[~mask].tolist()) == {2, 4, 9}
    assert list(folds(torch.arange(5))) == []


def test_scores_are_those_of_the_kernel_head_and_probabilities_their_softmax():
    histograms, labels = drawn(4, 8)
    head = ClassifierHead().fit(histograms, labels, PARTS)
    kernel = KernelHead().fit(histograms, labels, PARTS)
    new, _ = drawn(4, 5, seed=1)
    assert_close(head.scores(new), kernel.scores(new), rtol=0, atol=1e-6)
    assert_close(head(new), kernel(new), rtol=0, atol=1e-6)
    probabilities = head.probabilities(new)
    assert_close(probabilities.sum(dim=1), torch.ones(20))
    assert_close(probabilities, (kernel.scores(new) / head.calibration).softmax(dim=1))


def test_the_temperature_is_the_likeliest_on_what_is_held_out():
    histograms, labels = drawn(4, 8, noise=1.5)
    head = ClassifierHead().fit(histograms, labels, PARTS)
    scores = []
    truth = []
    for out in folds(labels):
        kernel = KernelHead().fit(histograms[~out], labels[~out], PARTS)
        scores.append(kernel.scores(histograms[out]))
        truth += labels[out].tolist()

    def loss(temperature):
        return float(
            log_loss(
                truth,
                (torch.cat(scores).double() / temperature).softmax(dim=1).numpy(),
            )
        )

    found = float(head.calibration)
    assert loss(found) <= min(loss(found * factor) for factor in (0.5, 0.9, 1.1, 2.0))


def test_strangeness_is_what_its_formula_says():
    """By loops: the mean of two distances in the class that a shape is taken for, minus its score."""
    prior = WhitenedHead(2).fit(*drawn(3, 5, seed=3), PARTS)
    histograms, labels = drawn(3, 6)
    head = ClassifierHead(prior).fit(histograms, labels, PARTS)
    new, _ = drawn(3, 2, seed=1)
    for i, found in enumerate(head.strangeness(new).tolist()):
        score, taken_for = head.scores(new)[i].max(dim=0)
        distances = torch.zeros(len(histograms))
        start = 0
        roots = new.sqrt()
        theirs = histograms.sqrt()
        for part, share in enumerate(head.shares[:-1]):
            one = head.whitened.whitened_parts(roots)[part]
            other = head.whitened.whitened_parts(theirs)[part]
            distances += share * (1 - other @ one[i]) / head.medians[part]
            start += PARTS[part]
        distances += (
            head.shares[-1]
            * prior.distances(prior(new[i : i + 1]), prior(histograms))[0]
            / head.medians[-1]
        )
        nearest = sorted(distances[labels == 10 + taken_for].tolist())[:2]
        assert found == pytest.approx(sum(nearest) / 2 - float(score), abs=1e-4)


def test_a_class_that_was_left_out_is_unknown_and_others_are_not():
    histograms, labels = drawn(6, 12, noise=0.3)
    known = labels < 15
    head = ClassifierHead(names=list("abcde")).fit(
        histograms[known],
        labels[known],
        PARTS,
    )
    new, classes = drawn(6, 12, noise=0.3, seed=1)
    unknown = head.strangeness(new) > head.strange_from
    assert bool(unknown[classes == 15].all())
    assert float(unknown[classes < 15].float().mean()) <= 0.15
    assert head.names == tuple("abcde")


def test_one_shape_of_each_class_is_enough_and_calls_nothing_unknown():
    histograms, labels = drawn(3, 1)
    head = ClassifierHead(WhitenedHead()).fit(histograms, labels)
    assert head.predict(histograms).tolist() == labels.tolist()
    assert math.isinf(head.strange_from)
    assert torch.isfinite(head.strangeness(histograms)).all()

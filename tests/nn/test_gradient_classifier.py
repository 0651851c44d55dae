"""Classifiers that are trained by gradients, from a folder's batches."""

import copy

import pytest
import torch
from torch import nn

import igps
from batches import two_bodies
from igps.nn import Classifier
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram


def learnable():
    axes = [Potential(3, learnable=True), InteriorDistance(7, learnable=True)]
    return HistogramDescriptor(PairHistogram(axes, SpectralEmbedding(n_eigenpairs=6, n_knots=5)))


def trained(model):
    """The loss after some steps over that before."""
    batch = two_bodies()
    labels = torch.tensor([0, 1])
    optimizer = torch.optim.Adam(model.parameters(), lr=0.02)
    losses = []
    for _ in range(25):
        loss = nn.functional.cross_entropy(model(batch), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses[-1] / losses[0]


def test_a_sequence_with_a_linear_layer_trains():
    descriptor = learnable()
    model = nn.Sequential(
        descriptor,
        nn.Flatten(),
        nn.Linear(descriptor.n_features, 2),
    )
    assert descriptor.n_features == 6 * 7
    before = [one.clone() for one in descriptor.parameters()]
    assert trained(model) < 0.95
    for one, other in zip(descriptor.parameters(), before, strict=True):
        assert not torch.equal(one, other)


def test_one_call_builds_a_classifier():
    torch.manual_seed(0)
    model = Classifier(learnable(), 2)
    assert trained(model) < 0.2
    assert model.eval()(two_bodies()).shape == (2, 2)
    with pytest.raises(ValueError, match="n_classes: expected at least 2, got 1"):
        Classifier(learnable(), 1)


def test_a_classifier_is_as_precise_as_its_layers():
    model = Classifier(learnable(), 2).eval()
    batch = two_bodies()
    expected = model(batch).double()
    double = copy.deepcopy(model).double()(batch.to(torch.float64))
    assert double.dtype == torch.float64
    torch.testing.assert_close(double, expected, rtol=0, atol=1e-4)


def test_a_fixed_descriptor_leaves_only_the_layer_to_train():
    model = Classifier(igps.descriptor("interior"), 5)
    assert [tuple(one.shape) for one in model.parameters()] == [(5, 640), (5,)]

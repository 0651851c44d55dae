"""Gradients through a descriptor are computed on one thread, and are those without this limit."""

from dataclasses import replace

import torch

import igps
from batches import two_bodies
from conftest import torch_threads
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram


def learned():
    embedding = SpectralEmbedding(n_eigenpairs=7, n_knots=4)
    parts = [PairHistogram(embedding=embedding), PairHistogram(["euclidean_distance"], embedding)]
    descriptor = igps.descriptor(igps.HistogramDescriptor(parts), learnable=True)
    assert isinstance(descriptor, igps.HistogramDescriptor)
    return descriptor


def test_backward_runs_on_one_thread_wherever_it_is_called():
    descriptor = learned()
    seen = []
    descriptor.histograms[0].embedding.log_gain.register_hook(
        lambda gradient: seen.append(torch.get_num_threads())
    )
    weights = descriptor.histograms[0].embedding.weights

    def watched(*arguments):
        found = weights(*arguments)
        found.register_hook(lambda gradient: seen.append(torch.get_num_threads()))
        return found

    descriptor.histograms[0].embedding.weights = watched
    with torch_threads(2):
        descriptor(two_bodies()).square().sum().backward()
        assert torch.get_num_threads() == 2
    assert 1 in seen


def test_gradients_of_first_and_second_order_are_those_without_a_limit(monkeypatch):
    batch = two_bodies()
    descriptor = learned()
    points = batch.interior.points.clone().requires_grad_()

    def found():
        # Areas that depend on the points: each derivative must count once.
        area = batch.area * (1 + points.square().mean().double())
        moved = replace(batch, interior=replace(batch.interior, points=points), area=area)
        loss = descriptor(moved).square().sum()
        inputs = [points, *descriptor.parameters()]
        first = torch.autograd.grad(loss, inputs, create_graph=True)
        size = sum(gradient.square().sum() for gradient in first)
        return [*first, *torch.autograd.grad(size, inputs)]

    limited = found()
    for module in ("descriptor", "histograms.base"):
        monkeypatch.setattr(
            f"igps.nn.{module}.on_one_thread", lambda task, batch, module: task(batch)
        )
    for one, other in zip(limited, found(), strict=True):
        assert bool(one.any())
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)

from dataclasses import replace

import pytest
import torch
from torch.autograd import grad
from torch.testing import assert_close

from batches import alone, two_bodies
from igps.data.batch import SignatureBatch
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.histograms.pairs import PairHistogram


def bodies(*copies):
    """Bodies of 40 interior samples, each of which occurs several times."""
    body = alone(two_bodies(), 0)
    found = []
    for n in copies:
        many = body.interior.map(lambda one, n=n: torch.cat([one] * n, dim=1))
        found.append(replace(body, interior=many))
    return SignatureBatch.concatenate(found)


@pytest.mark.parametrize("several", [False, True])
def test_bodies_of_all_sizes_are_described_and_learned_from_as_alone(several):
    histogram = PairHistogram(["interior_distance"], samples="interior")
    descriptor = HistogramDescriptor(
        [histogram, PairHistogram(samples="surface")] if several else histogram
    )
    batch = bodies(1, 30, 2)

    def described(batch):
        functions = batch.interior.eigenfunctions.clone().requires_grad_()
        result = descriptor(
            replace(batch, interior=replace(batch.interior, eigenfunctions=functions))
        )
        return result.detach(), grad(result.square().sum(), functions)[0]

    descriptions, gradients = described(batch)
    for i in range(3):
        description, gradient = described(alone(batch, i))
        assert_close(descriptions[i], description[0], rtol=0, atol=1e-6)
        assert_close(
            gradients[i, : gradient.shape[1]],
            gradient[0],
            rtol=1e-4,
            atol=1e-7,
        )
        assert not gradients[i, gradient.shape[1] :].any()


def test_second_derivatives_of_a_mixed_batch_are_those_of_each_body():
    descriptor = HistogramDescriptor(PairHistogram(["interior_distance"]))
    batch = bodies(1, 20, 2)

    def second_derivatives(batch):
        functions = batch.interior.eigenfunctions.double().requires_grad_()
        result = descriptor(
            replace(batch, interior=replace(batch.interior, eigenfunctions=functions))
        )
        gradient = grad(result.square().sum(), functions, create_graph=True)[0]
        return grad(gradient.square().sum(), functions)[0]

    found = second_derivatives(batch)
    for i in range(3):
        expected = second_derivatives(alone(batch, i))[0]
        assert expected.any()
        assert_close(
            found[i, : len(expected), : expected.shape[1]], expected, rtol=1e-6, atol=1e-12
        )

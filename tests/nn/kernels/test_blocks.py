from dataclasses import replace

import pytest
import torch
from torch.autograd import grad
from torch.testing import assert_close

from batches import alone, two_bodies
from igps.data.batch import SignatureBatch
from igps.nn._kernels.batches import map_by_size
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


@pytest.mark.parametrize(
    ("copies", "on_cpu", "widths"),
    [
        ((1, 50, 2, 40), True, [(2, 80), (1, 2000), (1, 1600)]),  # large bodies are not copied
        ((40, 1, 31, 20), False, [(2, 1600), (1, 800), (1, 40)]),
        ((50, 40, 45), True, [(3, 2000)]),
    ],
)
def test_groups_are_padded_to_their_largest_body(copies, on_cpu, widths, request):
    if not on_cpu:
        request.getfixturevalue("without_loops")
    batch = bodies(*copies)
    found = []

    def sums(group):
        found.append(tuple(group.interior.mask.shape))
        return group.interior.points.sum(dim=(1, 2))

    expected = batch.interior.points.sum(dim=(1, 2))
    assert_close(map_by_size(sums, batch), expected)
    assert found == widths


def test_a_batch_may_have_samples_of_one_kind_only():
    batch = bodies(1, 50)
    batch = replace(
        batch,
        surface=batch.surface.map(lambda values: values[:, :0]),
    )
    found = map_by_size(lambda group: group.area, batch).tolist()
    assert found == batch.area.tolist()


def test_padding_beyond_the_largest_body_is_cut():
    batch = bodies(1, 50, 2)[[0, 2]]
    found = map_by_size(lambda group: group.interior.points, batch).shape
    assert found == (2, 80, 3)


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

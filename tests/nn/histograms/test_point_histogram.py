"""Histograms of samples, against a loop over samples and cells."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from batches import embedded, two_bodies
from igps.nn import functional
from igps.nn.axes import BallRadius, EuclideanDistance, Potential
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.points import PointHistogram
from loops import product, soft_classes


def layout(**options):
    axes = [
        BallRadius("inside", 0.05, 0.6, n_classes=3),
        BallRadius("outside", 0.05, 0.9, n_classes=2),
        Potential(3, 1.5, embedding=SpectralEmbedding(n_eigenpairs=2), soft=True),
        Potential(4, 2.0, soft=True),
    ]
    return PointHistogram(axes, SpectralEmbedding(n_eigenpairs=5), **options)


def test_it_is_the_share_of_samples_in_each_cell():
    batch = two_bodies()
    histogram = layout()
    found = histogram(batch)
    assert found.shape == (2, *histogram.shape) == (2, 3, 2, 3, 4)
    for i in range(2):
        real = batch.surface.mask[i]
        points = batch.surface.points[i, real] / batch.area[i].sqrt().float()
        directions = batch.surface.attributes["surface_direction"][i, real]
        radii = functional.ball_radii(points[None], directions[None], real[real][None])[0].log()
        inside, outside = (
            [math.log(a) + k * math.log(b / a) / (n - 1) for k in range(n)]
            for a, b, n in ((0.05, 0.6, 3), (0.05, 0.9, 2))
        )
        memberships = product(
            soft_classes(radii[:, 0], inside),
            soft_classes(radii[:, 1], outside),
            soft_classes(
                embedded(batch, i, "surface", 2).norm(dim=1),
                [0.25, 0.75, 1.25],
            ),
            soft_classes(
                embedded(batch, i, "surface", 5).norm(dim=1),
                [0.25, 0.75, 1.25, 1.75],
            ),
        )
        np.testing.assert_allclose(found[i].flatten(), memberships.mean(axis=0), atol=1e-6)


def test_a_subset_of_the_samples_is_counted():
    batch = two_bodies()
    expected = layout()(
        replace(
            batch,
            surface=batch.surface.subset(20, seed=0),
        )
    )
    assert_close(layout(n_samples=20)(batch), expected)


def test_what_it_cannot_count_is_named():
    with pytest.raises(
        ValueError, match=r"axes: expected axes of points, got \['EuclideanDistance'\]"
    ):
        PointHistogram([EuclideanDistance()])
    with pytest.raises(ValueError, match="axes: expected axes of points"):
        PointHistogram([])
    batch = two_bodies()
    with pytest.raises(
        ValueError, match="samples: expected surface samples for ball radii, got interior samples"
    ):
        BallRadius().values(SampleFeatures(batch, "interior", batch.interior), SpectralEmbedding())
    with pytest.raises(ValueError, match="side: expected one of inside, outside, got 'left'"):
        BallRadius("left")
    with pytest.raises(ValueError, match="expected 0 < smallest < largest"):
        BallRadius("inside", 0.3, 0.2)
    none = replace(batch.surface, mask=torch.zeros_like(batch.surface.mask))
    with pytest.raises(ValueError, match="expected at least 3 of each body for its balls, got 0"):
        layout()(replace(batch, surface=none))


def test_the_function_counts_memberships_by_masks_and_weights():
    random = np.random.default_rng(0)
    one = random.random((2, 5, 3))
    other = random.random((2, 5, 2))
    weights = random.random((2, 5))
    mask = np.array(
        [
            [True] * 5,
            [True, True, False, True, False],
        ]
    )
    expected = (
        np.einsum("npc,npd,np->ncd", one, other, mask * weights) / mask.sum(axis=1)[:, None, None]
    )
    given = [torch.from_numpy(array).requires_grad_() for array in (one, other, weights)]

    def count(one, other, weights):
        return functional.point_histogram([one, other], torch.from_numpy(mask), weights)

    np.testing.assert_allclose(count(*given).detach(), expected)
    assert torch.autograd.gradcheck(count, given)
    with pytest.raises(ValueError, match="samples: expected at least one"):
        functional.point_histogram(
            [given[0]],
            torch.zeros(2, 5, dtype=torch.bool),
        )

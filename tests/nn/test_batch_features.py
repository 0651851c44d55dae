import numpy as np
import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from batches import N_POINTS, alone, embedded, scaled, two_bodies
from igps.nn.batch_features import (
    BatchFeatures,
    SampleFeatures,
    nearest_directions,
    nearest_neighbours,
)
from igps.nn.embedding import SpectralEmbedding


def test_nearest_directions_are_those_of_a_loop():
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    targets = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    mask = torch.ones(20, dtype=torch.bool)
    found = nearest_directions(points, targets, mask, n_nearest=3)
    for point, direction in zip(points, found, strict=True):
        nearest = (targets - point).norm(dim=1).argsort()[:3]
        mean = targets[nearest].mean(dim=0)
        assert_close(direction, normalize(mean - point, dim=0))
    whole = nearest_directions(points, targets, mask, n_nearest=50)
    assert_close(whole, normalize(targets.mean(dim=0) - points, dim=1))
    few = nearest_directions(
        points,
        targets.masked_fill(
            torch.arange(20)[:, None] > 4,
            torch.nan,
        ),
        torch.arange(20) < 5,
    )
    assert_close(few, normalize(targets[:5].mean(dim=0) - points, dim=1))


def test_positions_do_not_change_with_scale():
    batch = two_bodies()
    large = scaled(two_bodies(), 8.0)
    expected = SampleFeatures(batch, "interior", batch.interior).positions()
    assert_close(SampleFeatures(large, "interior", large.interior).positions(), expected)
    by_hand = batch.interior.points.numpy() / np.sqrt([2.0, 3.0])[:, None, None]
    np.testing.assert_allclose(expected, by_hand, rtol=1e-6)


@pytest.mark.parametrize("kind", ["interior", "surface"])
def test_directions_in_the_embedding_lead_outwards_whatever_the_padding(kind):
    batch = two_bodies()
    embedding = SpectralEmbedding(n_eigenpairs=4)
    directions = SampleFeatures(batch, kind, getattr(batch, kind)).embedded_directions(embedding)
    for i, n in enumerate(N_POINTS):
        inside, surface = (embedded(batch, i, where, 4) for where in ("interior", "surface"))
        own, other, sign = (inside, surface, 1) if kind == "interior" else (surface, inside, -1)
        nearest = (own[:, None] - other).norm(dim=2).argsort(dim=1)[:, :8]
        expected = sign * normalize(other[nearest].mean(dim=1) - own, dim=1)
        np.testing.assert_allclose(directions[i, :n], expected, atol=1e-4)
        single = alone(batch, i)
        samples = SampleFeatures(single, kind, getattr(single, kind))
        unpadded = samples.embedded_directions(embedding)
        assert_close(unpadded[0], directions[i, :n])


def test_neighbours_in_the_embedding_are_found_once_whatever_the_padding():
    batch = two_bodies()
    embedding = SpectralEmbedding(n_eigenpairs=4)
    samples = SampleFeatures(batch, "surface", batch.surface)
    found = samples.neighbours(embedding)
    assert samples.neighbours(embedding) is found
    for i, n in enumerate(N_POINTS):
        points = embedded(batch, i, "surface", 4)
        apart = (points[:, None] - points).norm(dim=2).fill_diagonal_(torch.inf)
        assert torch.equal(
            found[i, :n],
            apart.argsort(dim=1)[:, :16],
        )


def test_subsets():
    batch = two_bodies()
    assert BatchFeatures(batch, training=False).of("interior", None, 5).samples is batch.interior
    fixed, again, drawn, other = (
        BatchFeatures(batch, training).of("interior", 9, 5).samples
        for training in (False, False, True, True)
    )
    assert fixed.mask.sum(dim=1).tolist() == [9, 9]
    assert torch.equal(fixed.points, again.points)
    assert drawn.mask.sum(dim=1).tolist() == [5, 5]
    assert not torch.equal(drawn.points, other.points)
    features = BatchFeatures(batch, training=True)
    assert features.of("interior", 9, 5) is features.of("interior", None, 5)
    assert features.of("interior", 5, None) is not features.of("interior", 5, 5)


def test_nearest_points_are_those_of_a_loop():
    points = torch.randn(30, 4, generator=torch.Generator().manual_seed(3))
    apart = torch.cdist(points, points).fill_diagonal_(torch.inf)
    assert torch.equal(
        nearest_neighbours(points, n_nearest=5),
        apart.argsort(dim=1)[:, :5],
    )
    assert nearest_neighbours(points[:3], n_nearest=5).shape == (3, 2)
    few = torch.arange(30) % 10 == 4
    for i, found in enumerate(nearest_neighbours(points, few, 5).tolist()):
        others = [j for j in apart[i].argsort().tolist() if j in (4, 14, 24) and j != i]
        assert found == [*others, *[i] * 5][:5]
    with pytest.raises(ValueError, match="samples: expected at least one of each body, got none"):
        nearest_neighbours(torch.zeros(0, 3))

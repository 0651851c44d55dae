"""The paper's histogram as a function, against its definition one pair at a time."""

import math
from itertools import combinations_with_replacement

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from igps.nn.histograms import pair_histogram


def by_loops(embedding, potential, d_max, u_max, c, b):
    """The definition, one pair at a time."""
    pairs = combinations_with_replacement(range(c), 2)
    rows = {pair: i for i, pair in enumerate(pairs)}
    histogram = np.zeros((len(rows), b))
    level = [min(int(u / (u_max / c)), c - 1) for u in potential]
    for i in range(len(embedding)):
        for j in range(i):
            position = math.dist(embedding[i], embedding[j]) / (d_max / b) - 0.5
            position = min(max(position, 0.0), b - 1.0)
            row = rows[tuple(sorted((level[i], level[j])))]
            lower = int(position)
            histogram[row, lower] += 1 - (position - lower)
            if lower + 1 < b:
                histogram[row, lower + 1] += position - lower
    return histogram / histogram.sum()


@pytest.fixture(scope="module")
def cloud():
    generator = torch.Generator().manual_seed(3)
    embedding = torch.randn(90, 6, generator=generator, dtype=torch.float64) * 0.7
    return embedding, embedding.norm(dim=1)


@pytest.mark.parametrize(
    ("n_classes", "n_bins"),
    [(1, 64), (3, 7), (8, 2)],
)
def test_equals_brute_force_loop(cloud, n_classes, n_bins):
    embedding, potential = cloud
    expected = by_loops(embedding.numpy(), potential.numpy(), 4.0, 1.5, n_classes, n_bins)
    result = pair_histogram(embedding, potential, n_classes=n_classes, n_bins=n_bins)
    assert_allclose(result, expected, atol=1e-12)
    single = pair_histogram(
        embedding.float(), potential.float(), n_classes=n_classes, n_bins=n_bins
    )
    assert single.dtype == torch.float32
    assert_allclose(single, expected, atol=1e-6)


def test_values_beyond_the_ranges_stay_in_the_last_cells(cloud):
    embedding, potential = cloud
    far = pair_histogram(embedding * 100, potential * 100)
    assert far.sum() == pytest.approx(1)
    expected = by_loops(
        embedding.numpy() * 100,
        potential.numpy() * 100,
        4.0,
        1.5,
        4,
        64,
    )
    assert_allclose(far, expected, atol=1e-12)
    assert far[-1, -1] > 0.9


def test_does_not_depend_on_order_or_on_the_basis(cloud):
    embedding, potential = cloud
    order = torch.randperm(len(embedding), generator=torch.Generator().manual_seed(0))
    rotation = torch.linalg.qr(
        torch.randn(
            6,
            6,
            dtype=torch.float64,
            generator=torch.Generator().manual_seed(1),
        )
    ).Q
    turned = pair_histogram(embedding[order] @ rotation, potential[order])
    assert_allclose(turned, pair_histogram(embedding, potential), atol=1e-10)


@pytest.mark.parametrize(
    ("embedding", "potential", "message"),
    [
        (torch.zeros(1, 3), torch.zeros(1), "two points"),
        (
            torch.zeros(5, 3),
            torch.zeros(4),
            r"potential: expected shape \(5,\), one per point, got \(4,\)",
        ),
        (torch.zeros(5), torch.zeros(5), r"embedding: expected shape \(P, D\), got \(5,\)"),
        (torch.full((5, 3), torch.nan), torch.zeros(5), "finite"),
        (torch.zeros(5, 3), -torch.ones(5), "non-negative"),
    ],
)
def test_bad_input_is_refused(embedding, potential, message):
    with pytest.raises(ValueError, match=message):
        pair_histogram(embedding, potential)


def test_half_precision_is_counted_in_single(cloud):
    embedding = cloud[0].bfloat16()
    potential = cloud[0].bfloat16().float().norm(dim=1)
    with torch.autocast("cpu", torch.bfloat16):
        result = pair_histogram(embedding, potential)
    assert result.dtype == torch.float32
    torch.testing.assert_close(result, pair_histogram(embedding.float(), potential))


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_bins", 1), ("n_classes", 0), ("distance_range", 0.0), ("potential_range", math.inf)],
)
def test_bad_layout_is_refused(cloud, name, value):
    with pytest.raises(ValueError, match=f"{name}: expected .*, got {value}"):
        pair_histogram(*cloud, **{name: value})

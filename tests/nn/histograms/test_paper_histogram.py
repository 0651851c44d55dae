"""The paper's histogram as a function, against its definition one pair at a time."""

import math

import pytest
import torch
from numpy.testing import assert_allclose

from igps.nn.histograms import pair_histogram
from loops import distances, equal_bins, hard_classes, pair_histogram_by_loops


def by_loops(embedding, potential, n_classes=4, n_bins=64):
    """The definition, one pair at a time, of distances up to 4 and potentials up to 1.5."""
    classes = hard_classes(potential, [k * 1.5 / n_classes for k in range(1, n_classes)])
    return pair_histogram_by_loops(classes, [(distances(embedding), equal_bins(n_bins, 4.0))])


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
    expected = by_loops(embedding, potential, n_classes, n_bins)
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
    assert_allclose(far, by_loops(embedding * 100, potential * 100), atol=1e-12)
    assert far[-1, -1] > 0.9


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


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_bins", 1), ("n_classes", 0), ("distance_range", 0.0), ("potential_range", math.inf)],
)
def test_bad_layout_is_refused(cloud, name, value):
    with pytest.raises(ValueError, match=f"{name}: expected .*, got {value}"):
        pair_histogram(*cloud, **{name: value})

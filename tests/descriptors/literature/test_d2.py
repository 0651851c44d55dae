"""D2 where its distribution is known."""

import numpy as np
import pytest
import torch
from one_body import of_points, of_signature

from igps.descriptors.literature.d2 import D2
from igps.signature.signature import SignatureConfig, compute_signature
from own_descriptors import changed


@pytest.fixture(scope="module")
def round_body(sphere):
    config = SignatureConfig(n_eigenpairs=30, resolution=8, min_samples=0, n_surface_samples=4000)
    return of_signature(compute_signature(sphere, config))


def test_d2_of_a_sphere_has_the_density_of_its_chords(round_body):
    """On the unit sphere the length of a random chord has the density l/2 on [0, 2]: l²/4 is its distribution."""
    n_bins = 40
    reach = 2 / np.sqrt(4 * np.pi)
    histogram = changed(D2(), n_bins=n_bins, reach=reach).describe_body(round_body)
    edges = np.linspace(0, 1, n_bins + 1)
    np.testing.assert_allclose(np.cumsum(histogram), edges[1:] ** 2, atol=0.01)
    # In the range that all shapes share, the sphere ends where its diameter does.
    wide = D2().describe_body(round_body)
    assert wide[int(64 * reach / 2.0) + 1 :].sum() == 0
    assert wide.sum() == pytest.approx(1, abs=1e-6)


def test_d2_counts_each_pair_once_and_what_lies_beyond_in_the_last_bin():
    points = np.array(
        [
            [0.0, 0, 0],
            [1, 0, 0],
            [5, 0, 0],
            [50, 0, 0],
        ]
    )
    histogram = changed(D2(), n_bins=4, reach=2.0).describe_body(of_points(points, area=4.0))
    # Lengths over √4: 0.5, 2.5, 25, 2, 24.5, 22.5.
    np.testing.assert_allclose(histogram, [0, 1 / 6, 0, 5 / 6], atol=1e-6)


def test_d2_distance_is_half_the_l1_norm():
    one = torch.tensor([[0.5, 0.5, 0.0]])
    two = torch.tensor([[0.0, 0.25, 0.75], [0.5, 0.5, 0.0]])
    torch.testing.assert_close(D2().distances(one, two), torch.tensor([[0.75, 0.0]]))


def test_a_single_sample_is_refused():
    with pytest.raises(ValueError, match=r"surface samples.*at least 2"):
        D2().describe_body(of_points(np.zeros((1, 3))))

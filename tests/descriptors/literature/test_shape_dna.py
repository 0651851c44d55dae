"""Shape-DNA where the spectrum is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from one_body import of_signature

import igps
from igps.descriptors.literature.shape_dna import ShapeDNA
from igps.signature.signature import SignatureConfig, compute_signature
from own_descriptors import changed


@pytest.fixture(scope="module")
def round_body(sphere):
    config = SignatureConfig(n_eigenpairs=30, resolution=8, min_samples=0, n_surface_samples=4000)
    return of_signature(compute_signature(sphere, config))


def test_shape_dna_of_a_sphere_is_known(round_body):
    """l(l+1) with multiplicity 2l+1, and the area 4π."""
    expected = 4 * np.pi * np.repeat([2, 6, 12], [3, 5, 7])
    np.testing.assert_allclose(
        changed(ShapeDNA(), n_eigenvalues=15).describe_body(round_body), expected, rtol=0.01
    )


def test_shape_dna_distance_is_euclidean():
    one = torch.tensor([[1.0, 2.0]])
    two = torch.tensor([[4.0, 6.0], [1.0, 2.0]])
    torch.testing.assert_close(ShapeDNA().distances(one, two), torch.tensor([[5.0, 0.0]]))


def test_fewer_eigenvalues_than_asked_for_are_refused(sphere):
    config = SignatureConfig(n_eigenpairs=12, resolution=6, min_samples=0, n_surface_samples=20)
    batch = igps.collate([compute_signature(sphere, config)])
    assert ShapeDNA()(batch).shape == (1, 12)
    few = replace(config, n_eigenpairs=11)
    with pytest.raises(ValueError, match=r"n_eigenpairs.*at least 12, got 11"):
        ShapeDNA()(igps.collate([compute_signature(sphere, few)]))

"""The paper's two histograms against a plain count of all pairs."""

import numpy as np
import pytest
import torch

import igps
from igps.descriptors.gps import gps
from igps.descriptors.interior import interior
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig, compute_signature
from paper_histogram import paper_histogram

N_EIGENPAIRS = 60


@pytest.fixture(scope="module")
def signature(blob):
    config = SignatureConfig(n_eigenpairs=80, resolution=24, min_samples=300, n_surface_samples=400)
    # Long, so that its ends lie far from the middle and several classes are filled.
    return compute_signature(
        Mesh(blob.vertices * [1, 1, 4], blob.faces),
        config,
    )


@pytest.mark.parametrize("samples", ["interior", "surface"])
def test_histograms_are_those_of_the_layout(signature, samples):
    """4 classes of [0, 1.5], and 64 bins of [0, 4] with a linear kernel, of φ/√λ at the samples of that name."""
    found = {"interior": interior, "surface": gps}[samples](N_EIGENPAIRS)
    expected = paper_histogram(
        getattr(signature, samples).eigenfunctions, signature.eigenvalues, N_EIGENPAIRS
    )
    with torch.inference_mode():
        np.testing.assert_allclose(
            found(igps.collate([signature]))[0],
            expected,
            atol=2e-6,
        )
    assert (expected > 0).any(axis=1).sum() >= 3, "several classes are seen"

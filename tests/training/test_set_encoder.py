"""The study of a network on sets of samples."""

from __future__ import annotations

import torch
from torch.testing import assert_close
from training.studies.set_encoder import N_SAMPLES, SetEncoder, features, train_encoder

import igps


def test_an_embedding_does_not_depend_on_the_order_of_samples() -> None:
    torch.manual_seed(0)
    encoder, sets = SetEncoder(6).eval(), torch.randn(3, 40, 6)
    found = encoder(sets)
    assert_close(encoder(sets[:, torch.randperm(40)]), found)
    assert_close(found.norm(dim=1), torch.ones(3))


def test_features_do_not_depend_on_scale(blob: igps.Mesh) -> None:
    config = igps.SignatureConfig(
        n_eigenpairs=80,
        resolution=10,
        min_samples=0,
        n_surface_samples=60,
        attributes=("surface_direction",),
    )
    large = igps.Mesh(blob.vertices * 3, blob.faces)
    one, other = (
        features(igps.collate([igps.compute_signature(mesh, config)])) for mesh in (blob, large)
    )
    assert one.shape == (1, 2 * N_SAMPLES, 6)
    assert_close(one, other, rtol=0, atol=0.02)


def test_it_learns_to_tell_sets_apart() -> None:
    """By how far their points spread, which no single point tells."""
    torch.manual_seed(0)
    labels = torch.arange(4).repeat_interleave(12)
    sets = torch.randn(48, 2 * N_SAMPLES, 6) * (1 + labels[:, None, None])
    encoder = train_encoder(sets[::2], labels[::2], 20, seed=0)
    with torch.no_grad():
        found, seen = encoder(sets[1::2]), encoder(sets[::2])
    nearest = labels[::2][(found @ seen.T).argmax(dim=1)]
    assert float((nearest == labels[1::2]).float().mean()) > 0.9

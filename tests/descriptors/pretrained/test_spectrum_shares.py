"""Shares of eigenvalues against a loop, on scaled and padded bodies, and where Weyl's law knows them."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from batches import N_EIGENPAIRS, two_bodies
from igps.data.requirements import Requirements
from igps.descriptors.pretrained.spectrum_shares import SpectrumShares
from igps.nn.descriptor import HistogramDescriptor


def test_shares_are_those_of_a_loop():
    batch = two_bodies()
    found = SpectrumShares(6)(batch)
    assert found.shape == (2, 7)
    assert found.dtype == torch.float32
    for i in range(2):
        # Of the ball of this volume
        radius = (3 * float(batch.volume[i]) / (4 * math.pi)) ** (1 / 3)
        shares = [float(batch.eigenvalues[i, k - 1]) * radius**2 / (2 * k) / 6 for k in range(1, 7)]
        assert_close(found[i], torch.tensor([*shares, 1 - sum(shares)]))


def test_a_spectrum_that_follows_weyl_has_equal_shares():
    """Half of the bound, times the area of the ball of equal volume over the body's own area."""
    batch = two_bodies()
    line = 4 * torch.pi * torch.arange(1, 13, dtype=torch.float64) / batch.area[:, None]
    found = SpectrumShares(12)(replace(batch, eigenvalues=line))
    own = 4 * torch.pi * (3 * batch.volume / (4 * torch.pi)) ** (2 / 3) / batch.area
    assert_close(
        found[:, :12].double(),
        (own / 24)[:, None].expand(2, 12),
        atol=1e-7,
        rtol=0,
    )


def test_the_spectrum_of_a_surface_with_many_handles_is_cut_off():
    batch = two_bodies()
    part = SpectrumShares(min(N_EIGENPAIRS))
    found = part(replace(batch, eigenvalues=1e3 * batch.eigenvalues))
    expected = part(batch)[:, :-1]
    assert_close(
        found[:, :-1],
        expected / expected.sum(dim=1, keepdim=True),
    )
    assert_close(
        found[:, -1],
        torch.zeros(2),
        atol=1e-6,
        rtol=0,
    )


def test_needs_and_what_is_refused():
    assert SpectrumShares(20).requirements == Requirements(n_eigenpairs=20)
    with pytest.raises(ValueError, match="n_eigenpairs: expected at least 2, got 1"):
        SpectrumShares(1)
    with pytest.raises(ValueError, match="needs signatures of at least 8, got 7"):
        HistogramDescriptor(SpectrumShares(8))(two_bodies())

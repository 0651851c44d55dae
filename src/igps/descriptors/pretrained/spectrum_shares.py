"""Eigenvalues of a body's surface relative to Weyl's law, in units of the body's volume."""

import math

import torch
from torch import Tensor

from igps._parameters import check_at_least
from igps.data.requirements import Requirements
from igps.nn.batch_features import WEIGHT, BatchFeatures
from igps.nn.histograms.base import DescriptionPart


class SpectrumShares(DescriptionPart):
    """The ratios λₖ / k of K eigenvalues of a body's surface, in units of the body's volume V.

    No surface like a sphere has an eigenvalue above 8πk over its area (Karpukhin, Nadirashvili, Penskoi and Polterovich
    2021), and none of volume V has an area below (36π)^(1/3) V^(2/3). A cell is therefore λₖ (36π)^(1/3) V^(2/3) / (8πk
    K), and the remainder up to 1 is the last cell. Surfaces with many handles can exceed the bound; their cells are
    then divided by their sum.

    By Weyl's law, λₖ grows like 4πk over the area, so that all cells but the last are nearly equal: their mean tells
    how far the body is from a ball, and their differences characterise its surface. Bending leaves both as they are.
    Source: Reuter, Wolter and Peinecke 2006, who compare bodies by such sequences.

    Example:
        The eigenvalues of the unit sphere are l (l + 1), each 2 l + 1 times. The first one attains the bound.

        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> ball = trimesh.creation.icosphere(subdivisions=4)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=8))
        >>> shares = SpectrumShares(8)(collate([signature]))[0]
        >>> expected = torch.tensor([2 / 1, 2 / 2, 2 / 3, 6 / 4, 6 / 5, 6 / 6, 6 / 7, 6 / 8]) / 16
        >>> bool((shares[:8] - expected).abs().max() < 0.0005)
        True

    Args:
        n_eigenpairs: number K of eigenvalues.
    """

    def __init__(self, n_eigenpairs: int = 90) -> None:
        super().__init__()
        check_at_least(2, n_eigenpairs=n_eigenpairs)
        self.n_eigenpairs = n_eigenpairs

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of eigenvalues, and 1 for the remainder."""
        return (self.n_eigenpairs + 1,)

    @property
    def requirements(self) -> Requirements:
        """The number of eigenpairs."""
        return Requirements(n_eigenpairs=self.n_eigenpairs)

    def of_features(self, features: BatchFeatures) -> Tensor:
        """(N, K + 1) shares of N shapes."""
        batch = features.batch
        k = torch.arange(1, self.n_eigenpairs + 1, device=batch.eigenvalues.device)
        volume = batch.volume.to(batch.eigenvalues)
        smallest_area = (36 * math.pi) ** (1 / 3) * volume[:, None].pow(2 / 3)
        eigenvalues = batch.eigenvalues[:, : self.n_eigenpairs]
        ratios = eigenvalues * smallest_area / (8 * math.pi * self.n_eigenpairs * k)
        shares = ratios / ratios.sum(dim=1, keepdim=True).clamp_min(1)
        shares = shares.to(batch.surface.eigenfunctions.dtype)
        remainder = 1 - shares.sum(dim=1, keepdim=True)
        cells = torch.cat([shares, remainder.clamp_min(0)], dim=1)
        weights = batch.surface.attributes.get(WEIGHT)
        if weights is None:
            return cells
        # An eigenvalue depends on the surface most where its eigenfunction is large (Hadamard 1908), the remainder
        # everywhere alike.
        squares = batch.surface.eigenfunctions[:, :, : self.n_eigenpairs].square()
        everywhere = batch.surface.mask[:, :, None].to(squares)
        densities = torch.cat([squares, everywhere], dim=2)
        weighted = densities * weights[:, :, None]
        return cells * weighted.sum(dim=1) / densities.sum(dim=1)

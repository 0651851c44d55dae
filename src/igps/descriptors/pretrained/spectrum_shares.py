"""Eigenvalues of a body's surface relative to Weyl's law."""

import torch
from torch import Tensor

from igps._parameters import check_at_least
from igps.data.requirements import Requirements
from igps.nn.batch_features import WEIGHT, BatchFeatures
from igps.nn.histograms.base import DescriptionPart


class SpectrumShares(DescriptionPart):
    """The ratios λₖ / k of the eigenvalues of a body's surface, as shares of their sum.

    By Weyl's law, λₖ grows like 4πk over the area, so that all shares are nearly equal; their differences characterise
    the body. Bending leaves eigenvalues as they are, and scaling multiplies all by the same factor. Source: Reuter,
    Wolter and Peinecke 2006, who compare bodies by such sequences.

    Example:
        The eigenvalues of a sphere are l (l + 1), each 2 l + 1 times.

        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=8))
        >>> shares = SpectrumShares(8)(collate([signature]))[0]
        >>> expected = torch.tensor([2 / 1, 2 / 2, 2 / 3, 6 / 4, 6 / 5, 6 / 6, 6 / 7, 6 / 8])
        >>> bool((shares / shares[1] - expected).abs().max() < 0.02)
        True

    Args:
        n_eigenpairs: number of eigenvalues.
    """

    def __init__(self, n_eigenpairs: int = 64) -> None:
        super().__init__()
        check_at_least(2, n_eigenpairs=n_eigenpairs)
        self.n_eigenpairs = n_eigenpairs

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of eigenvalues."""
        return (self.n_eigenpairs,)

    @property
    def requirements(self) -> Requirements:
        """The number of eigenpairs."""
        return Requirements(n_eigenpairs=self.n_eigenpairs)

    def of_features(self, features: BatchFeatures) -> Tensor:
        """(N, K) shares of N shapes."""
        batch = features.batch
        k = torch.arange(1, self.n_eigenpairs + 1, device=batch.eigenvalues.device)
        ratios = batch.eigenvalues[:, : self.n_eigenpairs] / k
        shares = (ratios / ratios.sum(dim=1, keepdim=True)).to(batch.surface.eigenfunctions.dtype)
        weights = batch.surface.attributes.get(WEIGHT)
        if weights is None:
            return shares
        # An eigenvalue depends on the surface most where its eigenfunction is large (Hadamard 1908).
        densities = batch.surface.eigenfunctions[:, :, : self.n_eigenpairs].square()
        return shares * (densities * weights[:, :, None]).sum(dim=1) / densities.sum(dim=1)

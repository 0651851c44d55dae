"""How the spectrum of a body departs from Weyl's law."""

import torch
from torch import Tensor

from igps._parameters import check_at_least
from igps.data.requirements import Requirements
from igps.nn.batch_features import WEIGHT, BatchFeatures
from igps.nn.histograms.base import DescriptionPart


class SpectrumShares(DescriptionPart):
    """The eigenvalues λₖ of a body's surface, each over its number k, as shares of their sum.

    By Weyl's law λₖ grows as 4πk over the area, so that all shares are nearly alike, and how they differ is the body's
    own. Bending leaves eigenvalues as they are, and scale multiplies all by one number. The first of them, λ₁, is left
    out: of all shares it differs most between bodies and between poses of one, and would outweigh the others. Source:
    Reuter, Wolter and Peinecke 2006, who compare bodies by such sequences.

    Example:
        Of a sphere λ = l (l + 1), 2 l + 1 times; what is over is the number k, from 2 on.

        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=8))
        >>> shares = SpectrumShares(8)(collate([signature]))[0]
        >>> expected = torch.tensor([2 / 2, 2 / 3, 6 / 4, 6 / 5, 6 / 6, 6 / 7, 6 / 8])
        >>> bool((shares / shares[0] - expected).abs().max() < 0.02)
        True

    Args:
        n_eigenpairs: of which it looks at the eigenvalues.
    """

    def __init__(self, n_eigenpairs: int = 64) -> None:
        super().__init__()
        check_at_least(3, n_eigenpairs=n_eigenpairs)
        self.n_eigenpairs = n_eigenpairs

    @property
    def shape(self) -> tuple[int, ...]:
        """Eigenvalues but the first."""
        return (self.n_eigenpairs - 1,)

    @property
    def requirements(self) -> Requirements:
        """As many eigenpairs."""
        return Requirements(n_eigenpairs=self.n_eigenpairs)

    def of_features(self, features: BatchFeatures) -> Tensor:
        """(N, K − 1) shares of N shapes."""
        batch = features.batch
        numbers = torch.arange(2, self.n_eigenpairs + 1, device=batch.eigenvalues.device)
        over_number = batch.eigenvalues[:, 1 : self.n_eigenpairs] / numbers
        shares = (over_number / over_number.sum(dim=1, keepdim=True)).to(batch.surface.eigenfunctions.dtype)
        weights = batch.surface.attributes.get(WEIGHT)
        if weights is None:
            return shares
        # Where an eigenfunction is large, the surface decides on its eigenvalue (Hadamard 1908)
        densities = batch.surface.eigenfunctions[:, :, 1 : self.n_eigenpairs].square()
        return shares * (densities * weights[:, :, None]).sum(dim=1) / densities.sum(dim=1)

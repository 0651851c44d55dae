"""Spectral embeddings: eigenfunctions, weighted by a function of their eigenvalues, as coordinates of a point."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def commute_time_embedding(eigenfunctions: Tensor, eigenvalues: Tensor) -> Tensor:
    """The Global Point Signature φₖ/√λₖ (Rustamov 2007); of interior samples, the interior one (Rustamov 2010).

    Euclidean distance between two rows is the square root of the commute time between the points, up to a constant;
    it does not change with the scale of the mesh.

    Args:
        eigenfunctions: (..., P, K), 1/length.
        eigenvalues: (..., K) positive, 1/length²; infinite where padded.

    Returns:
        (..., P, K) in the eigenfunctions' type, dimensionless.
    """
    return eigenfunctions * eigenvalues.rsqrt().to(eigenfunctions.dtype).unsqueeze(-2)


def interior_distance(p: Tensor, q: Tensor) -> Tensor:
    """Interior distance between points: Euclidean distance of their embeddings (Rustamov 2010, equation 5).

    Args:
        p: (..., P, K) embedding.
        q: (..., Q, K) embedding.

    Returns:
        (..., P, Q).
    """
    return torch.cdist(p, q, compute_mode="donot_use_mm_for_euclid_dist")


def barycentroid_potential(embedding: Tensor) -> Tensor:
    """Barycentroid potential U, the norm of the embedding (Rustamov 2010, section 4); least at the barycentroid.

    Args:
        embedding: (..., P, K).

    Returns:
        (..., P).
    """
    return torch.linalg.vector_norm(embedding, dim=-1)


class SpectralEmbedding(nn.Module):
    """`commute_time_embedding` as a module."""

    def forward(self, eigenfunctions: Tensor, eigenvalues: Tensor) -> Tensor:
        """Embed (..., P, K) eigenfunctions with (..., K) eigenvalues."""
        return commute_time_embedding(eigenfunctions, eigenvalues)

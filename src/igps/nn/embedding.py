"""Spectral embeddings: the coordinates of a point are eigenfunctions, divided by the roots of their eigenvalues."""

import math

import torch
from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.nn.specification import Specified

# Range of λ·area: from below the smallest of elongated bodies to beyond the 250th of any body (4π·250, Weyl's law).
_FILTER_RANGE = (2.0, 5000.0)


def spectral_embedding(
    eigenfunctions: Tensor, eigenvalues: Tensor, *, n_eigenpairs: int | None = None
) -> Tensor:
    """Divide eigenfunctions by the roots of their eigenvalues, so that distances are commute times (Rustamov 2007).

    Args:
        eigenfunctions: (..., P, K), 1/length.
        eigenvalues: (..., K) positive, 1/length²; infinite where padded, which gives the factor 0.
        n_eigenpairs: number of leading eigenpairs to use; None, or a number above K, uses all.

    Returns:
        (..., P, min(K, n_eigenpairs)) in the eigenfunctions' type, float32 at least, dimensionless.
    """
    weights = eigenvalues[..., :n_eigenpairs].rsqrt()
    return _weigh(eigenfunctions[..., :n_eigenpairs], weights)


def interior_distance(p: Tensor, q: Tensor) -> Tensor:
    """Return Euclidean distances (..., P, Q) of embeddings (..., P, K) and (..., Q, K) (Rustamov 2010, equation 5)."""
    return torch.cdist(p, q, compute_mode="donot_use_mm_for_euclid_dist")


def barycentroid_potential(embedding: Tensor) -> Tensor:
    """Return the norm U (..., P) of embeddings (..., P, K), which is least at the barycentroid (Rustamov 2010)."""
    if not embedding.requires_grad:
        return torch.linalg.vector_norm(embedding, dim=-1)
    is_zero = ~embedding.detach().any(dim=-1)  # padding, where the norm has no second derivative
    apart = embedding.masked_fill(is_zero.unsqueeze(-1), 1)
    return torch.linalg.vector_norm(apart, dim=-1).masked_fill(is_zero, 0)


class SpectralEmbedding(Specified):
    """`spectral_embedding` as a module, with fixed or learned weights.

    A learned filter multiplies the weights by exp(s(log(λ·area))), where s is piecewise linear between knots and
    constant beyond them. The filter is positive, starts at 1, and applies to shapes with any number of eigenpairs.

    Example:
        The commute time divides each eigenfunction by the root of its eigenvalue.

        >>> functions, eigenvalues, area = torch.tensor([[[1.0, 3.0]]]), torch.tensor([[4.0, 9.0]]), torch.tensor([1.0])
        >>> SpectralEmbedding()(functions, eigenvalues, area).tolist()
        [[[0.5, 1.0]]]

    Args:
        n_eigenpairs: see `spectral_embedding`.
        n_knots: number of knots of a learned filter; 0 for fixed weights.

    Raises:
        ValueError: a single knot, or no eigenpair.
    """

    def __init__(self, *, n_eigenpairs: int | None = None, n_knots: int = 0) -> None:
        super().__init__()
        check_at_least(1, n_eigenpairs=n_eigenpairs)
        if n_knots < 0 or n_knots == 1:
            raise ValueError(
                f"n_knots: expected 0 for a fixed filter or at least 2, got {n_knots}."
            )
        self.n_eigenpairs = n_eigenpairs
        self.log_gain = nn.Parameter(torch.zeros(n_knots)) if n_knots else None

    def weights(self, eigenvalues: Tensor, area: Tensor) -> Tensor:
        """Return the factors (..., K) of the eigenfunctions, length; with an area of 1, they are the filter g(λ)."""
        weights = eigenvalues.rsqrt()
        if self.log_gain is None:
            return weights
        start, end = (math.log(x) for x in _FILTER_RANGE)
        last = len(self.log_gain) - 1
        areas = area.to(eigenvalues.dtype).unsqueeze(-1)
        x = (eigenvalues * areas).log()
        position = (x - start) * (last / (end - start))
        position = position.clamp(0, last)
        lower = position.long().clamp(max=last - 1)
        knots = self.log_gain.to(weights.dtype)
        log_gain = torch.lerp(knots[lower], knots[lower + 1], position - lower)
        return weights * log_gain.exp()

    def forward(self, eigenfunctions: Tensor, eigenvalues: Tensor, area: Tensor) -> Tensor:
        """Embed eigenfunctions (..., P, K) with eigenvalues (..., K) and areas (...)."""
        weights = self.weights(eigenvalues[..., : self.n_eigenpairs], area)
        return _weigh(eigenfunctions[..., : self.n_eigenpairs], weights)


def _weigh(eigenfunctions: Tensor, weights: Tensor) -> Tensor:
    dtype = torch.promote_types(eigenfunctions.dtype, torch.float32)
    return eigenfunctions * weights.to(dtype).unsqueeze(-2)

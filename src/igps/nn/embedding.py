"""Spectral embeddings: the coordinates of a point are eigenfunctions, weighted by a function of their eigenvalues."""

import math
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.nn.specification import Specified
from igps.retrieval.distances import row_distances

EmbeddingKind = Literal["commute_time", "diffusion", "biharmonic"]
# Not in `_check_kind`, as older versions of torch.compile cannot trace get_args
_KINDS = get_args(EmbeddingKind)

# Range of λ·area: from below the smallest of elongated bodies to beyond the 250th of any body (4π·250, Weyl's law).
_FILTER_RANGE = (2.0, 5000.0)


def spectral_weights(
    eigenvalues: Tensor,
    area: Tensor,
    kind: EmbeddingKind = "commute_time",
    time: float | None = None,
) -> Tensor:
    """Return the factors √area·g(λ·area) that turn eigenfunctions into a scale-invariant embedding.

    g(x) is x^(−1/2) for the commute time (Rustamov 2007), e^(−x·time) for diffusion (Coifman, Lafon 2006) and 1/x for
    the biharmonic distance (Lipman, Rustamov, Funkhouser 2010).

    Args:
        eigenvalues: (..., K) positive, 1/length²; infinite where padded, which gives the factor 0.
        area: (...) area of the surface, length².
        kind: selects g.
        time: diffusion time over area, dimensionless; only for "diffusion".

    Returns:
        (..., K), length.

    Raises:
        ValueError: the kind is unknown, or the time is missing, not positive, or given to a kind without time.
    """
    _check_kind(kind, time)
    if kind == "commute_time":
        return eigenvalues.rsqrt()
    area = area.to(eigenvalues.dtype).unsqueeze(-1)
    if kind == "biharmonic":
        return 1 / (eigenvalues * area.sqrt())
    assert time is not None
    return area.sqrt() * (-time * eigenvalues * area).exp()


def spectral_embedding(
    eigenfunctions: Tensor,
    eigenvalues: Tensor,
    area: Tensor,
    *,
    kind: EmbeddingKind = "commute_time",
    time: float | None = None,
    n_eigenpairs: int | None = None,
) -> Tensor:
    """Multiply eigenfunctions (..., P, K), 1/length, by `spectral_weights`; see there for other arguments and errors.

    Args:
        n_eigenpairs: number of leading eigenpairs to use; None, or a number above K, uses all.

    Returns:
        (..., P, min(K, n_eigenpairs)) in the eigenfunctions' type, float32 at least, dimensionless.
    """
    weights = spectral_weights(eigenvalues[..., :n_eigenpairs], area, kind, time)
    return _weigh(eigenfunctions[..., :n_eigenpairs], weights)


def interior_distance(p: Tensor, q: Tensor) -> Tensor:
    """Return Euclidean distances (..., P, Q) of embeddings (..., P, K) and (..., Q, K) (Rustamov 2010, equation 5)."""
    return row_distances(p, q)


def barycentroid_potential(embedding: Tensor) -> Tensor:
    """Return the norm U (..., P) of embeddings (..., P, K), which is least at the barycentroid (Rustamov 2010)."""
    if not embedding.requires_grad:
        return torch.linalg.vector_norm(embedding, dim=-1)
    is_zero = ~embedding.detach().any(dim=-1)  # padding, where the norm has no second derivative
    norms = torch.linalg.vector_norm(embedding.masked_fill(is_zero.unsqueeze(-1), 1), dim=-1)
    return norms.masked_fill(is_zero, 0)


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
        kind, time, n_eigenpairs: see `spectral_embedding`.
        n_knots: number of knots of a learned filter; 0 for fixed weights.

    Raises:
        ValueError: see `spectral_weights`; also for a single knot, or no eigenpair.
    """

    def __init__(
        self,
        kind: EmbeddingKind = "commute_time",
        *,
        time: float | None = None,
        n_eigenpairs: int | None = None,
        n_knots: int = 0,
    ) -> None:
        super().__init__()
        _check_kind(kind, time)
        check_at_least(1, n_eigenpairs=n_eigenpairs)
        if n_knots < 0 or n_knots == 1:
            raise ValueError(
                f"n_knots: expected 0 for a fixed filter or at least 2, got {n_knots}."
            )
        self.kind: EmbeddingKind = kind
        self.time = time
        self.n_eigenpairs = n_eigenpairs
        self.log_gain = nn.Parameter(torch.zeros(n_knots)) if n_knots else None

    def weights(self, eigenvalues: Tensor, area: Tensor) -> Tensor:
        """Return the factors (..., K) of the eigenfunctions, length; with an area of 1, they are the filter g(λ)."""
        weights = spectral_weights(eigenvalues, area, self.kind, self.time)
        if self.log_gain is None:
            return weights
        start, end = (math.log(x) for x in _FILTER_RANGE)
        last = len(self.log_gain) - 1
        x = (eigenvalues * area.to(eigenvalues.dtype).unsqueeze(-1)).log()
        position = ((x - start) * (last / (end - start))).clamp(0, last)
        lower = position.long().clamp(max=last - 1)
        gain = self.log_gain.to(weights.dtype)
        return weights * torch.lerp(gain[lower], gain[lower + 1], position - lower).exp()

    def forward(self, eigenfunctions: Tensor, eigenvalues: Tensor, area: Tensor) -> Tensor:
        """Embed eigenfunctions (..., P, K) with eigenvalues (..., K) and areas (...)."""
        weights = self.weights(eigenvalues[..., : self.n_eigenpairs], area)
        return _weigh(eigenfunctions[..., : self.n_eigenpairs], weights)


def _weigh(eigenfunctions: Tensor, weights: Tensor) -> Tensor:
    dtype = torch.promote_types(eigenfunctions.dtype, torch.float32)
    return eigenfunctions * weights.to(dtype).unsqueeze(-2)


def _check_kind(kind: str, time: float | None) -> None:
    if kind not in _KINDS:
        raise ValueError(f"kind: expected one of {', '.join(_KINDS)}, got {kind!r}.")
    if kind == "diffusion" and (time is None or not 0 < time < math.inf):
        raise ValueError(
            f"time: expected a positive diffusion time over area for kind='diffusion', got {time}."
        )
    if kind != "diffusion" and time is not None:
        raise ValueError(f"time: expected None for kind={kind!r}, which has no time, got {time}.")

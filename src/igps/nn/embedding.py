"""Spectral embeddings: eigenfunctions, weighted by a function of their eigenvalues, as coordinates of a point."""

import math
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.nn.specification import Specified
from igps.retrieval.distances import row_distances

EmbeddingKind = Literal["commute_time", "diffusion", "biharmonic"]
_KINDS = get_args(EmbeddingKind)  # here, as older compilers of PyTorch cannot trace it

# λ·area from below the smallest of elongated bodies to beyond the 250th of any (4π·250, Weyl's law).
_FILTER_RANGE = (2.0, 5000.0)


def spectral_weights(
    eigenvalues: Tensor, area: Tensor, kind: EmbeddingKind = "commute_time", time: float | None = None
) -> Tensor:
    """Factors √area·g(λ·area) that turn eigenfunctions into an embedding that does not change with scale.

    g(x) is x^(−1/2) for the commute time (Rustamov 2007), e^(−x·time) for diffusion (Coifman, Lafon 2006) and 1/x for
    the biharmonic distance (Lipman, Rustamov, Funkhouser 2010).

    Args:
        eigenvalues: (..., K) positive, 1/length²; infinite where padded, with weight 0.
        area: (...) of the surface, length².
        kind: which g.
        time: diffusion time over area, dimensionless; for "diffusion" alone.

    Returns:
        (..., K), length.

    Raises:
        ValueError: unknown kind, or a time that is missing, not positive, or given to another kind.
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
    """Eigenfunctions (..., P, K), 1/length, times their `spectral_weights`; see there for other arguments and errors.

    Args:
        n_eigenpairs: keep so many of the first; None, or more than there are, keeps all.

    Returns:
        (..., P, min(K, n_eigenpairs)) in the eigenfunctions' type, float32 at least, dimensionless.
    """
    weights = spectral_weights(eigenvalues[..., :n_eigenpairs], area, kind, time)
    return _weigh(eigenfunctions[..., :n_eigenpairs], weights)


def interior_distance(p: Tensor, q: Tensor) -> Tensor:
    """(..., P, Q) interior distances: Euclidean of embeddings (..., P, K) and (..., Q, K) (Rustamov 2010, eq. 5)."""
    return row_distances(p, q)


def barycentroid_potential(embedding: Tensor) -> Tensor:
    """(..., P) the potential U, the norm of embeddings (..., P, K) (Rustamov 2010); least at the barycentroid."""
    if not embedding.requires_grad:
        return torch.linalg.vector_norm(embedding, dim=-1)
    nothing = ~embedding.detach().any(dim=-1)  # padding, where a norm has a first derivative of 0 and no second one
    norms = torch.linalg.vector_norm(embedding.masked_fill(nothing.unsqueeze(-1), 1), dim=-1)
    return norms.masked_fill(nothing, 0)


class SpectralEmbedding(Specified):
    """`spectral_embedding` as a module, its weights fixed or learned.

    A learned filter multiplies the weights of the kind by exp(s(log(λ·area))), s piecewise linear between knots and
    constant beyond them: it is non-negative, starts at the kind itself, and serves every shape whatever its K.

    Example:
        The commute time divides each eigenfunction by the root of its eigenvalue.

        >>> functions, eigenvalues, area = torch.tensor([[[1.0, 3.0]]]), torch.tensor([[4.0, 9.0]]), torch.tensor([1.0])
        >>> SpectralEmbedding()(functions, eigenvalues, area).tolist()
        [[[0.5, 1.0]]]

    Args:
        kind, time, n_eigenpairs: see `spectral_embedding`.
        n_knots: parameters of the learned filter; 0 for a fixed one.

    Raises:
        ValueError: see `spectral_weights`, a single knot, or no eigenpair.
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
            raise ValueError(f"n_knots: expected 0 for a fixed filter or at least 2, got {n_knots}.")
        self.kind: EmbeddingKind = kind
        self.time = time
        self.n_eigenpairs = n_eigenpairs
        self.log_gain = nn.Parameter(torch.zeros(n_knots)) if n_knots else None

    def weights(self, eigenvalues: Tensor, area: Tensor) -> Tensor:
        """(..., K) factors of the eigenfunctions, length; with an area of 1 the filter g at the eigenvalues."""
        weights = spectral_weights(eigenvalues, area, self.kind, self.time)
        if self.log_gain is None:
            return weights
        least, most = (math.log(x) for x in _FILTER_RANGE)
        last = len(self.log_gain) - 1
        x = (eigenvalues * area.to(eigenvalues.dtype).unsqueeze(-1)).log()
        position = ((x - least) * (last / (most - least))).clamp(0, last)
        lower = position.long().clamp(max=last - 1)
        gain = self.log_gain.to(weights.dtype)
        return weights * torch.lerp(gain[lower], gain[lower + 1], position - lower).exp()

    def forward(self, eigenfunctions: Tensor, eigenvalues: Tensor, area: Tensor) -> Tensor:
        """Embed (..., P, K) eigenfunctions with (..., K) eigenvalues and (...) areas."""
        weights = self.weights(eigenvalues[..., : self.n_eigenpairs], area)
        return _weigh(eigenfunctions[..., : self.n_eigenpairs], weights)


def _weigh(eigenfunctions: Tensor, weights: Tensor) -> Tensor:
    dtype = torch.promote_types(eigenfunctions.dtype, torch.float32)
    return eigenfunctions * weights.to(dtype).unsqueeze(-2)


def _check_kind(kind: str, time: float | None) -> None:
    if kind not in _KINDS:
        raise ValueError(f"kind: expected one of {', '.join(_KINDS)}, got {kind!r}.")
    if kind == "diffusion" and (time is None or not 0 < time < math.inf):
        raise ValueError(f"time: expected a positive diffusion time over area for kind='diffusion', got {time}.")
    if kind != "diffusion" and time is not None:
        raise ValueError(f"time: expected None for kind={kind!r}, which has no time, got {time}.")

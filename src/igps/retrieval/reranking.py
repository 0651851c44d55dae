"""Distances of a collection set right by its neighbourhoods, without a label."""

from __future__ import annotations

import torch
from torch import Tensor


def rerank(distances: Tensor, n_neighbours: int = 20, n_expanded: int = 6, share: float = 0.3) -> Tensor:
    """k-reciprocal re-ranking: shapes are close whose neighbours are the same (Zhong, Zheng, Cao and Li 2017).

    The neighbourhood of a shape are those among its k nearest that have it among theirs, joined by the neighbourhoods,
    of k/2, of its members where two thirds of those are in it already. Its members weigh exp(−d), d in units of the
    mean distance to the k nearest; the weights are averaged over the nearest shapes, and the Jaccard distance of two
    such neighbourhoods is mixed with the distance itself. The whole collection decides: a shape less, and the others
    rank differently.

    Args:
        distances: (N, N) of a collection to itself, symmetric, ≥ 0.
        n_neighbours: k, at most N − 1.
        n_expanded: nearest shapes, itself among them, that the weights are averaged over.
        share: of the distance itself, in units of its mean, in the sum.

    Returns:
        (N, N) distances ≥ 0, symmetric, 0 on the diagonal; without unit.

    Raises:
        ValueError: distances that are no such matrix, or numbers out of range.
    """
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise ValueError(f"distances: expected those of a collection to itself, (N, N), got {tuple(distances.shape)}.")
    if not bool((distances >= 0).all() and torch.isfinite(distances).all()):
        raise ValueError("distances: expected finite numbers ≥ 0.")
    if n_neighbours < 1 or n_expanded < 1 or not 0 <= share <= 1:
        raise ValueError(
            f"n_neighbours, n_expanded, share: expected at least 1, at least 1, and 0 to 1, got {n_neighbours}, "
            f"{n_expanded} and {share}."
        )
    n = len(distances)
    k = min(n_neighbours, n - 1)
    if k < 1:
        return torch.zeros_like(distances)
    own = distances.double().clone()
    own.fill_diagonal_(-1)  # a shape is its own nearest, also where another is at distance 0
    order = own.argsort(dim=1, stable=True)
    own.fill_diagonal_(0)
    members = _reciprocal(order, k)
    half = _reciprocal(order, max(1, round(k / 2)))
    inside = half.double() @ members.double().T  # of the neighbourhood of j, how many belong to that of i: [j, i]
    joins = (2 / 3 * half.sum(dim=1) <= inside.T) & members
    members = members | ((joins.double() @ half.double()) > 0)

    near = own.gather(1, order[:, 1 : k + 1]).mean(dim=1, keepdim=True).clamp_min(torch.finfo(own.dtype).tiny)
    weights = members * torch.exp(-own / near)
    weights /= weights.sum(dim=1, keepdim=True)
    weights = weights[order[:, : min(n_expanded, n)]].mean(dim=1)
    smaller = torch.stack([torch.minimum(row, weights).sum(dim=1) for row in weights])
    jaccard = 1 - smaller / (2 - smaller)
    jaccard = (jaccard + jaccard.T) / 2
    mean = own.sum() / (n * (n - 1))
    mixed = (1 - share) * jaccard.clamp_min(0) + share * own / mean.clamp_min(torch.finfo(own.dtype).tiny)
    return mixed.fill_diagonal_(0).to(distances.dtype)


def _reciprocal(order: Tensor, k: int) -> Tensor:
    """(N, N) whether j is among the k nearest of i and i among those of j; each its own."""
    among = torch.zeros(order.shape, dtype=torch.bool, device=order.device)
    among.scatter_(1, order[:, : k + 1], True)
    return among & among.T

"""Re-ranking: distances of a collection are changed by which neighbours shapes have in common, without labels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from igps.retrieval.distances import Distance
from igps.retrieval.graph_reranking import rerank_graph
from igps.retrieval.ranking import SearchResult, rank

N_RERANKED = 200
"""Nearest entries whose neighbourhoods among each other put those of a single query in order."""

# More shapes are put in order by the graph of so many nearest each; all pairs would take time as their number cubed.
_MOST_WHOLE, _LISTED = 2000, 300


def rerank(
    distances: Tensor,
    n_neighbours: int = 20,
    n_expanded: int = 6,
    share: float = 0.3,
    diffusion: float = 0.95,
    *,
    keep_nearest: bool = True,
    progress: bool = False,
) -> Tensor:
    """Diffusion, then k-reciprocal re-ranking: shapes are close that share neighbours.

    *Diffusion* (Zhou, Weston, Gretton, Bousquet and Schölkopf 2004): shapes are tied to their k/2 nearest, by weights
    exp(−d² / σσ′), σ the mean distance to these (Zelnik-Manor and Perona 2004). With S = D^−½ W D^−½, two shapes are as
    alike as the sum over all walks between them, (I − diffusion · S)⁻¹ scaled to ones on the diagonal.

    *k-reciprocal neighbours* (Zhong, Zheng, Cao and Li 2017), by the distances that diffusion gave: the neighbourhood
    of a shape are those among its k nearest that have it among theirs, joined by the neighbourhoods, of k/2, of its
    members where two thirds of those are in it already. Its members weigh exp(−d), d in units of the mean distance to
    the k nearest; the weights are averaged over the nearest shapes, and two such neighbourhoods have their Jaccard
    distance.

    The result of each step is mixed with the distances it started from. It depends on the whole collection: without
    one of the shapes, the others may rank differently. Common neighbours tell the class of a shape rather than its
    body, so the nearest shape of each stays its nearest. Of more than 2,000 shapes each is tied to its nearest 300 by
    `rerank_graph`, and others have no common neighbour with it.

    Args:
        distances: (N, N) of a collection to itself, symmetric, ≥ 0.
        n_neighbours: k, at most N − 1.
        n_expanded: nearest shapes, itself among them, that the weights are averaged over.
        share: of the distance that a step was given, in units of its mean, in the sum.
        diffusion: how slowly walks fade, from 0 to less than 1; with 0 there is no such step.
        keep_nearest: pairs of which one is the other's nearest come before all others, in their own order, after each
            step; the papers leave them where they fall.
        progress: show a bar.

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
    if not 0 <= diffusion < 1:
        raise ValueError(f"diffusion: expected 0 to less than 1, got {diffusion}.")
    n = len(distances)
    k = min(n_neighbours, n - 1)
    if k < 1:
        return torch.zeros_like(distances)
    if n > _MOST_WHOLE and keep_nearest:
        return _by_graph(distances, k, n_expanded, share, diffusion)
    own = distances.double().clone().fill_diagonal_(0)
    nearest = _order(own)[:, 1]
    found = own
    if diffusion:
        found = _diffused(own, max(1, round(k / 2)), share, diffusion)
        if keep_nearest:
            _bring_forward(found, own, nearest)
    found = _by_neighbourhoods(found, k, n_expanded, share, progress)
    if keep_nearest:
        _bring_forward(found, own, nearest)
    return found.to(distances.dtype)


def rerank_found(
    queries: Tensor, found: SearchResult, descriptions: Callable[[Tensor], Tensor], distance: Distance, *, top: int
) -> SearchResult:
    """The entries that each query found, put in order by `rerank` of the query and them: not of the whole collection.

    Of the nearest M entries of each query (Q, ...), more than `top` are of use: `N_RERANKED`; `descriptions` gives
    those (M, ...) of entries (M,). The re-ranked distances have no unit.
    """
    results = []
    for query, entries in zip(queries, found.indices, strict=True):
        together = torch.cat([query[None], descriptions(entries).to(query)])
        own = distance(together, together)
        own = torch.minimum(own, own.T).fill_diagonal_(0)  # the two differ by rounding
        anew = rerank(own)[:1, 1:]
        best = rank(anew)[:, :top]
        results.append((entries[best[0].to(entries.device)], anew.gather(1, best)[0]))
    return SearchResult(*(torch.stack(each) for each in zip(*results, strict=True)))


def _by_graph(distances: Tensor, k: int, n_expanded: int, share: float, fading: float) -> Tensor:
    """The same of many, by the graph of nearest neighbours."""
    n, n_listed = len(distances), min(max(_LISTED, k, n_expanded), len(distances) - 1)
    mean = float(_above_zero((distances.sum(dtype=torch.float64) - distances.trace()) / (n * (n - 1))))
    near = distances.clone().fill_diagonal_(torch.inf).topk(n_listed, dim=1, largest=False)
    found = rerank_graph(SearchResult(near.indices.cpu(), near.values.cpu()), mean, k, n_expanded, share, fading)
    whole = distances / mean  # of those without a common neighbour
    for _ in range(2 if fading else 1):
        whole = whole.mul_(share).add_(1 - share)
    rows, values = torch.arange(n)[:, None].expand(-1, n_listed), found.distances.to(whole)
    whole[rows, found.indices] = values
    whole[found.indices, rows] = values
    return whole.fill_diagonal_(0)


def _diffused(own: Tensor, k: int, share: float, fading: float) -> Tensor:
    """(N, N) distances by all walks between shapes, mixed with their own; each is tied to its k nearest."""
    near = _order(own)[:, 1 : k + 1]
    scale = own.gather(1, near).mean(dim=1)
    tied = torch.zeros(own.shape, dtype=torch.bool, device=own.device).scatter_(1, near, True)
    weights = torch.exp(-own.square() / _above_zero(scale[:, None] * scale)) * (tied | tied.T)
    degree = _above_zero(weights.sum(dim=1)).rsqrt()
    walks = torch.eye(len(own), dtype=own.dtype, device=own.device) - fading * degree[:, None] * weights * degree
    alike = torch.cholesky_inverse(torch.linalg.cholesky(walks))
    length = alike.diagonal().rsqrt()
    apart = (1 - length[:, None] * alike * length).clamp_min(0)
    return _mixed((apart + apart.T) / (2 * _above_zero(_mean(apart))), own, share)


def _by_neighbourhoods(own: Tensor, k: int, n_expanded: int, share: float, progress: bool) -> Tensor:
    """(N, N) distances by k-reciprocal neighbourhoods, mixed with their own."""
    order = _order(own)
    members = _reciprocal(order, k)
    half = _reciprocal(order, max(1, round(k / 2)))
    inside = half.float() @ members.float().T  # of the neighbourhood of j, how many belong to that of i: [j, i]
    joins = (2 / 3 * half.sum(dim=1) <= inside.T) & members
    members = members | ((joins.float() @ half.float()) > 0)

    near = _above_zero(own.gather(1, order[:, 1 : k + 1]).mean(dim=1, keepdim=True))
    weights = members * torch.exp(-own / near)
    weights /= weights.sum(dim=1, keepdim=True)
    weights = weights[order[:, :n_expanded]].mean(dim=1)
    columns = weights.T.contiguous()
    smaller = torch.empty_like(weights)
    for i, row in enumerate(tqdm(weights, desc="re-ranked", disable=not progress)):
        among = row.nonzero().flatten()  # few: of the others the smaller weight is 0
        smaller[i] = torch.minimum(row[among, None], columns[among]).sum(dim=0)
    jaccard = 1 - smaller / (2 - smaller)
    return _mixed((jaccard + jaccard.T).clamp_min(0) / 2, own, share)


def _mixed(found: Tensor, own: Tensor, share: float) -> Tensor:
    return ((1 - share) * found + share * own / _above_zero(_mean(own))).fill_diagonal_(0)


def _mean(distances: Tensor) -> Tensor:
    """Of a collection's distances to itself, () without those of shapes to themselves."""
    n = len(distances)
    return distances.sum() / (n * (n - 1))


def _above_zero(values: Tensor) -> Tensor:
    return values.clamp_min(torch.finfo(values.dtype).tiny)


def _order(distances: Tensor) -> Tensor:
    """(N, N) the shapes as each ranks them, itself first, also where another is at distance 0."""
    return distances.clone().fill_diagonal_(-1).argsort(dim=1, stable=True)


def _bring_forward(mixed: Tensor, own: Tensor, nearest: Tensor) -> None:
    """Make each shape's nearest by its own distances, (N,), its nearest by the mixed ones, in place."""
    pairs = torch.zeros(mixed.shape, dtype=torch.bool, device=mixed.device).scatter_(1, nearest[:, None], True)
    pairs = pairs | pairs.T
    others = mixed[~pairs & (mixed > 0)]
    least = others.min() if len(others) else mixed.new_ones(())
    largest = _above_zero(own[pairs].max())
    # half of the least, so that single precision leaves no tie
    mixed[pairs] = 0.5 * least * own[pairs] / largest


def _reciprocal(order: Tensor, k: int) -> Tensor:
    """(N, N) whether j is among the k nearest of i and i among those of j; each its own."""
    among = torch.zeros(order.shape, dtype=torch.bool, device=order.device)
    among.scatter_(1, order[:, : k + 1], True)
    return among & among.T

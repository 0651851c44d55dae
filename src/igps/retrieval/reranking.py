"""Re-ranking: distances of a collection are changed by which neighbours shapes have in common, without labels."""

from collections.abc import Callable

import torch
from torch import Tensor

from igps._parameters import check_at_least
from igps.retrieval.distances import Distance, check_tensor
from igps.retrieval.graph_reranking import MOST_WHOLE, rerank_graph
from igps.retrieval.ranking import SearchResult, rank

N_RERANKED = 200
"""Nearest entries whose neighbourhoods among each other put those of a single query in order."""

# Of more than `MOST_WHOLE` shapes each is tied to so many nearest: as many as make no more pairs than that, but within
# these limits. All pairs would take time as the number of shapes cubed.
_PAIRS, _LISTED = 3_000_000, (300, 1000)


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
    body, so the nearest shape of each stays its nearest. Of more than 2,000 shapes each is tied to its nearest 1,000,
    of more than 10,000 to 300, by `rerank_graph`; others have no common neighbour with it.

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
    check_tensor("distances", distances)
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise ValueError(f"distances: expected those of a collection to itself, (N, N), got {tuple(distances.shape)}.")
    if not bool((distances >= 0).all() and torch.isfinite(distances).all()):
        raise ValueError("distances: expected finite numbers ≥ 0.")
    check_at_least(1, n_neighbours=n_neighbours, n_expanded=n_expanded)
    if not (0 <= share <= 1 and 0 <= diffusion < 1):
        raise ValueError(f"share, diffusion: expected 0 to 1, and 0 to less than 1, got {share} and {diffusion}.")
    n = len(distances)
    if n < 2:
        return torch.zeros_like(distances)
    k, n_expanded = min(n_neighbours, n - 1), min(n_expanded, n)
    fewest, most = _LISTED
    n_listed = n - 1 if n <= MOST_WHOLE else min(max(fewest, min(most, _PAIRS // n), k, n_expanded), n - 1)
    mean = float((distances.sum(dtype=torch.float64) - distances.trace()) / (n * (n - 1)))
    mean = max(mean, torch.finfo(torch.float64).tiny)
    others = distances.clone().fill_diagonal_(torch.inf)
    order = others.argsort(dim=1, stable=True) if n <= MOST_WHOLE else others.topk(n_listed, largest=False).indices
    order = order[:, :n_listed]
    near = SearchResult(order.cpu(), distances.gather(1, order).cpu())
    found = rerank_graph(near, mean, k, n_expanded, share, diffusion, keep_nearest=keep_nearest, progress=progress)
    whole = distances / mean  # of those without a common neighbour
    for _ in range(2 if diffusion else 1):
        whole = whole.mul_(share).add_(1 - share)
    rows, columns = torch.arange(n, device=whole.device)[:, None].expand(-1, n_listed), found.indices.to(whole.device)
    values = found.distances.to(whole)
    whole[rows, columns] = values
    whole[columns, rows] = values
    return whole.fill_diagonal_(0)


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

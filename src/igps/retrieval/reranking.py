"""Re-ranking: new distances of a collection from the neighbours that shapes have in common, without labels."""

from collections.abc import Callable

import torch
from torch import Tensor

from igps._parameters import check_at_least
from igps.retrieval.distances import Distance, check_tensor
from igps.retrieval.graph_reranking import MAX_DENSE, rerank_graph
from igps.retrieval.ranking import SearchResult, rank

N_RERANKED = 200
"""Number of nearest entries of a single query that are re-ranked, by their neighbourhoods among each other."""

# In a collection of more than `MAX_DENSE` shapes, each has a list of nearest neighbours, whose length is within these
# limits and makes about this many pairs at most. With all pairs, time would grow with the cube of the number of shapes.
_MAX_PAIRS, _LIST_LIMITS = 3_000_000, (300, 1000)


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
    """Re-rank a collection by diffusion, then by k-reciprocal neighbours: shapes with common neighbours become closer.

    *Diffusion* (Zhou, Weston, Gretton, Bousquet and Schölkopf 2004): each shape is linked to its k/2 nearest, with
    weights exp(−d² / σσ′), where σ is the mean distance to them (Zelnik-Manor and Perona 2004). With S = D^−½ W D^−½,
    the similarity of two shapes is the sum over all walks between them, (I − diffusion · S)⁻¹, with a unit diagonal.

    *k-reciprocal neighbours* (Zhong, Zheng, Cao and Li 2017), by the distances after diffusion: the neighbourhood of a
    shape consists of those of its k nearest that have the shape among their k nearest. The neighbourhood of a member,
    for k/2, is added if two thirds of it are in the neighbourhood already. Members have weights exp(−d), with d in
    units of the mean distance to the k nearest. These weights are averaged over the nearest shapes. The new distance of
    two shapes is the Jaccard distance of their weighted neighbourhoods.

    The result of each step is mixed with the distances before it. It depends on the whole collection: without one of
    the shapes, the others may rank differently. Common neighbours indicate the class of a shape rather than its body,
    so each shape keeps its nearest one. In collections of more than 2,000 shapes, each shape has a list of its nearest
    shapes, see `rerank_graph`: 1,000, but fewer from 3,000 shapes on, down to 300 from 10,000 on. Two shapes of which
    neither is in the list of the other count as having no common neighbours.

    Args:
        distances: (N, N) of a collection to itself, symmetric, ≥ 0.
        n_neighbours: k, at most N − 1.
        n_expanded: number of nearest shapes, the shape itself included, over which weights are averaged.
        share: weight of the distances before a step, in units of their mean, in its result.
        diffusion: factor for each step of a walk, at least 0 and less than 1; 0 leaves diffusion out.
        keep_nearest: after each step, put all pairs in which one shape is the nearest of the other before all other
            pairs, in their original order; the papers do not do so.
        progress: show a progress bar.

    Returns:
        (N, N) distances ≥ 0, symmetric, 0 on the diagonal; without unit.

    Raises:
        ValueError: the distances are not such a matrix, or an argument is out of range.
    """
    check_tensor("distances", distances)
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise ValueError(
            f"distances: expected (N, N), of a collection to itself, got {tuple(distances.shape)}."
        )
    if not bool((distances >= 0).all() and torch.isfinite(distances).all()):
        raise ValueError("distances: expected finite numbers ≥ 0, got others.")
    check_at_least(1, n_neighbours=n_neighbours, n_expanded=n_expanded)
    if not (0 <= share <= 1 and 0 <= diffusion < 1):
        raise ValueError(
            f"share, diffusion: expected 0 to 1, and 0 to less than 1, got {share} and {diffusion}."
        )
    n = len(distances)
    if n < 2:
        return torch.zeros_like(distances)
    k, n_expanded = min(n_neighbours, n - 1), min(n_expanded, n)
    low, high = _LIST_LIMITS
    n_listed = (
        n - 1 if n <= MAX_DENSE else min(max(low, min(high, _MAX_PAIRS // n), k, n_expanded), n - 1)
    )
    mean = float((distances.sum(dtype=torch.float64) - distances.trace()) / (n * (n - 1)))
    mean = max(mean, torch.finfo(torch.float64).tiny)
    others = distances.clone().fill_diagonal_(torch.inf)
    order = (
        others.argsort(dim=1, stable=True)
        if n <= MAX_DENSE
        else others.topk(n_listed, largest=False).indices
    )
    order = order[:, :n_listed]
    nearest = SearchResult(order.cpu(), distances.gather(1, order).cpu())
    lists = rerank_graph(
        nearest, mean, k, n_expanded, share, diffusion, keep_nearest=keep_nearest, progress=progress
    )
    result = (
        distances / mean
    )  # for pairs without common neighbours, which each step puts at distance 1
    for _ in range(2 if diffusion else 1):
        result = result.mul_(share).add_(1 - share)
    rows, columns = (
        torch.arange(n, device=result.device)[:, None].expand(-1, n_listed),
        lists.indices.to(result.device),
    )
    values = lists.distances.to(result)
    result[rows, columns] = values
    result[columns, rows] = values
    return result.fill_diagonal_(0)


def rerank_candidates(
    queries: Tensor,
    found: SearchResult,
    descriptions: Callable[[Tensor], Tensor],
    distance: Distance,
    *,
    top: int,
) -> SearchResult:
    """Re-rank the search results of each query by `rerank` of the query and these results alone.

    The new distances have no unit.

    Args:
        queries: (Q, ...) descriptions.
        found: (Q, M) the nearest entries of each query. M should be larger than `top`, such as `N_RERANKED`.
        descriptions: a function from entries (M,) to their descriptions (M, ...).
        distance: of descriptions.
        top: number of entries to return for each query.
    """
    results = []
    for query, entries in zip(queries, found.indices, strict=True):
        members = torch.cat([query[None], descriptions(entries).to(query)])
        distances = distance(members, members)
        distances = torch.minimum(distances, distances.T).fill_diagonal_(
            0
        )  # the two triangles differ by rounding
        reranked = rerank(distances)[:1, 1:]
        best = rank(reranked)[:, :top]
        results.append((entries[best[0].to(entries.device)], reranked.gather(1, best)[0]))
    return SearchResult(*(torch.stack(rows) for rows in zip(*results, strict=True)))

"""Re-ranking: new distances of a collection from the neighbours that shapes have in common, without labels."""

from collections.abc import Callable

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from igps._arrays import Booleans, Floats, Integers
from igps._compiled import compiled
from igps._parameters import check_at_least
from igps.retrieval.distances import Distance, check_tensor
from igps.retrieval.ranking import SearchResult, rank

N_RERANKED = 200
"""Number of nearest entries of a single query that are re-ranked, by their neighbourhoods among each other."""

_TINY = np.finfo(np.float64).tiny


def rerank(
    distances: Tensor,
    n_neighbours: int = 20,
    n_expanded: int = 6,
    share: float = 0.3,
    *,
    keep_nearest: bool = True,
) -> Tensor:
    """Re-rank a collection by k-reciprocal neighbours: shapes with common neighbours become closer.

    The neighbourhood of a shape consists of those of its k nearest shapes that have the shape among
    their own k nearest. The neighbourhood of a member, for k/2, is added if two thirds of it are in
    the neighbourhood already. Members have weights exp(−d), with d in units of the mean distance to
    the k nearest. These weights are averaged over the nearest shapes. The new distance of two shapes
    is the Jaccard distance of their weighted neighbourhoods, mixed with the distance before.
    Source: Zhong, Zheng, Cao and Li 2017.

    The result depends on the whole collection: without one of the shapes, the others may rank
    differently. Common neighbours indicate the class of a shape rather than its body, so each shape
    keeps its nearest one.

    Args:
        distances: (N, N) of a collection to itself, ≥ 0. The mean of both triangles counts.
        n_neighbours: k, at most N − 1.
        n_expanded: number of nearest shapes, the shape itself included, over which weights are averaged.
        share: weight of the distances before, in units of their mean, in the result.
        keep_nearest: put all pairs in which one shape is the nearest of the other before all other
            pairs, in their original order; the paper does not do so.

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
    if not 0 <= share <= 1:
        raise ValueError(f"share: expected 0 to 1, got {share}.")
    n = len(distances)
    if n < 2:
        return torch.zeros_like(distances)
    before = distances.detach().double().cpu().numpy()
    before = (before + before.T) / 2
    np.fill_diagonal(before, 0)
    n_neighbours = min(n_neighbours, n - 1)
    n_expanded = min(n_expanded, n)
    order = _nearest_first(before, max(n_neighbours + 1, n_expanded))
    weights = _neighbourhoods(before, order, n_neighbours, n_expanded)
    common = np.zeros((n, n))
    members = weights.tocsc()
    add_common_weights(
        (weights.indptr, weights.indices, weights.data),
        (members.indptr, members.indices, members.data),
        common,
    )
    # Rows of weights sum to 1, so that the larger weights of two rows sum to 2 minus the smaller ones.
    jaccard = np.maximum(1 - common / (2 - common), 0)
    mean = max(before.sum() / (n * (n - 1)), _TINY)
    after = (1 - share) * jaccard + share * before / mean
    if keep_nearest:
        _put_first(after, before, _is_nearest(order))
    np.fill_diagonal(after, 0)
    return torch.from_numpy(after).to(distances)


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
    indices = []
    distances = []
    for query, entries in zip(queries, found.indices, strict=True):
        members = torch.cat([query[None], descriptions(entries).to(query)])
        reranked = rerank(distance(members, members))[:1, 1:]
        best = rank(reranked)[:, :top]
        indices.append(entries[best[0].to(entries.device)])
        distances.append(reranked.gather(1, best)[0])
    return SearchResult(torch.stack(indices), torch.stack(distances))


def _nearest_first(distances: Floats, n_listed: int) -> Integers:
    """Return (N, n_listed) each shape, then its nearest ones; among equals, the first in the collection."""
    order = np.empty((len(distances), n_listed), dtype=np.int64)
    for i, row in enumerate(distances):
        others = row.copy()
        others[i] = -1  # a shape comes before its copies
        order[i] = np.argsort(others, kind="stable")[:n_listed]
    return order


def _neighbourhoods(
    distances: Floats, order: Integers, n_neighbours: int, n_expanded: int
) -> sparse.csr_array:
    """Return (N, N) weights of the members of each shape's neighbourhood; rows sum to 1."""
    n = len(distances)
    half = max(1, round(n_neighbours / 2))
    members = _reciprocal(order[:, : n_neighbours + 1])
    half_members = _reciprocal(order[:, : half + 1])
    # The neighbourhood of a member joins if two thirds of it are there.
    n_common = (members @ half_members.T).multiply(members).tocsr()
    sizes = half_members.sum(axis=1)
    joins = n_common.copy()
    joins.data = (3 * n_common.data >= 2 * sizes[n_common.indices]).astype(np.int64)
    rows, columns = (members + joins @ half_members).nonzero()
    nearest = np.take_along_axis(distances, order[:, 1 : n_neighbours + 1], axis=1)
    scale = np.maximum(nearest.mean(axis=1), _TINY)
    similarity = np.exp(-distances[rows, columns] / scale[rows])
    weights = sparse.csr_array((similarity, (rows, columns)), shape=(n, n))
    expansion = _binary(order[:, :n_expanded])
    factors = sparse.diags_array(1 / (n_expanded * weights.sum(axis=1)))
    averaged = sparse.csr_array(expansion @ factors @ weights)
    averaged.sort_indices()
    return averaged


def _binary(neighbours: Integers) -> sparse.csr_array:
    """Return an (N, N) matrix with 1 for each shape (row) and each of its neighbours (column)."""
    n, n_listed = neighbours.shape
    rows = np.repeat(np.arange(n), n_listed)
    ones = np.ones(n * n_listed, dtype=np.int64)
    return sparse.csr_array((ones, (rows, neighbours.ravel())), shape=(n, n))


def _reciprocal(neighbours: Integers) -> sparse.csr_array:
    """Return an (N, N) matrix with 1 for shapes that are neighbours of each other."""
    ones = _binary(neighbours)
    return ones.multiply(ones.T).tocsr()


@compiled()
def add_common_weights(
    rows: tuple[Integers, Integers, Floats],
    columns: tuple[Integers, Integers, Floats],
    common: Floats,
) -> None:
    """Add to `common` (N, N) the sums of the smaller weights of each pair of rows of a sparse matrix.

    Only weights in the same column meet, so that few pairs of rows have to be compared.

    Args:
        rows, columns: starts, indices and weights of the matrix in CSR and in CSC form.
        common: the sums.
    """
    row_starts, row_indices, row_weights = rows
    column_starts, column_indices, column_weights = columns
    for i in range(len(common)):
        for e in range(row_starts[i], row_starts[i + 1]):
            column = row_indices[e]
            for f in range(column_starts[column], column_starts[column + 1]):
                j = column_indices[f]
                common[i, j] += min(row_weights[e], column_weights[f])


def _is_nearest(order: Integers) -> Booleans:
    """Return (N, N) whether one of two shapes is the nearest of the other."""
    n = len(order)
    is_nearest = np.zeros((n, n), dtype=bool)
    is_nearest[np.arange(n), order[:, 1]] = True
    return is_nearest | is_nearest.T


def _put_first(after: Floats, before: Floats, is_first: Booleans) -> None:
    """Change distances in place so that some pairs come before all others, in their order before."""
    is_other = ~is_first & (after > 0)
    smallest = after.min(where=is_other, initial=np.inf)
    limit = smallest if np.isfinite(smallest) else 1.0
    largest = max(before[is_first].max(), _TINY)
    # At most half of the smallest other value, so that rounding to single precision makes no ties.
    after[is_first] = 0.5 * limit * before[is_first] / largest

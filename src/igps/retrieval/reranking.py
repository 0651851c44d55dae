"""Re-ranking: new distances of a collection from the neighbours that shapes have in common, without labels."""

from itertools import pairwise

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from igps._arrays import Floats, Integers
from igps.retrieval.distances import Distance, check_tensor

N_RERANKED = 200
"""Number of nearest entries of a single query that are re-ranked, by their neighbourhoods among each other."""

# The numbers of the paper: the k of its neighbourhoods, the shapes over which weights are averaged, the shape itself
# included, and the weight of the distances before, in units of their mean.
_N_NEIGHBOURS = 20
_N_EXPANDED = 6
_SHARE = 0.3
_TINY = np.finfo(np.float64).tiny


def rerank(distances: Tensor) -> Tensor:
    """Re-rank a collection by k-reciprocal neighbours: shapes with common neighbours become closer.

    The new distance of two shapes is their `jaccard_distances`, mixed with the distance before. Source: Zhong, Zheng,
    Cao and Li 2017.

    The result depends on the whole collection: without one of the shapes, the others may rank differently. Common
    neighbours indicate the class of a shape rather than its body, so each shape keeps its nearest one: unlike in the
    paper, all pairs in which one shape is the nearest of the other come before all other pairs, in their order.

    Args:
        distances: (N, N) of a collection to itself, ≥ 0. The mean of both triangles counts.

    Returns:
        (N, N) distances ≥ 0, symmetric, 0 on the diagonal; without unit.

    Raises:
        ValueError: the distances are not such a matrix.
    """
    check_tensor("distances", distances)
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise ValueError(
            f"distances: expected (N, N), of a collection to itself, got {tuple(distances.shape)}."
        )
    if not bool((distances >= 0).all() and torch.isfinite(distances).all()):
        raise ValueError("distances: expected finite numbers ≥ 0, got others.")
    n = len(distances)
    if n < 2:
        return torch.zeros_like(distances)
    before = distances.detach().double().cpu().numpy()
    before = (before + before.T) / 2
    np.fill_diagonal(before, 0)
    mean = max(before.sum() / (n * (n - 1)), _TINY)
    after = (1 - _SHARE) * jaccard_distances(before) + _SHARE * before / mean
    _put_nearest_first(after, before)
    np.fill_diagonal(after, 0)
    return torch.from_numpy(after).to(distances)


def jaccard_distances(
    distances: Floats, n_neighbours: int = _N_NEIGHBOURS, n_expanded: int = _N_EXPANDED
) -> Floats:
    """Return the Jaccard distances (N, N) of the neighbourhoods of shapes, from symmetric distances (N, N).

    The neighbourhood of a shape consists of those of its k nearest shapes that have the shape among their own k
    nearest. The neighbourhood of a member, for k/2, is added if two thirds of it are in the neighbourhood already.
    Members have weights exp(−d), with d in units of the mean distance to the k nearest. These weights are averaged over
    the nearest shapes, `n_expanded` with the shape itself.
    """
    n = len(distances)
    n_neighbours = min(n_neighbours, n - 1)
    n_expanded = min(n_expanded, n)
    order = _nearest_first(distances, max(n_neighbours + 1, n_expanded))
    columns = _neighbourhoods(distances, order, n_neighbours, n_expanded).tocsc()
    # The sums of the smaller weights of two shapes, column by column: only shapes with a common member meet
    common = np.zeros((n, n))
    for start, end in pairwise(columns.indptr):
        shapes = columns.indices[start:end]
        weights = columns.data[start:end]
        common[np.ix_(shapes, shapes)] += np.minimum.outer(weights, weights)
    # Weights of a shape sum to 1, so that the larger weights of two shapes sum to 2 minus the smaller ones
    return np.maximum(1 - common / (2 - common), 0)


def rerank_candidates(query: Tensor, candidates: Tensor, distance: Distance) -> Tensor:
    """Return new distances (M,) of candidates from a query, by `rerank` of both alone; they have no unit.

    Args:
        query: (1, ...) description.
        candidates: (M, ...) descriptions of its nearest neighbours, such as `N_RERANKED`.
        distance: of descriptions.
    """
    members = torch.cat([query, candidates.to(query)])
    return rerank(distance(members, members))[0, 1:]


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
    is_joined = 3 * n_common.data >= 2 * sizes[n_common.indices]
    joins = n_common.copy()
    joins.data = is_joined.astype(np.int64)
    rows, columns = (members + joins @ half_members).nonzero()
    nearest = np.take_along_axis(distances, order[:, 1 : n_neighbours + 1], axis=1)
    scale = np.maximum(nearest.mean(axis=1), _TINY)
    similarity = np.exp(-distances[rows, columns] / scale[rows])
    weights = sparse.csr_array((similarity, (rows, columns)), shape=(n, n))
    expansion = _binary(order[:, :n_expanded])
    factors = sparse.diags_array(1 / (n_expanded * weights.sum(axis=1)))
    return sparse.csr_array(expansion @ factors @ weights)


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


def _put_nearest_first(after: Floats, before: Floats) -> None:
    """Change distances in place: pairs of a shape and its nearest come before all others, in their order before."""
    nearest = _nearest_first(before, 2)[:, 1]
    is_first = np.zeros(before.shape, dtype=bool)
    is_first[np.arange(len(before)), nearest] = True
    is_first |= is_first.T
    smallest = after.min(where=~is_first & (after > 0), initial=np.inf)
    limit = smallest if np.isfinite(smallest) else 1.0
    largest = max(before[is_first].max(), _TINY)
    # At most half of the smallest other value, so that rounding to single precision makes no ties
    after[is_first] = 0.5 * limit * before[is_first] / largest

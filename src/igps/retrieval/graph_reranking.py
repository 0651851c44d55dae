"""Re-ranking on a graph of nearest neighbours, in time and memory proportional to the number of shapes."""

import numpy as np
import torch
from scipy import sparse
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps._compiled import compiled
from igps.retrieval.ranking import SearchResult

MAX_DENSE = 2000
"""Largest number of shapes for which all pairs are used, and walks are summed by a matrix inverse."""

# Largest number of iterations of conjugate gradients; the condition number of the matrices is below 40.
_MAX_ITERATIONS = 40
# Number of rows of the graph that are compared at a time.
_BLOCK_ROWS = 20
_TINY = np.finfo(np.float64).tiny


def rerank_graph(
    found: SearchResult,
    mean: float,
    n_neighbours: int = 20,
    n_expanded: int = 6,
    share: float = 0.3,
    diffusion: float = 0.95,
    *,
    keep_nearest: bool = True,
    progress: bool = False,
) -> SearchResult:
    """Re-rank a collection like `rerank`, from lists of nearest neighbours in place of all distances.

    Walks stay among a shape and the shapes in its list (Yang, Hinami, Matsui, Ly and Satoh 2019). If the lists hold all
    other shapes, the result is that of `rerank`.

    Args:
        found: (N, M) the M nearest neighbours of each of N shapes, closest first, without the shape itself.
        mean: distance of two shapes of the collection, over all pairs or a sample of them.
        n_neighbours, n_expanded, share, diffusion, keep_nearest, progress: see `rerank`.

    Returns:
        The same neighbours in their new order, (N, M), and their distances, without unit. Distances of two shapes of
        which neither is in the other's list would be at least 1 - share.

    Raises:
        ValueError: the lists are too short for the number of neighbours, or the mean is not positive.
    """
    neighbours, distances = found.indices.numpy(), found.distances.double().numpy()
    n, m = neighbours.shape
    n_required = max(n_neighbours, n_expanded - 1)
    if n_required > m or mean <= 0:
        raise ValueError(
            f"found, mean: expected at least {n_required} neighbours of each shape and a mean above 0, got {m} and "
            f"{mean}."
        )
    n_pairs, half = n * (n - 1), max(1, round(n_neighbours / 2))
    if diffusion:  # first, while little else is in memory
        diffused = _symmetric(neighbours, _diffused(neighbours, distances, half, diffusion)).data
    graph = _symmetric(neighbours, distances)
    values = graph.data / mean
    if diffusion:
        average = (
            1 - (graph.nnz - diffused.sum()) / n_pairs
        )  # pairs outside the graph have distance 1
        values = (1 - share) * diffused / max(average, _TINY) + share * values
        del diffused
    total = values.sum()
    if diffusion and keep_nearest:
        values = _with_nearest_first(values, graph, neighbours[:, 0])
    average = 1 + (values.sum() - total) / n_pairs  # over all pairs, where the mean was 1 before
    weights = _neighbourhoods(values, graph, n_neighbours, half, n_expanded)
    values = (1 - share) * jaccard(weights, graph, progress) + share * values / average
    if keep_nearest:
        values = _with_nearest_first(values, graph, neighbours[:, 0])
    reranked = _with_values(graph, values)[np.repeat(np.arange(n), m), neighbours.ravel()].reshape(
        n, m
    )
    order = np.argsort(reranked, axis=1, kind="stable")
    return SearchResult(
        *(torch.from_numpy(np.take_along_axis(x, order, axis=1)) for x in (neighbours, reranked))
    )


def _diffused(neighbours: Integers, distances: Floats, half: int, diffusion: float) -> Floats:
    """Distances (N, M) of each shape to its neighbours: 1 minus the normalised sums over the walks between them."""
    n, m = neighbours.shape
    scale = np.maximum(distances[:, :half].mean(axis=1), _TINY)
    nearest = neighbours[:, :half]
    exponents = np.square(distances[:, :half]) / np.maximum(scale[:, None] * scale[nearest], _TINY)
    affinity = _symmetric(nearest, np.exp(-exponents))
    degree = sparse.diags_array(1 / np.sqrt(np.maximum(affinity.sum(axis=1), _TINY)))
    steps = sparse.csr_array(diffusion * (degree @ affinity @ degree))
    members = np.column_stack([np.arange(n), neighbours])
    if m == n - 1 < MAX_DENSE:
        sums = np.take_along_axis(np.linalg.inv(np.eye(n) - steps.toarray()), members, axis=1)
    else:
        sums = np.zeros((n, m + 1))
        walks(members, steps.indptr, steps.indices, steps.data, _MAX_ITERATIONS, sums)
    factor = 1 / np.sqrt(sums[:, 0])
    return (1 - factor[:, None] * sums[:, 1:] * factor[neighbours]).clip(0)


def _neighbourhoods(
    distances: Floats, graph: sparse.csr_array, n_neighbours: int, half: int, n_expanded: int
) -> sparse.csr_array:
    """(N, N) weights of the members of each shape's neighbourhood, averaged over its nearest shapes; rows sum to 1."""
    n = graph.shape[0]
    n_nearest = max(n_neighbours, n_expanded - 1)
    slices = map(slice, graph.indptr, graph.indptr[1:])
    nearest = [
        graph.indices[row][distances[row].argsort(kind="stable")[:n_nearest]] for row in slices
    ]
    order = np.column_stack([np.arange(n), nearest])  # each shape, then its nearest ones
    members, half_members = (_reciprocal(order[:, : k + 1]) for k in (n_neighbours, half))
    joins = sparse.csr_array(members @ half_members.T).multiply(members).tocsr()
    joins.data = (2 / 3 * half_members.sum(axis=1)[joins.indices] <= joins.data).astype(np.float64)
    rows, columns = (members + joins @ half_members).nonzero()
    pairs = np.repeat(np.arange(n), n_neighbours), order[:, 1 : n_neighbours + 1].ravel()
    mean = _with_values(graph, distances)[pairs].reshape(n, -1).mean(axis=1)
    scale = np.repeat(-np.maximum(mean, _TINY), np.diff(graph.indptr))
    similarity = np.exp(np.divide(distances, scale, out=scale), out=scale)
    entries = np.where(rows == columns, 1.0, _with_values(graph, similarity)[rows, columns])
    weights = sparse.csr_array((entries, (rows, columns)), shape=(n, n))
    weights = (
        _binary(order[:, :n_expanded])
        @ sparse.diags_array(1 / (n_expanded * weights.sum(axis=1)))
        @ weights
    )
    weights = sparse.csr_array(weights)
    weights.sort_indices()
    return weights


def jaccard(weights: sparse.csr_array, graph: sparse.csr_array, progress: bool) -> Floats:
    """Jaccard distances, 0 to 1, of the weights of neighbourhoods (rows of sum 1) for the pairs of a graph."""
    n, rows, common = graph.shape[0], _rows(graph), np.empty(graph.nnz)
    ones = np.ones(n)
    with tqdm(total=n, desc="re-ranked", disable=not progress) as bar:
        for first in range(0, n, _BLOCK_ROWS):
            last = min(first + _BLOCK_ROWS, n)
            pairs = slice(graph.indptr[first], graph.indptr[last])
            common[pairs] = weights[rows[pairs]].minimum(weights[graph.indices[pairs]]) @ ones
            bar.update(last - first)
    common /= 2 - common  # in place, as each array takes half a GB for 100,000 shapes
    return np.subtract(1, common, out=common).clip(0, out=common)


def _symmetric(neighbours: Integers, values: Floats) -> sparse.csr_array:
    """Symmetric (N, N) matrix of values (N, M) of pairs (i, neighbours[i]); pairs that occur twice have the mean."""
    n, m = neighbours.shape
    dtype = np.int32 if 2 * n * m < 2**31 else np.int64
    structure = neighbours.ravel().astype(dtype), np.arange(0, n * m + 1, m, dtype=dtype)
    matrix = sparse.csr_array((values.flatten(), *structure), shape=(n, n))
    matrix.sort_indices()
    ones = sparse.csr_array(
        (np.ones(n * m, dtype=np.int8), matrix.indices, matrix.indptr), shape=(n, n)
    )
    counts = ones + ones.T.tocsr()  # each pair occurs once or twice; a byte per pair saves memory
    rows = _rows(counts)
    means = matrix[rows, counts.indices]  # 0 where the pair does not occur
    means += matrix[counts.indices, rows]
    means /= counts.data
    return _with_values(counts, means)


def _binary(neighbours: Integers) -> sparse.csr_array:
    n, m = neighbours.shape
    return sparse.csr_array(
        (np.ones(n * m), (np.repeat(np.arange(n), m), neighbours.ravel())), shape=(n, n)
    )


def _reciprocal(neighbours: Integers) -> sparse.csr_array:
    """Binary matrix of the pairs of shapes that are neighbours of each other."""
    ones = _binary(neighbours)
    return ones.multiply(ones.T).tocsr()


def _with_values(graph: sparse.csr_array, values: Floats) -> sparse.csr_array:
    return sparse.csr_array((values, graph.indices, graph.indptr), shape=graph.shape)


def _rows(graph: sparse.csr_array) -> Integers:
    """The row of each entry."""
    return np.repeat(np.arange(graph.shape[0], dtype=graph.indices.dtype), np.diff(graph.indptr))


def _with_nearest_first(values: Floats, graph: sparse.csr_array, nearest: Integers) -> Floats:
    """Values of the pairs, changed so that pairs of nearest neighbours come first, in the order of the graph."""
    nearest = nearest.astype(graph.indices.dtype)
    rows = _rows(graph)
    is_nearest = (nearest[rows] == graph.indices) | (nearest[graph.indices] == rows)
    smallest = values.min(where=~is_nearest & (values > 0), initial=np.inf)
    result, distances = values.copy(), graph.data[is_nearest]
    # At most half of the smallest other value, so that rounding to single precision makes no ties.
    result[is_nearest] = (
        0.5 * (smallest if np.isfinite(smallest) else 1.0) * distances / max(distances.max(), _TINY)
    )
    return result


@compiled()
def walks(
    lists: Integers, starts: Integers, columns: Integers, steps: Floats, n_rounds: int, sums: Floats
) -> None:
    """Add to `sums` (N, L), for each member of each shape's list, the sum over all walks from shape to member.

    Walks stay in the list. A list (N, L) starts with its own shape. For each list, (I - S) x = e is solved by conjugate
    gradients, where S, the matrix of single steps, is restricted to the members; `starts`, `columns` and `steps` are
    its CSR form.
    """
    position = np.full(len(lists), -1)
    for i in range(len(lists)):
        members = lists[i]
        for a in range(len(members)):
            position[members[a]] = a
        residual = np.zeros(len(members))
        residual[0] = 1.0
        direction, squared_norm = residual.copy(), 1.0
        for _ in range(n_rounds):
            product = direction.copy()
            for a in range(len(members)):
                for e in range(starts[members[a]], starts[members[a] + 1]):
                    if position[columns[e]] >= 0:
                        product[a] -= steps[e] * direction[position[columns[e]]]
            length = squared_norm / (direction * product).sum()
            sums[i] += length * direction
            residual -= length * product
            previous, squared_norm = squared_norm, (residual * residual).sum()
            if squared_norm < 1e-10:
                break
            direction = residual + squared_norm / previous * direction
        for a in range(len(members)):
            position[members[a]] = -1

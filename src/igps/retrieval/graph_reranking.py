"""Re-ranking on the graph of nearest neighbours: time and memory grow with the number of shapes, not its square."""

import numpy as np
import torch
from scipy import sparse
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps._compiled import compiled
from igps.retrieval.ranking import SearchResult

MOST_WHOLE = 2000
"""Shapes whose pairs are all taken, and the sums over walks of them by the inverse."""

# Of conjugate gradients, for walks whose condition is below 40
_ROUNDS = 40
# Rows whose pairs are compared at a time
_AT_ONCE = 20
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
    """`rerank` of a collection of which each shape's nearest are known.

    Walks are those among a shape and its nearest (Yang, Hinami, Matsui, Ly and Satoh 2019). With lists of all others,
    this is `rerank`.

    Args:
        found: of each of N shapes, the M others that are nearest, closest first: (N, M).
        mean: distance of two shapes of the collection, over all pairs or a sample of them.
        n_neighbours, n_expanded, share, diffusion, keep_nearest, progress: see `rerank`.

    Returns:
        the same shapes in their new order, (N, M), and their distances, without unit; of two shapes of which neither is
        in the other's list, it would be 1 - share and more.

    Raises:
        ValueError: shorter lists than there shall be neighbours, or a mean of 0.
    """
    lists, given = found.indices.numpy(), found.distances.double().numpy()
    n, m = lists.shape
    n_near = max(n_neighbours, n_expanded - 1)
    if n_near > m or mean <= 0:
        raise ValueError(
            f"found, mean: expected at least {n_near} neighbours of each shape and a mean above 0, got {m} and {mean}."
        )
    n_pairs, half = n * (n - 1), max(1, round(n_neighbours / 2))
    graph = _symmetric(lists, given)
    apart = graph.data / mean
    if diffusion:
        walked = _symmetric(lists, _diffused(lists, given, half, diffusion)).data
        average = 1 - (graph.nnz - walked.sum()) / n_pairs  # of those in no list, it is 1
        apart = (1 - share) * walked / max(average, _TINY) + share * apart
        del walked
    before = apart.sum()
    if diffusion and keep_nearest:
        apart = _brought_forward(apart, graph, lists[:, 0])
    average = 1 + (apart.sum() - before) / n_pairs
    weights = _neighbourhoods(apart, graph, n_neighbours, half, n_expanded)
    anew = (1 - share) * jaccard(weights, graph, progress) + share * apart / average
    if keep_nearest:
        anew = _brought_forward(anew, graph, lists[:, 0])
    ranked = _like(graph, anew)[np.repeat(np.arange(n), m), lists.ravel()].reshape(n, m)
    best = np.argsort(ranked, axis=1, kind="stable")
    return SearchResult(*(torch.from_numpy(np.take_along_axis(one, best, axis=1)) for one in (lists, ranked)))


def _diffused(lists: Integers, given: Floats, half: int, diffusion: float) -> Floats:
    """Distances (N, M) of each shape to its list: one minus the scaled sums over the walks between them."""
    n, m = lists.shape
    scale = np.maximum(given[:, :half].mean(axis=1), _TINY)
    ends = lists[:, :half]
    tied = _symmetric(ends, np.exp(-np.square(given[:, :half]) / np.maximum(scale[:, None] * scale[ends], _TINY)))
    degree = sparse.diags_array(1 / np.sqrt(np.maximum(tied.sum(axis=1), _TINY)))
    steps = sparse.csr_array(diffusion * (degree @ tied @ degree))
    inside = np.column_stack([np.arange(n), lists])
    if m == n - 1 < MOST_WHOLE:
        alike = np.take_along_axis(np.linalg.inv(np.eye(n) - steps.toarray()), inside, axis=1)
    else:
        alike = np.zeros((n, m + 1))
        walks(inside, steps.indptr, steps.indices, steps.data, _ROUNDS, alike)
    length = 1 / np.sqrt(alike[:, 0])
    return (1 - length[:, None] * alike[:, 1:] * length[lists]).clip(0)


def _neighbourhoods(
    apart: Floats, graph: sparse.csr_array, n_neighbours: int, half: int, n_expanded: int
) -> sparse.csr_array:
    """(N, N) weights of the members of each shape's neighbourhood, averaged over its nearest; rows add up to 1."""
    n = graph.shape[0]
    n_first = max(n_neighbours, n_expanded - 1)
    rows = map(slice, graph.indptr, graph.indptr[1:])
    firsts = [graph.indices[row][apart[row].argsort(kind="stable")[:n_first]] for row in rows]
    order = np.column_stack([np.arange(n), firsts])
    members, halves = (_reciprocal(order[:, : k + 1]) for k in (n_neighbours, half))
    joins = sparse.csr_array(members @ halves.T).multiply(members).tocsr()
    joins.data = (2 / 3 * halves.sum(axis=1)[joins.indices] <= joins.data).astype(np.float64)
    of, to = (members + joins @ halves).nonzero()
    nearest = order[:, 1 : n_neighbours + 1]
    near = _like(graph, apart)[np.repeat(np.arange(n), n_neighbours), nearest.ravel()].reshape(n, -1).mean(axis=1)
    scale = np.repeat(-np.maximum(near, _TINY), np.diff(graph.indptr))
    alike = np.exp(np.divide(apart, scale, out=scale), out=scale)
    weight = np.where(of == to, 1.0, _like(graph, alike)[of, to])
    weights = sparse.csr_array((weight, (of, to)), shape=(n, n))
    weights = _binary(order[:, :n_expanded]) @ sparse.diags_array(1 / (n_expanded * weights.sum(axis=1))) @ weights
    weights = sparse.csr_array(weights)
    weights.sort_indices()
    return weights


def jaccard(weights: sparse.csr_array, graph: sparse.csr_array, progress: bool) -> Floats:
    """Distances of the pairs of a graph, 0 to 1, by the share of weights that their neighbourhoods have in common."""
    n, rows, smaller = graph.shape[0], _rows(graph), np.empty(graph.nnz)
    ones = np.ones(n)
    with tqdm(total=n, desc="re-ranked", disable=not progress) as bar:
        for first in range(0, n, _AT_ONCE):
            last = min(first + _AT_ONCE, n)
            pairs = slice(graph.indptr[first], graph.indptr[last])
            smaller[pairs] = weights[rows[pairs]].minimum(weights[graph.indices[pairs]]) @ ones
            bar.update(last - first)
    return (1 - smaller / (2 - smaller)).clip(0)


def _symmetric(lists: Integers, values: Floats) -> sparse.csr_array:
    """(N, N) of values (N, M) of pairs (i, lists[i]) and of those the other way round; the mean of both where given."""
    n, m = lists.shape
    number = np.int32 if 2 * n * m < 2**31 else np.int64
    places = lists.ravel().astype(number), np.arange(0, n * m + 1, m, dtype=number)
    given = sparse.csr_array((values.flatten(), *places), shape=(n, n))
    given.sort_indices()
    ones = sparse.csr_array((np.ones(n * m, dtype=np.int8), given.indices, given.indptr), shape=(n, n))
    times = ones + ones.T.tocsr()  # how often each pair is given: once or twice, in a byte
    rows = _rows(times)
    means = given[rows, times.indices]  # 0 where not given
    means += given[times.indices, rows]
    means /= times.data
    return _like(times, means)


def _binary(lists: Integers) -> sparse.csr_array:
    n, m = lists.shape
    return sparse.csr_array((np.ones(n * m), (np.repeat(np.arange(n), m), lists.ravel())), shape=(n, n))


def _reciprocal(lists: Integers) -> sparse.csr_array:
    """Ones for the pairs that lie in each other's lists."""
    ones = _binary(lists)
    return ones.multiply(ones.T).tocsr()


def _like(graph: sparse.csr_array, values: Floats) -> sparse.csr_array:
    """Other values of the pairs of a graph."""
    return sparse.csr_array((values, graph.indices, graph.indptr), shape=graph.shape)


def _rows(graph: sparse.csr_array) -> Integers:
    """The first shape of each pair."""
    return np.repeat(np.arange(graph.shape[0], dtype=graph.indices.dtype), np.diff(graph.indptr))


def _brought_forward(values: Floats, graph: sparse.csr_array, nearest: Integers) -> Floats:
    """The values of pairs; those of pairs of nearest neighbours made smaller than all others, in their own order."""
    nearest = nearest.astype(graph.indices.dtype)
    rows = _rows(graph)
    first = (nearest[rows] == graph.indices) | (nearest[graph.indices] == rows)
    least = values.min(where=~first & (values > 0), initial=np.inf)
    found, forward = values.copy(), graph.data[first]
    # half of the least, so that single precision leaves no tie
    found[first] = 0.5 * (least if np.isfinite(least) else 1.0) * forward / max(forward.max(), _TINY)
    return found


@compiled()
def walks(lists: Integers, starts: Integers, ends: Integers, steps: Floats, n_rounds: int, alike: Floats) -> None:
    """Write, of each shape, the sums over all walks from it to those of its list (N, L), itself first, among these.

    Rows of (I - S) x = e by conjugate gradients, S sparse: `starts`, `ends` and `steps` are those of its rows.
    """
    place = np.full(len(lists), -1)
    for i in range(len(lists)):
        here = lists[i]
        for a in range(len(here)):
            place[here[a]] = a
        residual = np.zeros(len(here))
        residual[0] = 1.0
        direction, size = residual.copy(), 1.0
        for _ in range(n_rounds):
            moved = direction.copy()
            for a in range(len(here)):
                for e in range(starts[here[a]], starts[here[a] + 1]):
                    if place[ends[e]] >= 0:
                        moved[a] -= steps[e] * direction[place[ends[e]]]
            along = size / (direction * moved).sum()
            alike[i] += along * direction
            residual -= along * moved
            left = (residual * residual).sum()
            if left < 1e-10:
                break
            direction = residual + left / size * direction
            size = left
        for a in range(len(here)):
            place[here[a]] = -1

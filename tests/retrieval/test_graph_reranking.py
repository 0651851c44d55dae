"""Re-ranking on the graph of nearest neighbours against that of the whole collection, and its loops against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import sparse
from torch import Tensor

from igps.retrieval import (
    SearchResult,
    euclidean,
    graph_reranking,
    rerank,
    rerank_graph,
    reranking,
    retrieval_scores,
)
from igps.retrieval.graph_reranking import jaccard, walks


def own_distances(points: Tensor) -> Tensor:
    distances = euclidean(points, points).fill_diagonal_(0)
    return (distances + distances.T) / 2


def nearest(distances: Tensor, n: int) -> SearchResult:
    order = distances.clone().fill_diagonal_(-1).argsort(dim=1, stable=True)[:, 1 : n + 1]
    return SearchResult(order, distances.gather(1, order))


def mean_of(distances: Tensor) -> float:
    return float(distances.sum() / (len(distances) * (len(distances) - 1)))


@pytest.mark.parametrize(
    "numbers",
    [
        {},
        {"diffusion": 0},
        {"n_neighbours": 6, "n_expanded": 3, "share": 0.5, "diffusion": 0.8},
        {"share": 0.1},
        {"n_neighbours": 4, "n_expanded": 7},
    ],
)
def test_complete_lists_give_the_distances_of_the_dense_solution(
    numbers: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    points = torch.randn(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    distances = own_distances(points)
    expected = rerank(distances, **numbers)  # type: ignore[arg-type]
    monkeypatch.setattr(graph_reranking, "MAX_DENSE", 0)
    found = rerank_graph(nearest(distances, 59), mean_of(distances), **numbers)  # type: ignore[arg-type]
    torch.testing.assert_close(
        found.distances, expected.gather(1, found.indices), rtol=0, atol=2e-5
    )
    assert (found.distances.diff(dim=1) >= 0).all()
    assert torch.equal(found.indices.sort().values, nearest(distances, 59).indices.sort().values)


def test_short_lists_find_classes_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve of twenty points each, scattered; each point is tied to half of all, as `rerank` does of many."""
    generator = torch.Generator().manual_seed(0)
    points = (
        torch.randn(12, 1, 20, generator=generator) + torch.randn(12, 20, 20, generator=generator)
    ).flatten(0, 1)
    labels, own = torch.arange(12).repeat_interleave(20), own_distances(points)
    whole = rerank(own)
    monkeypatch.setattr(reranking, "MAX_DENSE", 200)
    monkeypatch.setattr(reranking, "_LIST_LIMITS", (120, 120))
    found = rerank(own)
    before, expected, tier = (
        retrieval_scores(one, labels).mean()["ft"] for one in (own, whole, found)
    )
    assert expected > before + 0.1
    assert tier > expected - 0.02
    assert not torch.equal(found, whole)
    torch.testing.assert_close(found, found.T, rtol=0, atol=0)
    assert (found.diagonal() == 0).all()
    alone = own.clone().fill_diagonal_(torch.inf)
    assert torch.equal(found.clone().fill_diagonal_(torch.inf).argmin(1), alone.argmin(1))


def test_walks_are_those_inside_the_list() -> None:
    generator = np.random.default_rng(0)
    steps = sparse.random_array((40, 40), density=0.1, random_state=generator).toarray()
    steps = 0.9 * (steps + steps.T) / np.abs(np.linalg.eigvalsh(steps + steps.T)).max()
    lists = np.array(
        [[i, *generator.permutation(np.delete(np.arange(40), i))[:14]] for i in range(40)]
    )
    rows, found = sparse.csr_array(steps), np.zeros(lists.shape)
    walks(lists, rows.indptr, rows.indices, rows.data, 200, found)
    for here, row in zip(lists, found, strict=True):
        expected = np.linalg.inv(np.eye(15) - steps[np.ix_(here, here)])[0]
        np.testing.assert_allclose(row, expected, atol=1e-4)


def test_distances_by_the_sums_of_the_smaller_weights() -> None:
    generator = np.random.default_rng(1)
    weights = sparse.random_array((50, 50), density=0.3, random_state=generator, format="csr")
    weights = sparse.csr_array(sparse.diags_array(1 / weights.sum(axis=1)) @ weights)
    pairs = sparse.random_array((50, 50), density=0.2, random_state=generator, format="csr")
    dense, rows = weights.toarray(), np.repeat(np.arange(50), np.diff(pairs.indptr))
    smaller, larger = (
        one(dense[rows], dense[pairs.indices]).sum(axis=1) for one in (np.minimum, np.maximum)
    )
    np.testing.assert_allclose(jaccard(weights, pairs, False), 1 - smaller / larger, atol=1e-12)


def test_what_it_refuses() -> None:
    lists = nearest(
        own_distances(torch.randn(30, 3, generator=torch.Generator().manual_seed(0))), 10
    )
    with pytest.raises(
        ValueError, match="at least 20 neighbours of each shape and a mean above 0, got 10 and 1"
    ):
        rerank_graph(lists, 1.0)
    with pytest.raises(ValueError, match="a mean above 0, got 10 and 0"):
        rerank_graph(lists, 0.0, 5)

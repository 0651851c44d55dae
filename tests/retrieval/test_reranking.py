"""Re-ranking against the sets and sums of the paper, written out shape by shape, and what it promises."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from igps.retrieval import euclidean, rerank, rerank_candidates, retrieval_scores, search
from igps.retrieval.reranking import jaccard_distances


def by_hand(distances, k, n_expanded):
    """Zhong, Zheng, Cao and Li 2017, equations 2, 3, 7, 10, 11 and 12; the units of distance are this library's."""
    n = len(distances)
    ranked = []
    for i in range(n):
        others = [j for j in range(n) if j != i]
        ranked.append([i, *sorted(others, key=lambda j, i=i: distances[i][j])])

    def reciprocal(i, k):
        return {j for j in ranked[i][: k + 1] if i in ranked[j][: k + 1]}

    weights = []
    for i in range(n):
        members = reciprocal(i, k)
        for j in sorted(reciprocal(i, k)):
            half = reciprocal(j, max(1, round(k / 2)))
            if len(half & reciprocal(i, k)) >= 2 / 3 * len(half):
                members |= half
        near = sum(distances[i][j] for j in ranked[i][1 : k + 1]) / k
        row = [math.exp(-distances[i][j] / near) if j in members else 0.0 for j in range(n)]
        weights.append([value / sum(row) for value in row])
    expanded = [np.mean([weights[m] for m in order[:n_expanded]], axis=0) for order in ranked]
    found = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(n):
            if i != j:
                smaller = np.minimum(expanded[i], expanded[j]).sum()
                larger = np.maximum(expanded[i], expanded[j]).sum()
                found[i][j] = 1 - smaller / larger
    return found


@pytest.fixture
def points():
    return torch.randn(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize(("k", "n_expanded"), [(6, 3), (9, 1), (12, 4), (20, 6)])
def test_sets_and_sums_of_the_paper(k, n_expanded, points):
    distances = euclidean(points, points).numpy()
    expected = by_hand(distances.tolist(), k, n_expanded)
    assert_allclose(jaccard_distances(distances, k, n_expanded), expected, atol=1e-10)


def test_a_shape_is_its_own_nearest_among_equals(points):
    """Three copies of each of four, and one of the others; the nearest of a copy is itself, then the next copies."""
    repeated = torch.cat([points[:8], points[:4], points[:4]])
    distances = euclidean(repeated, repeated)
    distances = ((distances + distances.T) / 2).numpy()
    for k in (3, 5):
        found = jaccard_distances(distances, k, 1)
        assert_allclose(found, by_hand(distances.tolist(), k, 1), atol=1e-10)


def mixed(distances):
    """The mean of Jaccard distances and those before, by the paper's weight, before the nearest are put first."""
    before = distances.double().numpy()
    mean = before.sum() / (len(before) * (len(before) - 1))
    found = 0.7 * jaccard_distances(before) + 0.3 * before / mean
    return torch.from_numpy(found).to(distances).fill_diagonal_(0)


@pytest.mark.parametrize(("n_copies", "dtype"), [(0, torch.float32), (8, torch.float64)])
def test_the_nearest_stays_the_nearest(n_copies, dtype):
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(60, 4, generator=generator, dtype=torch.float64)
    points = torch.cat([points, *[points[:n_copies]] * 2])
    own = euclidean(points, points).to(dtype).fill_diagonal_(0)
    own = torch.minimum(own, own.T)
    found = rerank(own)
    moved = mixed(own)
    assert_close(found, found.T, rtol=0, atol=0)
    alone = own.clone().fill_diagonal_(torch.inf)
    for i, row in enumerate(found.clone().fill_diagonal_(torch.inf)):
        assert alone[i, row.argmin()] == alone[i].min()
    if not n_copies:  # it does move without: else the test would not tell
        assert (moved.fill_diagonal_(torch.inf).argmin(1) != alone.argmin(1)).any()
    nearest = torch.zeros_like(own, dtype=torch.bool).scatter_(1, alone.argmin(1)[:, None], True)
    if not n_copies:  # among equals, which is the nearest is not told
        rest = ~(nearest | nearest.T).fill_diagonal_(True)
        alone = mixed(own)
        assert_close(found[rest], alone[rest], rtol=0, atol=0)
        assert found[nearest].max() < found[rest].min()


def test_the_order_of_shapes_does_not_matter(points):
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    found = rerank(euclidean(points, points))
    shuffled = rerank(euclidean(points[order], points[order]))
    assert_close(shuffled, found[order][:, order])
    assert_close(found, found.T)
    assert_close(rerank(3 * euclidean(points, points)), found)


def test_classes_that_scatter_are_found_better():
    """Twelve of twenty points each, so far apart that a third of the first tier is of another class."""
    generator = torch.Generator().manual_seed(0)
    centres = torch.randn(12, 1, 20, generator=generator)
    scattered = (centres + 1.0 * torch.randn(12, 20, 20, generator=generator)).flatten(0, 1)
    labels = torch.arange(12).repeat_interleave(20)
    plain = euclidean(scattered, scattered)
    before = retrieval_scores(plain, labels).mean()["ft"]
    after = retrieval_scores(rerank(plain), labels).mean()["ft"]
    assert 0.5 < before < 0.8
    assert after > before + 0.1


def test_a_query_with_all_that_there_is_ranks_as_the_collection_does(points):
    queries = points[:3]
    gallery = points[3:]
    for query in queries:
        found = rerank_candidates(query[None], gallery, euclidean)
        together = torch.cat([query[None], gallery])
        assert_close(found, rerank(euclidean(together, together))[0, 1:], rtol=0, atol=1e-9)


def test_a_query_is_put_in_order_by_its_nearest_alone():
    """Of 240 points the nearest 100 tell as much as all do; the nearest 20 can only change places."""
    generator = torch.Generator().manual_seed(1)
    labels = torch.arange(12).repeat_interleave(20)
    centres = torch.randn(12, 1, 20, generator=generator)
    points = (centres + torch.randn(12, 20, 20, generator=generator)).flatten(0, 1)
    queries = torch.arange(0, 240, 7)
    precision = []
    for n_near in (20, 60, 100, 240):
        near = search(points[queries], points, top=n_near, distance=euclidean)
        relevant = []
        for query, candidates in zip(queries, near.indices, strict=True):
            found = rerank_candidates(points[query][None], points[candidates], euclidean)
            best = candidates[found.argsort(stable=True)[:20]]
            relevant.append(labels[best] == labels[query])
        precision.append(float(torch.stack(relevant).double().mean()))
    assert precision[1] > precision[0] + 0.15
    assert abs(precision[2] - precision[3]) < 0.05


def test_few_shapes_and_equal_ones():
    assert rerank(torch.zeros(1, 1)).tolist() == [[0.0]]
    twins = torch.tensor([[0.0, 0, 1], [0, 0, 1], [1, 1, 0]])
    found = rerank(twins)
    assert torch.isfinite(found).all()
    assert found[0, 1] < found[0, 2]
    assert torch.isfinite(rerank(torch.zeros(5, 5))).all()


@pytest.mark.parametrize(
    ("distances", "message"),
    [
        (np.zeros((3, 3)), "distances: expected a tensor, got ndarray"),
        (torch.zeros(2, 3), r"expected \(N, N\), of a collection to itself, got \(2, 3\)"),
        (-torch.ones(2, 2), "finite numbers ≥ 0"),
        (torch.full((2, 2), math.nan), "finite numbers ≥ 0"),
    ],
)
def test_what_it_refuses(distances, message):
    with pytest.raises(ValueError, match=message):
        rerank(distances)

"""Ranking and search on hand-worked distances."""

import numpy as np
import pytest
import torch

from igps.retrieval import chi_square, euclidean, rank, search


def test_rank_orders_by_distance_and_ties_by_index():
    distances = torch.tensor(
        [
            [3.0, 1.0, 2.0, 1.0],
            [0.0, 0.0, float("inf"), 0.0],
        ]
    )
    assert rank(distances).tolist() == [[1, 3, 2, 0], [0, 1, 3, 2]]


def test_many_ties_keep_the_order_of_the_gallery():
    distances = torch.arange(1000).remainder(2).float()[None]
    assert rank(distances)[0].tolist() == [*range(0, 1000, 2), *range(1, 1000, 2)]


def test_search_returns_the_closest_with_their_distances():
    gallery = torch.tensor([[10.0], [4.0], [7.0], [1.0]])
    result = search(
        torch.tensor([[5.0], [11.0]]),
        gallery,
        top=3,
        distance=euclidean,
    )
    # 4 and 7 are 1 and 2 from 5, 1 is 4 from it
    assert result.indices.tolist() == [[1, 2, 3], [0, 2, 1]]
    assert result.distances.tolist() == [[1.0, 2.0, 4.0], [1.0, 4.0, 7.0]]


def test_search_finds_each_shape_first_in_its_own_gallery_by_chi_square():
    shapes = torch.rand(
        12,
        3,
        4,
        generator=torch.Generator().manual_seed(0),
    )
    result = search(shapes, shapes, top=12)
    assert result.indices[:, 0].tolist() == list(range(12))
    assert torch.equal(
        result.distances[:, 0],
        torch.zeros(12),
    )
    assert torch.equal(
        result.distances,
        chi_square(shapes, shapes).sort(1).values,
    )


@pytest.mark.parametrize("top", [0, 4, -1])
def test_search_refuses_more_than_the_gallery_holds(top):
    with pytest.raises(
        ValueError, match=f"top: expected 1 to 3, the size of the gallery, got {top}"
    ):
        search(
            torch.ones(1, 2),
            torch.ones(3, 2),
            top=top,
        )


@pytest.mark.parametrize(
    ("distances", "message"),
    [
        (torch.ones(3), "expected a real matrix"),
        (
            np.ones((2, 2)),
            "distances: expected a tensor, got ndarray; convert with torch.as_tensor",
        ),
        (torch.ones(2, 2, dtype=torch.bool), "expected a real matrix"),
        (torch.tensor([[0.0, float("nan")]]), "got NaN"),
        (torch.tensor([[0.5, -0.9]]), "smaller is closer.*-0.9.*similarities"),
    ],
)
def test_rank_refuses_what_is_no_distance(distances, message):
    with pytest.raises(ValueError, match=message):
        rank(distances)

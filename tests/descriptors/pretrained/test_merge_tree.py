"""Merge trees, against connected components level by level, and where they are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from igps.descriptors.pretrained._merge_tree import merge_tree
from igps.nn.batch_features import nearest_neighbours


def components(neighbours: Tensor, kept: np.ndarray) -> np.ndarray:
    """Of each point the number of its component among those kept; −1 for the others."""
    n = len(neighbours)
    rows = np.repeat(np.arange(n), neighbours.shape[1])
    columns = neighbours.numpy().ravel()
    both = kept[rows] & kept[columns]
    graph = coo_array((np.ones(both.sum()), (rows[both], columns[both])), shape=(n, n))
    return np.where(kept, connected_components(graph, directed=False)[1], -1)


def random_graph(seed: int, n: int = 80, k: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(n, generator=generator, dtype=torch.float64)
    return values, nearest_neighbours(torch.rand(n, 2, generator=generator), k)


@pytest.mark.parametrize("seed", range(5))
def test_as_many_branches_live_at_each_level_as_there_are_components(seed):
    values, neighbours = random_graph(seed)
    tree = merge_tree(values, neighbours)
    peaks = values[tree.peaks]
    saddles = values[tree.saddles]
    lowest = values.min()
    for level in values.tolist():
        # a branch that joins none lives down to the lowest point
        living = (peaks >= level) & ((saddles < level) | (saddles == lowest))
        of_level = components(neighbours, (values >= level).numpy())
        assert int(living.sum()) == len(set(of_level.tolist()) - {-1})


@pytest.mark.parametrize("seed", range(5))
def test_pieces_are_components_named_by_their_peaks(seed):
    values, neighbours = random_graph(seed)
    counts = [1, 8, 8, 30, 80]
    tree = merge_tree(values, neighbours, counts)
    assert tree.pieces.shape == (5, 80)
    for count, pieces in zip(counts, tree.pieces, strict=True):
        kept = np.zeros(80, bool)
        kept[values.argsort(descending=True)[:count]] = True
        expected = components(neighbours, kept)
        for component in set(expected.tolist()) - {-1}:
            members = np.flatnonzero(expected == component)
            assert set(pieces[members].tolist()) == {int(members[values[members].argmax()])}
        assert (pieces[~torch.from_numpy(kept)] == -1).all()


def on_a_path(values: Sequence[float]) -> tuple[Tensor, Tensor]:
    last = len(values) - 1
    return torch.tensor(values), torch.tensor(
        [[max(k - 1, 0), min(k + 1, last)] for k in range(last + 1)]
    )


def test_the_lower_of_two_peaks_ends_where_they_meet():
    """Heights 5, 3 and 4, passes 1 and 2 between them, and 0 at the lower end."""
    values, neighbours = on_a_path([0.0, 5.0, 1.0, 3.0, 2.0, 4.0])
    tree = merge_tree(values, neighbours)
    found = dict(zip(values[tree.peaks].tolist(), values[tree.saddles].tolist(), strict=True))
    assert found == {5.0: 0.0, 4.0: 1.0, 3.0: 2.0}


def test_of_equal_peaks_the_first_lives_on():
    tree = merge_tree(*on_a_path([2.0, 1.0, 2.0, 0.0]))
    assert sorted(zip(tree.peaks.tolist(), tree.saddles.tolist(), strict=True)) == [(0, 3), (2, 1)]
    many = merge_tree(*on_a_path([2.0, 1.0] * 200 + [0.0]))
    assert sorted(many.peaks.tolist()) == list(range(0, 400, 2))
    assert (0, 400) in zip(many.peaks.tolist(), many.saddles.tolist(), strict=True)


def test_what_is_apart_ends_at_the_bottom():
    values = torch.tensor([3.0, 1.0, 2.0, 0.5])
    tree = merge_tree(values, torch.tensor([[1], [0], [3], [2]]))
    assert sorted(zip(tree.peaks.tolist(), tree.saddles.tolist(), strict=True)) == [(0, 3), (2, 3)]


def test_points_outside_the_mask_are_not_there():
    values, neighbours = random_graph(7)
    mask = torch.arange(80) % 3 != 1
    numbers = mask.nonzero()[:, 0]
    place = torch.full((80,), -1)
    place[numbers] = torch.arange(len(numbers))
    # Without those that are not there
    own = torch.where(mask[neighbours], neighbours, torch.arange(80)[:, None])
    expected = merge_tree(values[mask], place[own[mask]], [5, 20])
    tree = merge_tree(values.masked_fill(~mask, torch.nan), neighbours, [5, 20], mask)
    assert torch.equal(tree.peaks, numbers[expected.peaks])
    assert torch.equal(tree.saddles, numbers[expected.saddles])
    there = expected.pieces >= 0
    assert torch.equal(tree.pieces[:, mask][there], numbers[expected.pieces[there]])
    assert (tree.pieces >= 0).sum(dim=1).tolist() == [5, 20]


def test_a_single_point_is_one_branch_of_no_length():
    tree = merge_tree(torch.tensor([1.0]), nearest_neighbours(torch.zeros(1, 3), 4), [1])
    assert [one.tolist() for one in tree] == [[0], [0], [[0]]]


def test_what_cannot_be_ordered_is_refused():
    with pytest.raises(ValueError, match="values: expected finite numbers, got NaN or infinity"):
        merge_tree(torch.tensor([1.0, torch.nan]), torch.tensor([[1], [0]]))

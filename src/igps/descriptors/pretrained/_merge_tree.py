"""The merge tree of a function on points: how its peaks grow together as the level falls."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from igps._arrays import Integers
from igps._compiled import compiled
from igps.nn.batch_features import SampleFeatures


class MergeTree(NamedTuple):
    """Branches by the elder rule, and the pieces of superlevel sets, by the numbers of points."""

    peaks: Tensor  # (B,) the highest point of each branch
    saddles: Tensor  # (B,) where it joins the branch of a higher peak; the lowest point of all where it joins none
    pieces: Tensor  # (L, P) of each point the peak of the piece of the superlevel set it belongs to; −1 where below


def merge_trees(features: SampleFeatures, embedding: nn.Module, levels: Sequence[float] = ()) -> list[MergeTree]:
    """The merge tree of log U of some samples of each body, U the barycentroid potential of an embedding.

    Two samples are neighbours if one is among the nearest to the other in the embedding. Pieces are those of the
    levels, shares of the samples of a body that are in them, ascending. All is on the CPU. A ValueError of values that
    are not finite, or of a body without samples.
    """
    if torch.compiler.is_compiling():  # the loops are compiled already; as a decorator this would import the compiler
        return torch.compiler.disable(_merge_trees)(features, embedding, levels)
    return _merge_trees(features, embedding, levels)


def _merge_trees(features: SampleFeatures, embedding: nn.Module, levels: Sequence[float]) -> list[MergeTree]:
    asked = features.log_potential(embedding).detach(), features.neighbours(embedding), features.samples.mask
    trees = []
    for values, neighbours, mask in zip(*(one.cpu() for one in asked), strict=True):
        if not (n := int(mask.sum())):
            raise ValueError("samples: expected at least one of each body, got none.")
        trees.append(merge_tree(values, neighbours, [max(1, round(share * n)) for share in levels], mask))
    return trees


def merge_tree(values: Tensor, neighbours: Tensor, counts: Sequence[int] = (), mask: Tensor | None = None) -> MergeTree:
    """The merge tree of finite values (P,) on points; two are neighbours if either names the other in (P, k).

    From the highest value down, each point joins the pieces of those of its neighbours that are higher; where it joins
    two pieces, the one with the lower peak ends. A branch is as long as its peak is above its end, which is called its
    persistence. Source: Edelsbrunner, Letscher and Zomorodian 2002; on shapes, Skraba, Ovsjanikov, Chazal and Guibas
    2010. Of equal values, that of the smaller number is the higher. Superlevel sets are told by counts (L,), how many
    points each has, 1 to P, ascending. All are on the CPU; of the points, those of a mask (P,) alone are there. A value
    that is not finite is a ValueError.
    """
    there = torch.arange(len(values)) if mask is None else mask.nonzero()[:, 0]
    if not torch.isfinite(values[there]).all():
        raise ValueError("values: expected finite numbers, got NaN or infinity.")
    order = there[torch.argsort(values[there], descending=True, stable=True)].numpy()
    ends = np.empty((len(order), 2), np.int64)
    pieces = np.full((len(counts), len(values)), -1, np.int64)
    n = _merge(order, neighbours.numpy(), np.array(counts, np.int64), ends, pieces)
    return MergeTree(torch.from_numpy(ends[:n, 0]), torch.from_numpy(ends[:n, 1]), torch.from_numpy(pieces))


@compiled()
def _merge(
    order: Integers, neighbours: Integers, counts: Integers, ends: Integers,
    pieces: Integers,
) -> int:  # fmt: skip
    """Write the branches and the pieces of a function on a graph, see `merge_tree`; how many branches there are.

    The points come in order, the highest first; those of (P, k) neighbours that do not come are not there. Written are
    the peak and the saddle of each branch, and the peak of the piece of each point to (L, P), which holds −1.
    """
    n_points, n_neighbours = neighbours.shape
    n_there = len(order)
    place = np.full(n_points, n_there, np.int64)
    for k in range(n_there):
        place[order[k]] = k
    # of each point the others that name it, one list after the other; while they are filled, point i has place i + 1
    starts = np.zeros(n_points + 2, np.int64)
    for i in range(n_points):
        for j in range(n_neighbours):
            starts[neighbours[i, j] + 2] += 1
    parent = np.empty(n_points, np.int64)
    for i in range(n_points):
        starts[i + 1] += starts[i]
        parent[i] = i
    naming = np.empty(n_points * n_neighbours, np.int64)
    for i in range(n_points):
        for j in range(n_neighbours):
            named = neighbours[i, j]
            naming[starts[named + 1]] = i
            starts[named + 1] += 1
    n_branches = level = 0
    for reached in range(n_there):
        point = order[reached]
        for j in range(n_neighbours + starts[point + 1] - starts[point]):
            other = neighbours[point, j] if j < n_neighbours else naming[starts[point] + j - n_neighbours]
            if place[other] >= reached:
                continue
            first, second = point, other
            while parent[first] != first:
                parent[first] = parent[parent[first]]
                first = parent[first]
            while parent[second] != second:
                parent[second] = parent[parent[second]]
                second = parent[second]
            if first == second:
                continue
            if place[first] < place[second]:
                first, second = second, first
            parent[first] = second  # the higher peak lives on
            if first != point:
                ends[n_branches, 0], ends[n_branches, 1] = first, point
                n_branches += 1
        while level < len(counts) and counts[level] == reached + 1:
            for k in range(reached + 1):
                root = order[k]
                while parent[root] != root:
                    root = parent[root]
                pieces[level, order[k]] = root
            level += 1
    for k in range(n_there):
        point = order[k]
        if parent[point] == point:
            ends[n_branches, 0], ends[n_branches, 1] = point, order[n_there - 1]
            n_branches += 1
    return n_branches

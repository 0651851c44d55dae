"""The merge tree of a function on points: how its peaks grow together as the level falls."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Integers
from igps._compiled import compiled


class MergeTree(NamedTuple):
    """Branches by the elder rule, and the pieces of superlevel sets, by the numbers of points."""

    peaks: Tensor  # (B,) the highest point of each branch
    saddles: Tensor  # (B,) where it joins the branch of a higher peak; the lowest point of all where it joins none
    pieces: Tensor  # (L, P) of each point the peak of the piece of the superlevel set it belongs to; −1 where below


def merge_tree(values: Tensor, neighbours: Tensor, counts: Sequence[int] = ()) -> MergeTree:
    """The merge tree of finite values (P,) on points; two are neighbours if either names the other in (P, k).

    From the highest value down, each point joins the pieces of those of its neighbours that are higher; where it joins
    two pieces, the one with the lower peak ends. A branch is as long as its peak is above its end, which is called its
    persistence. Source: Edelsbrunner, Letscher and Zomorodian 2002; on shapes, Skraba, Ovsjanikov, Chazal and Guibas
    2010. Of equal values, that of the smaller number is the higher. Superlevel sets are told by counts (L,), how many
    points each has, 1 to P, ascending. A value that is not finite is a ValueError.
    """
    if not torch.isfinite(values).all():
        raise ValueError("values: expected finite numbers, got NaN or infinity.")
    if torch.compiler.is_compiling():  # the loops are compiled already; as a decorator this would import the compiler
        return torch.compiler.disable(_merge_tree)(values, neighbours, counts)
    return _merge_tree(values, neighbours, counts)


def _merge_tree(values: Tensor, neighbours: Tensor, counts: Sequence[int]) -> MergeTree:
    order = torch.argsort(values.detach(), descending=True, stable=True).cpu().numpy()
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    pairs = np.stack([place.repeat(neighbours.shape[1]), place[neighbours.cpu().numpy().ravel()]])
    higher, lower = pairs.min(axis=0), pairs.max(axis=0)
    met = np.argsort(lower)  # of those that meet at one point, the order does not matter
    ends = np.empty((len(values), 2), np.int64)
    pieces = np.full((len(counts), len(values)), -1, np.int64)
    n = _merge(order, higher[met], lower[met], np.array(counts, np.int64), ends, pieces)
    found = torch.from_numpy(ends[:n]).to(values.device)
    return MergeTree(found[:, 0], found[:, 1], torch.from_numpy(pieces).to(values.device))


@compiled()
def _merge(
    order: Integers, higher: Integers, lower: Integers, counts: Integers, ends: Integers, pieces: Integers
) -> int:
    """Write the branches and the pieces of a function on a graph, see `merge_tree`; how many branches there are.

    The points (P,) come in order, the highest first, and go by their places in it, as do the higher and the lower of
    each pair of neighbours, in the order of the lower. Written are the peak and the saddle of each branch to (P, 2),
    and the peak of the piece of each point to (L, P), which holds −1.
    """
    parent = np.arange(len(order))
    n_branches = level = pair = 0
    for reached in range(len(order)):
        while pair < len(lower) and lower[pair] == reached:
            one, other = _root(parent, reached), _root(parent, higher[pair])
            pair += 1
            if one == other:
                continue
            ending = max(one, other)  # the higher peak lives on
            parent[ending] = min(one, other)
            if ending != reached:
                ends[n_branches, 0], ends[n_branches, 1] = order[ending], order[reached]
                n_branches += 1
        while level < len(counts) and counts[level] == reached + 1:
            for k in range(reached + 1):
                pieces[level, order[k]] = order[_root(parent, k)]
            level += 1
    for k in range(len(order)):
        if parent[k] == k:
            ends[n_branches, 0], ends[n_branches, 1] = order[k], order[-1]
            n_branches += 1
    return n_branches


@compiled()
def _root(parent: Integers, point: int) -> int:
    """Where the parents of a point lead, on a way that is halved for the next."""
    while parent[point] != point:
        parent[point] = parent[parent[point]]
        point = parent[point]
    return point

"""The merge tree of a function on points: how its peaks grow together as the level falls."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, library, nn

from igps._arrays import Integers
from igps._compiled import compiled
from igps.nn.batch_features import SampleFeatures


class MergeTree(NamedTuple):
    """Branches by the elder rule, and the pieces of superlevel sets, by the numbers of points."""

    peaks: Tensor  # (B,) the highest point of each branch
    saddles: Tensor  # (B,) where it joins the branch of a higher peak; the lowest point of all where it joins none
    pieces: Tensor  # (L, P) of each point the peak of the piece of the superlevel set it belongs to; −1 where below


def merge_trees(features: SampleFeatures, embedding: nn.Module, levels: Sequence[float] = ()) -> tuple[Tensor, Tensor]:
    """The merge tree of log U of some samples of each body, U the barycentroid potential of an embedding.

    Two samples are neighbours if one is among the nearest to the other in the embedding. It is one operator to what
    traces it. Its loops join points one after the other, on the CPU: of another device, all bodies go there at once.

    Found are (N, P) of each peak where its branch ends, of all other points themselves, and (N, L, P) the pieces of the
    levels, shares of the samples of a body, ascending; see `MergeTree`. A ValueError of values that are not finite, or
    of a body without samples.
    """
    values, neighbours = features.log_potential(embedding).detach(), features.neighbours(embedding)
    found: tuple[Tensor, Tensor] = _operator(values, neighbours, features.samples.mask, list(levels))
    return found


@library.custom_op(
    "igps::merge_trees",
    mutates_args=(),
    schema="(Tensor values, Tensor neighbours, Tensor mask, float[] levels) -> (Tensor, Tensor)",
)
def _operator(values: Tensor, neighbours: Tensor, mask: Tensor, levels: list[float]) -> tuple[Tensor, Tensor]:
    ends, pieces = _like(values, neighbours, mask, levels)
    ends, pieces = ends.cpu(), pieces.cpu()
    for i, (heights, near, real) in enumerate(zip(values.cpu(), neighbours.cpu(), mask.cpu(), strict=True)):
        if not (n := int(real.sum())):
            raise ValueError("samples: expected at least one of each body, got none.")
        tree = merge_tree(heights, near, [max(1, round(share * n)) for share in levels], real)
        ends[i] = torch.arange(len(heights), device="cpu").scatter(0, tree.peaks, tree.saddles)
        pieces[i] = tree.pieces
    return ends.to(values.device), pieces.to(values.device)


@_operator.register_fake
def _like(values: Tensor, neighbours: Tensor, mask: Tensor, levels: list[float]) -> tuple[Tensor, Tensor]:
    n_shapes, n_points = values.shape
    whole = values.new_empty(n_shapes, n_points, dtype=torch.int64)
    return whole, whole.new_empty(n_shapes, len(levels), n_points)


def merge_tree(values: Tensor, neighbours: Tensor, counts: Sequence[int] = (), mask: Tensor | None = None) -> MergeTree:
    """The merge tree of finite values (P,) on points; two are neighbours if either names the other in (P, k).

    From the highest value down, each point joins the pieces of those of its neighbours that are higher; where it joins
    two pieces, the one with the lower peak ends. A branch is as long as its peak is above its end, which is called its
    persistence. Source: Edelsbrunner, Letscher and Zomorodian 2002; on shapes, Skraba, Ovsjanikov, Chazal and Guibas
    2010. Of equal values, that of the smaller number is the higher. Superlevel sets are told by counts (L,), how many
    points each has, 1 to P, ascending. All are on the CPU; of the points, those of a mask (P,) alone are there. A value
    that is not finite is a ValueError.
    """
    there = torch.arange(len(values), device="cpu") if mask is None else mask.nonzero()[:, 0]
    if not torch.isfinite(values[there]).all():
        raise ValueError("values: expected finite numbers, got NaN or infinity.")
    order = there[torch.argsort(values[there], descending=True, stable=True)].numpy()
    place = np.full(len(values), -1)
    place[order] = np.arange(len(order))
    pairs = np.stack([place.repeat(neighbours.shape[1]), place[neighbours.numpy().ravel()]])
    pairs = pairs[:, (pairs >= 0).all(axis=0)]
    higher, lower = pairs.min(axis=0), pairs.max(axis=0)
    met = np.argsort(lower)  # of those that meet at one point, the order does not matter
    ends = np.empty((len(order), 2), np.int64)
    pieces = np.full((len(counts), len(values)), -1, np.int64)
    n = _merge(order, higher[met], lower[met], np.array(counts, np.int64), ends, pieces)
    return MergeTree(torch.from_numpy(ends[:n, 0]), torch.from_numpy(ends[:n, 1]), torch.from_numpy(pieces))


@compiled()
def _merge(
    order: Integers, higher: Integers, lower: Integers, counts: Integers, ends: Integers, pieces: Integers
) -> int:
    """Write the branches and the pieces of a function on a graph, see `merge_tree`; how many branches there are.

    The points come in order, the highest first, and go by their places in it, as do the higher and the lower of each
    pair of neighbours, in the order of the lower. Written are the peak and the saddle of each branch, and the peak of
    the piece of each point to (L, P), which holds −1.
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

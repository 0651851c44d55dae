"""Merge trees of functions on points: how the components of superlevel sets merge as the level falls."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, library, nn

from igps._arrays import Integers
from igps._compiled import compiled
from igps.nn.batch_features import SampleFeatures


class MergeTree(NamedTuple):
    """Branches by the elder rule, and components of superlevel sets, as indices of points."""

    peaks: Tensor  # (B,) the highest point of each branch
    saddles: Tensor  # (B,) where the branch joins that of a higher peak; the lowest of all points if it joins none
    pieces: Tensor  # (L, P) the peak of the component of each point at each level; −1 for points below the level


def merge_trees(
    features: SampleFeatures, embedding: nn.Module, levels: Sequence[float] = ()
) -> tuple[Tensor, Tensor]:
    """Compute the merge tree of log U for the samples of each body, where U is the barycentroid potential.

    Two samples are neighbours if one is among the nearest to the other in the embedding. The levels (L,) are sizes of
    superlevel sets, as shares of the samples of a body, ascending. For tracers such as `torch.compile`, the function is
    a single operator. It runs in compiled loops on the CPU; tensors on other devices are copied, all bodies at once.

    Returns:
        (N, P) the saddle of each sample that is a peak, and the sample itself for all others; and (N, L, P) the pieces
        of the levels, see `MergeTree`.

    Raises:
        ValueError: a potential is not finite, or a body has no samples.
    """
    values = features.log_potential(embedding).detach()
    neighbours = features.neighbours(embedding)
    mask = features.samples.mask
    saddles_and_pieces: tuple[Tensor, Tensor] = _operator(values, neighbours, mask, list(levels))
    return saddles_and_pieces


@library.custom_op(
    "igps::merge_trees",
    mutates_args=(),
    schema="(Tensor values, Tensor neighbours, Tensor mask, float[] levels) -> (Tensor, Tensor)",
)
def _operator(
    values: Tensor, neighbours: Tensor, mask: Tensor, levels: list[float]
) -> tuple[Tensor, Tensor]:
    device = values.device
    saddles, pieces = _empty_outputs(values, neighbours, mask, levels)
    saddles = saddles.cpu()
    pieces = pieces.cpu()
    values = values.cpu()
    neighbours = neighbours.cpu()
    mask = mask.cpu()
    own = torch.arange(values.shape[1], device="cpu")
    for i in range(len(values)):
        n = int(mask[i].sum())
        if n == 0:
            raise ValueError("samples: expected at least one of each body, got none.")
        counts = [max(1, round(share * n)) for share in levels]
        tree = merge_tree(values[i], neighbours[i], counts, mask[i])
        saddles[i] = own.scatter(0, tree.peaks, tree.saddles)
        pieces[i] = tree.pieces
    return saddles.to(device), pieces.to(device)


@_operator.register_fake
def _empty_outputs(
    values: Tensor, neighbours: Tensor, mask: Tensor, levels: list[float]
) -> tuple[Tensor, Tensor]:
    n_shapes, n_points = values.shape
    saddles = values.new_empty(n_shapes, n_points, dtype=torch.int64)
    return saddles, saddles.new_empty(n_shapes, len(levels), n_points)


def merge_tree(
    values: Tensor, neighbours: Tensor, counts: Sequence[int] = (), mask: Tensor | None = None
) -> MergeTree:
    """Compute the merge tree of a function on a graph of points. All tensors are on the CPU.

    From the highest value down, each point joins the components of its higher neighbours. Where it joins two
    components, the one with the lower peak ends. The length of a branch, its persistence, is the height of its peak
    above its saddle. Source: Edelsbrunner, Letscher and Zomorodian 2002; on shapes, Skraba, Ovsjanikov, Chazal and
    Guibas 2010.

    Args:
        values: (P,) of the function; points with equal values are ordered by index, as if the first were highest.
        neighbours: (P, k) indices; two points are neighbours if either lists the other.
        counts: (L,) numbers of points in the superlevel sets, 1 to P, ascending.
        mask: (P,) the points that exist; all if None.

    Raises:
        ValueError: a value is not finite.
    """
    points = torch.arange(len(values), device="cpu") if mask is None else mask.nonzero()[:, 0]
    if not torch.isfinite(values[points]).all():
        raise ValueError("values: expected finite numbers, got NaN or infinity.")
    descending = torch.argsort(values[points], descending=True, stable=True)
    order = points[descending].numpy()
    rank = np.full(len(values), -1)
    rank[order] = np.arange(len(order))
    own_rank = rank.repeat(neighbours.shape[1])
    neighbour_rank = rank[neighbours.numpy().ravel()]
    pairs = np.stack([own_rank, neighbour_rank])
    exists = (pairs >= 0).all(axis=0)
    pairs = pairs[:, exists]
    higher = pairs.min(axis=0)
    lower = pairs.max(axis=0)
    by_lower = np.argsort(lower)  # the order of pairs with the same lower point does not matter
    branches = np.empty((len(order), 2), np.int64)
    pieces = np.full((len(counts), len(values)), -1, np.int64)
    n = _merge(
        order,
        higher[by_lower],
        lower[by_lower],
        np.array(counts, np.int64),
        np.arange(len(order)),
        branches,
        pieces,
    )
    return MergeTree(
        torch.from_numpy(branches[:n, 0]),
        torch.from_numpy(branches[:n, 1]),
        torch.from_numpy(pieces),
    )


@compiled()
def _merge(
    order: Integers,
    higher: Integers,
    lower: Integers,
    counts: Integers,
    parent: Integers,
    branches: Integers,
    pieces: Integers,
) -> int:
    """Write the branches and pieces of a merge tree, and return the number of branches.

    The points come in descending order. A pair of neighbours is given by the positions of its higher and its lower
    point in this order; the pairs are sorted by `lower`. At first, each position is its own `parent`. The outputs are
    `branches`, (P, 2) peaks and saddles, and `pieces`, see `MergeTree`, which the caller fills with −1.
    """
    n_branches = level = pair = 0
    for point in range(len(order)):
        while pair < len(lower) and lower[pair] == point:
            a = _root(parent, point)
            b = _root(parent, higher[pair])
            pair += 1
            if a == b:
                continue
            ending = max(a, b)  # the branch with the higher peak continues
            parent[ending] = min(a, b)
            if ending != point:
                branches[n_branches, 0] = order[ending]
                branches[n_branches, 1] = order[point]
                n_branches += 1
        while level < len(counts) and counts[level] == point + 1:
            for k in range(point + 1):
                pieces[level, order[k]] = order[_root(parent, k)]
            level += 1
    for k in range(len(order)):
        if parent[k] == k:
            branches[n_branches, 0] = order[k]
            branches[n_branches, 1] = order[-1]
            n_branches += 1
    return n_branches


@compiled()
def _root(parent: Integers, point: int) -> int:
    """Return the root of a point in a union-find forest, and halve the path to it."""
    while parent[point] != point:
        parent[point] = parent[parent[point]]
        point = parent[point]
    return point

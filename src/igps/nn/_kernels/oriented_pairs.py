"""The histogram of point pair features: how two samples lie to each other and to the surface next to them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps.nn._kernels.counted_pairs import can_count, count_pairs
from igps.nn._kernels.hard_pairs import check_points, class_pairs
from igps.nn._precision import full_precision
from igps.nn.axes.centres import position

# Pairs that are held at once: each of their many numbers fills a part of a core's second-level cache.
_BLOCK = 2**16


def point_pair_features(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cosines that tell how each pair of oriented points lies (Wahl et al. 2003; Drost et al. 2010).

    With u the unit vector from point i to j and n their directions, these are the larger and the smaller of nᵢ·u and
    −nⱼ·u, which are 1 where a direction points to the other point, and nᵢ·nⱼ: they do not depend on which is i.

    Args:
        points: (P, D).
        directions: (P, D) of length 1.

    Returns:
        Three tensors (P(P−1)/2,), pairs in the order of `torch.triu_indices`; of points that coincide the first two
        are 0.
    """
    i, j = torch.triu_indices(len(points), len(points), 1, device=points.device)
    first, second, between = (feature[i, j] for feature in _features(points, directions, 0, len(points)))
    return first, second, between


def _features(points: Tensor, directions: Tensor, first: int, last: int) -> tuple[Tensor, Tensor, Tensor]:
    """(last − first, P − first) features of the pairs of points from `first` to `last` with those from `first` on."""
    rows, row_directions = points[first:last], directions[first:last]
    columns, column_directions = points[first:], directions[first:]
    length = torch.cdist(rows, columns, compute_mode="donot_use_mm_for_euclid_dist")
    inverse = torch.where(length > 0, 1 / torch.where(length > 0, length, 1), 0)
    own_row, own_column = (row_directions * rows).sum(dim=1), (column_directions * columns).sum(dim=1)
    with full_precision():
        towards_column = (torch.addmm(-own_row[:, None], row_directions, columns.T) * inverse).clamp(-1, 1)
        towards_row = (torch.addmm(-own_column, rows, column_directions.T) * inverse).clamp(-1, 1)
        between = row_directions @ column_directions.T
    return torch.maximum(towards_column, towards_row), torch.minimum(towards_column, towards_row), between


def oriented_pair_histogram(
    memberships: Tensor,
    distances: Sequence[tuple[Tensor, Tensor]],
    oriented: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]],
) -> Tensor:
    """Joint histogram of distances and `point_pair_features` of all pairs of points, differentiable in every argument.

    Each unordered pair counts once, in linear proportion in the two bins of each dimension whose centres surround its
    value; values beyond the outer centres count there. Classes count as in `soft_pair_histogram`.

    Args:
        memberships: (P, C) non-negative, rows of sum 1.
        distances: of each dimension the points (P, D), whose Euclidean distances are counted, and the centres (B,).
        oriented: of each three dimensions the points (P, D), their directions (P, D) of length 1, the centres (A,) of
            the first two features and those (A,) of the third.

    Returns:
        (C(C+1)/2, B, ..., A, A, A, ...) in the type of the first points, float32 at least, of sum 1.

    Raises:
        ValueError: fewer than two points, shapes that do not match, or values that are not finite.
    """
    _check(memberships, distances, oriented)
    dtype = torch.promote_types(oriented[0][0].dtype, torch.float32)
    if can_count(memberships, *(tensor for axis in (*distances, *oriented) for tensor in axis)):
        return count_pairs(memberships, distances, oriented).to(dtype)
    memberships = memberships.to(dtype)
    distances = [(points.to(dtype), centres) for points, centres in distances]
    oriented = [(p.to(dtype), n.to(dtype), towards, between) for p, n, towards, between in oriented]
    shape = [len(centres) for _, centres in distances]
    for _, _, towards, between in oriented:
        shape += [len(towards), len(towards), len(between)]
    n_points, n_classes = memberships.shape
    n_rows = max(1, _BLOCK // n_points)
    pairs = class_pairs(n_classes)
    sums = torch.zeros(len(pairs), 2 ** len(shape), math.prod(shape), dtype=torch.float64, device=memberships.device)
    with torch.autocast(memberships.device.type, enabled=False):
        for first in range(0, n_points - 1, n_rows):
            rows = (first, first + n_rows)
            # What the gradient needs of the pairs is many times what it needs of the points: computed again.
            sums = sums + checkpoint(_sums, memberships, distances, oriented, *rows, use_reentrant=False)
    counts = sums.view(len(pairs), *(2,) * len(shape), *shape)
    for _ in shape:
        own, beyond = counts.unbind(1)
        # Beyond the last cell there is nothing to give, so that nothing is rolled over the end.
        counts = own + beyond.roll(1, dims=len(shape))
    return (counts / (n_points * (n_points - 1) / 2)).to(dtype)


def _sums(
    memberships: Tensor,
    distances: Sequence[tuple[Tensor, Tensor]],
    oriented: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]],
    first: int,
    last: int,
) -> Tensor:
    """(rows, 2^axes, cells) weights of the pairs of points from `first` to `last` with those after them.

    By the cell of the lower centres, and by which of the cells next to it, along the axes, the weight is of.
    """
    with full_precision():
        axes = [(torch.cdist(points[first:last], points[first:]), centres) for points, centres in distances]
    for points, directions, towards, between in oriented:
        features = _features(points, directions, first, last)
        axes += zip(features, (towards, towards, between), strict=True)
    cell = torch.zeros_like(axes[0][0], dtype=torch.long)
    shares = []
    for values, centres in axes:
        along = position(values, centres)
        before = along.detach().long().clamp_(max=len(centres) - 2)
        shares.append(along - before)
        cell = cell.mul_(len(centres)).add_(before)
    cell = cell.flatten()
    none = torch.zeros(math.prod(len(centres) for _, centres in axes), dtype=torch.float64, device=cell.device)
    rows, columns = memberships[first:last], memberships[first:]
    sums = []
    for a, b in class_pairs(memberships.shape[1]):
        weight = rows[:, a, None] * columns[:, b]
        if a != b:
            weight = weight + rows[:, b, None] * columns[:, a]
        # Pairs of a point with itself or with one before it weigh nothing.
        weights = [weight.triu(1)]
        for share in shares:
            halves = ((weight, weight * share) for weight in weights)
            # Not weight·(1 − share), nor a difference of sums, which rounding could make negative.
            weights = [part for whole, beyond in halves for part in (whole - beyond, beyond)]
        sums += [none.index_add(0, cell, part.double().flatten()) for part in weights]
    return torch.stack(sums).unflatten(0, (-1, 2 ** len(axes)))


def _check(
    memberships: Tensor,
    distances: Sequence[tuple[Tensor, Tensor]],
    oriented: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]],
) -> None:
    if not oriented:
        raise ValueError("oriented: expected at least one set of points and directions, got none.")
    for points, directions, *_ in oriented:
        if points.shape != directions.shape:
            raise ValueError(
                f"directions: expected the shape of the points, {tuple(points.shape)}, got {tuple(directions.shape)}."
            )
        check_points(directions)
    for points, *_ in (*distances, *oriented):
        check_points(points)
        if len(points) != len(memberships):
            raise ValueError(f"memberships: expected one row for each of {len(points)} points, got {len(memberships)}.")

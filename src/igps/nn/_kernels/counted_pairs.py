"""Histograms of pairs by compiled loops: in one pass for all axes, without gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from igps._compiled import is_available
from igps._threads import Team
from igps.nn._kernels.pair_loops import add_pairs
from igps.nn._precision import full_precision

# Values of all axes that are held at once: they stay in a core's second-level cache.
_BLOCK = 2**18
_MOST_COLUMNS = 2048
# Of the blocks, which threads count side by side; one where counts of its own for each share would take gigabytes
_SHARES, _MOST_COUNTS = 4, 2**24
_TYPES = (torch.float32, torch.float64)


def can_count(*tensors: Tensor) -> bool:
    """Whether `count_pairs` serves these: loops can be compiled, all is on the CPU, and no gradient is asked for."""
    return (
        is_available()
        and all(tensor.device.type == "cpu" and tensor.dtype in _TYPES for tensor in tensors)
        and not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors))
    )


def count_pairs(
    memberships: Tensor,
    distances: Sequence[tuple[Tensor, Tensor]],
    oriented: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]] = (),
) -> Tensor:
    """`oriented_pair_histogram`, or `soft_pair_histogram` where nothing is oriented, of arguments that were checked.

    Args:
        memberships: (P, C).
        distances: of each dimension the points (P, D) and the centres (B,), two at least.
        oriented: of each three dimensions the points (P, D), their directions, and the centres of the features.

    Returns:
        (C(C+1)/2, B, ..., A, A, A, ...) float64 of sum 1.

    Raises:
        ValueError: a single centre, or points so far out that their distances cannot be told.
    """
    dtype = torch.promote_types((distances[0] if distances else oriented[0])[0].dtype, torch.float32)
    layout = [centres for _, centres in distances]
    for *_, towards, between in oriented:
        layout += [towards, towards, between]
    shape = [len(centres) for centres in layout]
    if min(shape) < 2:
        raise ValueError(f"centres: expected at least two along each dimension, got {shape}.")
    centres = torch.zeros(len(layout), max(shape), dtype=dtype)
    for k, along in enumerate(layout):
        centres[k, : len(along)] = along.detach()
    order, classes, weights = _members(memberships.detach())
    located = [_centred(points.detach().index_select(0, order).to(dtype)) for points, _ in distances]
    norms = torch.stack([points.square().sum(dim=1) for points in located]) if located else torch.zeros(0, 0).to(dtype)
    if not bool((norms < torch.finfo(dtype).max / 8).all()):
        raise ValueError("points: expected distances that can be squared, got larger ones; choose a larger unit.")
    n_dimensions = [points.shape[1] for points, *_ in oriented]
    turned = torch.zeros(len(oriented), 2, max(n_dimensions, default=0), len(order), dtype=dtype)
    for into, (points, directions, *_) in zip(turned, oriented, strict=True):
        into[0, : points.shape[1]], into[1, : points.shape[1]] = points[order].T, directions[order].T
    n_points, n_classes = memberships.shape
    of_axes = norms.numpy(), turned.numpy(), np.array(n_dimensions, np.int64), centres.numpy(), np.array(shape)
    of_points = classes.numpy(), weights.numpy()
    n_columns = min(n_points, _MOST_COLUMNS)
    n_rows = min(max(1, _BLOCK // (n_columns * max(1, len(located)))), n_columns)
    counts_shape = n_classes * (n_classes + 1) // 2, math.prod(shape) * 2 ** len(shape)
    blocks = [(row, column) for row in range(0, n_points, n_rows) for column in range(row, n_points, n_columns)]

    def counted(blocks: Sequence[tuple[int, int]]) -> Tensor:
        total = torch.zeros(counts_shape, dtype=torch.float64)
        room, counts = torch.empty(len(located) * n_rows * n_columns, dtype=dtype), total.numpy()
        with torch.autocast("cpu", enabled=False):
            for row, column in blocks:
                n_kept = (min(n_rows, n_points - row), min(n_columns, n_points - column))
                products = room[: len(located) * math.prod(n_kept)].view(-1, *n_kept)
                for points, product in zip(located, products, strict=True):
                    torch.mm(points[row : row + n_rows], points[column : column + n_columns].T, out=product)
                add_pairs(products.numpy(), *of_axes, row, column, *of_points, counts)
        return total

    # Each share has counts of its own, added in order: how many threads there are changes no bit.
    n_shares = min(_SHARES, len(blocks)) if math.prod(counts_shape) <= _MOST_COUNTS else 1
    with full_precision(), Team() as team:
        total, *others = team.each(counted, [blocks[k::n_shares] for k in range(n_shares)])
    for other in others:
        total += other
    return _folded(total, shape) / (n_points * (n_points - 1) / 2)


def _members(memberships: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(P,) an order that has points of the same classes side by side; these classes (M, P), and the weights."""
    n_members = max(1, int((memberships > 0).sum(dim=1).max()))
    if n_members == 1:
        weights, classes = memberships.double().max(dim=1, keepdim=True)
    else:
        weights, classes = memberships.double().topk(n_members, dim=1)
    leading = torch.where(weights > 0, classes, 0)
    key = torch.zeros(len(leading), dtype=torch.int64)
    for column in leading.T:
        key = key * memberships.shape[1] + column
    order = torch.argsort(key, stable=True)
    return order, classes[order].int().T.contiguous(), weights[order].T.contiguous()


def _centred(points: Tensor) -> Tensor:
    # Coordinates that padding left at 0 would only change how products are rounded. The centre keeps digits in the
    # squared distances.
    mean = points.mean(dim=0)
    if not bool(mean.all()):  # a column of zeros among them, perhaps
        points = points[:, (points != 0).any(dim=0)]
        mean = points.mean(dim=0)
    return points - mean


def _folded(total: Tensor, shape: Sequence[int]) -> Tensor:
    """(rows, B, ...) counts from (rows, cells·2^K), by the cell below and the corner of it."""
    counts = total.view(-1, *shape, *(2,) * len(shape))
    for axis in range(len(shape)):
        own, beyond = counts.unbind(1 + len(shape))
        # Beyond the last cell there is nothing to give, so that nothing is rolled over the end.
        counts = own + beyond.roll(1, dims=1 + axis)
    return counts

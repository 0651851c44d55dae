"""The count of pairs in operations of PyTorch, block by block: for any device, and for tracing."""

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps.nn._kernels.blocks import BLOCK as _BLOCK
from igps.nn._kernels.intervals import find_intervals
from igps.nn._kernels.pair_values import PairValues, centres_of, with_tensors
from igps.nn._precision import full_precision
from igps.retrieval.distances import in_transforms


def count_by_torch(
    classes: Tensor,
    n_classes: int,
    pairs: Sequence[PairValues],
    mask: Tensor,
    weights: Tensor,
    *tensors: Tensor,
) -> Tensor:
    """Return float64 counts (N, C(C+1)/2, B, ...), see `count_pairs`."""
    # Padding may hold infinity, and 0 times infinity is NaN.
    clean = [
        t.masked_fill(~mask.view(*mask.shape, *[1] * (t.ndim - 2)), 0) if t.ndim > 1 else t
        for t in tensors
    ]
    weights = weights.masked_fill(~mask[:, :, None], 0)
    n_shapes, n_points, n_members = classes.shape
    bins = [len(centres) for centres in centres_of(pairs)]
    n_cells = n_classes * math.prod(bins)
    total = torch.zeros(n_shapes, n_classes, n_cells, dtype=torch.float64, device=classes.device)
    n_rows = n_points
    firsts = range(1)
    # A program for any number of shapes or points has one block, as a number of blocks would be fixed by tracing.
    if not any(isinstance(n, torch.SymInt) for n in (n_shapes, n_points)):
        n_rows = max(1, _BLOCK // (n_shapes * max(n_cells, n_points * n_members * 2 ** len(bins))))
        firsts = range(0, n_points - 1, n_rows)
    for first in firsts:
        task = partial(_count_rows, first, first + n_rows, classes, n_classes, pairs)
        # The gradient computes the values of pairs again, as storing them takes much more memory than the points.
        if torch.is_grad_enabled() and not in_transforms():
            total = total + checkpoint(task, weights, *clean, use_reentrant=False)
        else:
            total = total + task(weights, *clean)
    total = total.view(n_shapes, n_classes, n_classes, *bins)
    total = total + total.transpose(1, 2)
    a, b = torch.triu_indices(n_classes, n_classes, device=classes.device)
    return total[:, a, b] * torch.where(a == b, 0.5, 1.0).view(-1, *[1] * len(bins))


def _count_rows(
    first: int,
    end: int,
    classes: Tensor,
    n_classes: int,
    pairs: Sequence[PairValues],
    weights: Tensor,
    *others: Tensor,
) -> Tensor:
    """Return counts (N, C, C·cells), by both classes, of pairs of the points [first, end) with later points."""
    pairs = with_tensors(pairs, others)
    bins = [len(centres) for centres in centres_of(pairs)]
    with full_precision():
        values = [
            p.between([x[:, first:end] for x in p.inputs], [x[:, first:] for x in p.inputs])
            for p in pairs
        ]
    # Each row is first counted separately, by the class of the column's point only, as this adds fewer numbers, and few
    # to the same cell. Indices and weights are (N, I, J, M), finally (N, I, J, M·2^K), for the corners of each cell.
    index = classes[:, None, first:]
    # Pairs of a point with itself or with an earlier point have weight 0.
    weight = weights[:, None, first:] * torch.ones_like(values[0][0, 0]).triu(1).unsqueeze(2)
    shares = []
    for value, centres in zip(torch.cat(values, dim=1).unbind(1), centres_of(pairs), strict=True):
        below, share = find_intervals(value, centres)
        shares.append(share)
        index = index * len(centres) + below.unsqueeze(3)
    stride = math.prod(bins)
    for share, n_bins in zip(shares, bins, strict=True):
        stride //= n_bins
        upper = weight * share.unsqueeze(3)
        # Not weight·(1 − share), nor a difference of sums, as rounding could make them negative.
        weight = torch.cat([weight - upper, upper], dim=3)
        index = torch.cat([index, index + stride], dim=3)
    own = weights[:, first:end].double()
    n_cells = n_classes * math.prod(bins)
    rows = own.new_zeros(*own.shape[:2], n_cells).scatter_add(
        2, index.flatten(2), weight.double().flatten(2)
    )
    memberships = own.new_zeros(*own.shape[:2], n_classes).scatter_add(
        2, classes[:, first:end], own
    )
    return memberships.mT @ rows

"""The count of pairs in operations of PyTorch, a block of pairs at a time: for any device, and where it is traced."""

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps.nn._kernels.blocks import BLOCK as _BLOCK
from igps.nn._kernels.located import located
from igps.nn._kernels.pair_values import PairValues, centres_of, with_tensors
from igps.nn._precision import full_precision
from igps.retrieval.distances import in_transforms

# Shapes side by side have so many points at least, as a share of the most: each pays for as many as the largest
_ALIKE = 0.8


def count_by_torch(
    classes: Tensor, n_classes: int, pairs: Sequence[PairValues], mask: Tensor, weights: Tensor, *tensors: Tensor
) -> Tensor:
    """(N, C(C+1)/2, B, ...) float64 counts."""
    # Padding may hold anything, and 0 times infinity is NaN
    clean = [t.masked_fill(~mask.view(*mask.shape, *[1] * (t.ndim - 2)), 0) if t.ndim > 1 else t for t in tensors]
    weights = weights.masked_fill(~mask[:, :, None], 0)
    if torch.compiler.is_compiling():  # what is traced cannot look at numbers
        return _count_together(classes, n_classes, pairs, weights, *clean)
    ends = (mask * torch.arange(1, mask.shape[1] + 1, device=mask.device)).amax(dim=1)
    ends, order = ends.sort(descending=True)
    sizes, counts, first = ends.tolist(), [], 0
    while first < len(sizes):
        last = first + sum(size >= _ALIKE * sizes[first] for size in sizes[first:])
        shapes = order[first:last]
        own = (t[shapes, : sizes[first]] if t.ndim > 1 else t for t in (classes, weights, *clean))
        counts.append(_count_together(next(own), n_classes, pairs, *own))
        first = last
    return torch.cat(counts)[order.argsort()]


def _count_together(
    classes: Tensor, n_classes: int, pairs: Sequence[PairValues], weights: Tensor, *tensors: Tensor
) -> Tensor:
    """(N, C(C+1)/2, B, ...) counts of shapes side by side, whose padding weighs nothing."""
    n_shapes, n_points, n_members = classes.shape
    bins = [len(centres) for centres in centres_of(pairs)]
    n_cells = n_classes * math.prod(bins)
    total = torch.zeros(n_shapes, n_classes, n_cells, dtype=torch.float64, device=classes.device)
    n_rows, firsts = n_points, range(1)
    # A program for any number of shapes or points has one block: how many there are would be written into it.
    if not any(isinstance(n, torch.SymInt) for n in (n_shapes, n_points)):
        n_rows = max(1, _BLOCK // (n_shapes * max(n_cells, n_points * n_members * 2 ** len(bins))))
        firsts = range(0, n_points - 1, n_rows)
    for first in firsts:
        task = partial(_count_rows, first, first + n_rows, classes, n_classes, bins, pairs)
        # What the gradient needs of the pairs is many times what it needs of the points: computed again.
        differentiable = torch.is_grad_enabled() and not in_transforms()
        total = total + (
            checkpoint(task, weights, *tensors, use_reentrant=False) if differentiable else task(weights, *tensors)
        )
    total = total.view(n_shapes, n_classes, n_classes, *bins)
    total = total + total.transpose(1, 2)
    a, b = torch.triu_indices(n_classes, n_classes, device=classes.device)
    return total[:, a, b] * torch.where(a == b, 0.5, 1.0).view(-1, *[1] * len(bins))


def _count_rows(
    first: int,
    last: int,
    classes: Tensor,
    n_classes: int,
    bins: Sequence[int],
    pairs: Sequence[PairValues],
    weights: Tensor,
    *tensors: Tensor,
) -> Tensor:
    """(N, C, C·cells) counts of the pairs of points from `first` to `last` with those after them, by both classes."""
    pairs = with_tensors(pairs, tensors)
    with full_precision():
        values = [
            one.between([x[:, first:last] for x in one.inputs], [x[:, first:] for x in one.inputs]) for one in pairs
        ]
    # Each row is counted for itself, by the classes of the other ends alone: so there are fewer numbers to add, and
    # few of them into the same cell. (N, I, J, M) where a pair counts and how much, then (N, I, J, M·2^K), in each
    # corner of its cell.
    into = classes[:, None, first:]
    # Pairs of a point with itself or with one before it weigh nothing.
    weight = weights[:, None, first:] * torch.ones_like(values[0][0, 0]).triu(1).unsqueeze(2)
    shares = []
    for value, centres in zip(torch.cat(values, dim=1).unbind(1), centres_of(pairs), strict=True):
        below, share = located(value, centres)
        shares.append(share)
        into = into * len(centres) + below.unsqueeze(3)
    stride = math.prod(bins)
    for share, n_bins in zip(shares, bins, strict=True):
        stride //= n_bins
        beyond = weight * share.unsqueeze(3)
        # Not weight·(1 − share), nor a difference of sums, which rounding could make negative.
        weight = torch.cat([weight - beyond, beyond], dim=3)
        into = torch.cat([into, into + stride], dim=3)
    own, classes = weights[:, first:last].double(), classes[:, first:last]
    n_shapes, n_rows, _ = own.shape
    n_cells = n_classes * math.prod(bins)
    rows = torch.zeros(n_shapes, n_rows, n_cells, dtype=torch.float64, device=own.device)
    rows = rows.scatter_add(2, into.flatten(2), weight.double().flatten(2))
    memberships = torch.zeros(n_shapes, n_rows, n_classes, dtype=torch.float64, device=own.device)
    return memberships.scatter_add(2, classes, own).mT @ rows

"""The count of pairs in operations of PyTorch, a block of pairs at a time: for any device, and where it is traced."""

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps.nn._kernels.located import located
from igps.nn._kernels.pair_values import PairValues, centres_of, with_tensors
from igps.nn._precision import full_precision

# Numbers of a block, which fill a device
_BLOCK = 2**25


def count_by_torch(
    classes: Tensor, n_classes: int, pairs: Sequence[PairValues], mask: Tensor, weights: Tensor, *tensors: Tensor
) -> Tensor:
    """(N, C(C+1)/2, B, ...) float64 counts."""
    n_shapes, n_points, n_members = classes.shape
    # What is padded may be anything, and 0 times that no number.
    clean = [t.masked_fill(~mask.view(*mask.shape, *[1] * (t.ndim - 2)), 0) if t.ndim > 1 else t for t in tensors]
    weights = weights.masked_fill(~mask[:, :, None], 0)
    bins = [len(centres) for centres in centres_of(pairs)]
    n_cells = n_classes * math.prod(bins)
    total = torch.zeros(n_shapes, n_classes, n_cells, dtype=torch.float64, device=classes.device)
    n_rows = max(1, _BLOCK // (n_shapes * max(n_cells, n_points * n_members * 2 ** len(bins))))
    for first in range(0, n_points - 1, n_rows):
        task = partial(_count_rows, first, first + n_rows, classes, n_classes, bins, pairs)
        # What the gradient needs of the pairs is many times what it needs of the points: computed again.
        differentiable = torch.is_grad_enabled()
        total = total + (
            checkpoint(task, weights, *clean, use_reentrant=False) if differentiable else task(weights, *clean)
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

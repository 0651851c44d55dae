"""The count of pairs in operations of PyTorch, a block of pairs at a time: for any device, and where it is traced."""

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps.nn._kernels.pair_values import PairValues, centres_of, with_tensors
from igps.nn._precision import full_precision

# Numbers of a block, which fill a device
_BLOCK = 2**24


def count_by_torch(
    classes: Tensor, n_classes: int, pairs: Sequence[PairValues], mask: Tensor, weights: Tensor, *tensors: Tensor
) -> Tensor:
    """(N, C(C+1)/2, B, ...) float64 counts."""
    n_shapes, n_points, n_members = classes.shape
    # What is padded may be anything, and 0 times that no number.
    clean = [t.masked_fill(~mask.view(*mask.shape, *[1] * (t.ndim - 2)), 0) if t.ndim > 1 else t for t in tensors]
    weights = weights.masked_fill(~mask[:, :, None], 0)
    shape = [n_classes * (n_classes + 1) // 2, *(len(centres) for centres in centres_of(pairs))]
    total = torch.zeros(n_shapes * math.prod(shape), dtype=torch.float64, device=classes.device)
    n_rows = max(1, _BLOCK // (n_shapes * n_points * n_members**2 * 2 ** (len(shape) - 1)))
    for first in range(0, n_points - 1, n_rows):
        task = partial(_count_rows, first, first + n_rows, classes, n_classes, shape, pairs)
        # What the gradient needs of the pairs is many times what it needs of the points: computed again.
        differentiable = torch.is_grad_enabled()
        total = total + (
            checkpoint(task, weights, *clean, use_reentrant=False) if differentiable else task(weights, *clean)
        )
    return total.view(n_shapes, *shape)


def _count_rows(
    first: int,
    last: int,
    classes: Tensor,
    n_classes: int,
    shape: Sequence[int],
    pairs: Sequence[PairValues],
    weights: Tensor,
    *tensors: Tensor,
) -> Tensor:
    """(cells,) counts of the pairs of points from `first` to `last` with those after them."""
    pairs = with_tensors(pairs, tensors)
    with full_precision():
        values = [
            one.between([x[:, first:last] for x in one.inputs], [x[:, first:] for x in one.inputs]) for one in pairs
        ]
    row_of = torch.zeros(n_classes, n_classes, dtype=torch.long, device=classes.device)
    a, b = torch.triu_indices(n_classes, n_classes, device=classes.device)
    row_of[a, b] = row_of[b, a] = torch.arange(len(a), device=classes.device)
    # (N, I, J, M²) where each pair counts and how much, and then (N, I, J, M²·2^K) in each corner of its cell.
    into = row_of[classes[:, first:last, None, :, None], classes[:, None, first:, None, :]].flatten(3)
    into = into + shape[0] * torch.arange(len(classes), device=classes.device)[:, None, None, None]
    weight = (weights[:, first:last, None, :, None] * weights[:, None, first:, None, :]).flatten(3)
    # Pairs of a point with itself or with one before it weigh nothing.
    weight = weight * torch.ones_like(weight[0, :, :, 0]).triu(1).unsqueeze(2)
    shares = []
    for value, centres in zip(torch.cat(values, dim=1).unbind(1), centres_of(pairs), strict=True):
        below = torch.bucketize(value.detach().contiguous(), centres.detach()[1:-1], right=True)
        shares.append(((value - centres[below]) / (centres[below + 1] - centres[below])).clamp(0, 1))
        into = into * len(centres) + below.unsqueeze(3)
    stride = math.prod(shape[1:])
    for share, n_bins in zip(shares, shape[1:], strict=True):
        stride //= n_bins
        beyond = weight * share.unsqueeze(3)
        # Not weight·(1 − share), nor a difference of sums, which rounding could make negative.
        weight = torch.cat([weight - beyond, beyond], dim=3)
        into = torch.cat([into, into + stride], dim=3)
    total = torch.zeros(len(classes) * math.prod(shape), dtype=torch.float64, device=classes.device)
    return total.index_add(0, into.flatten(), weight.double().flatten())

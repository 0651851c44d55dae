"""Where values lie between the centres of bins or classes."""

import torch
from torch import Tensor


def located(values: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """The interval that each of values (..., P) falls into, and how far along it is, from 0 to 1; of centres (B,).

    The first and the last of the B − 1 intervals hold what lies beyond, at 0 and 1. The second is differentiable in
    both arguments.
    """
    # A copy of the boundaries: up to PyTorch 2.11 code compiled for a GPU passes over where a view of them begins.
    below = torch.bucketize(values.detach().contiguous(), centres.detach()[1:-1].clone(), right=True)
    # Not centres[below]: on a GPU its gradient adds what goes to the same centre one after the other.
    rows = torch.atleast_2d(below).flatten(0, -2)
    start, end = (centres.expand(rows.shape[0], -1).gather(1, one).view_as(values) for one in (rows, rows + 1))
    return below, ((values - start) / (end - start)).clamp(0, 1)

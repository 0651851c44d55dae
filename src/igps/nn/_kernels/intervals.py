"""Intervals between the centres of bins or classes."""

import torch
from torch import Tensor


def find_intervals(values: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Return the interval of centres (B,) that contains each value of (..., P), and its position there from 0 to 1.

    Values beyond the outer centres are in the first or last of the B − 1 intervals, at position 0 or 1. The position is
    differentiable in both arguments.
    """
    # A copy of the boundaries, as up to PyTorch 2.11 code compiled for a GPU ignores the offset of a view.
    below = torch.bucketize(
        values.detach().contiguous(), centres.detach()[1:-1].clone(), right=True
    )
    # Not centres[below], whose gradient on a GPU adds all contributions to a centre sequentially.
    rows = torch.atleast_2d(below).flatten(0, -2)
    start, end = (
        centres.expand(rows.shape[0], -1).gather(1, i).view_as(values) for i in (rows, rows + 1)
    )
    return below, ((values - start) / (end - start)).clamp(0, 1)

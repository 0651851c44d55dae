"""Small functions of tensors that several subpackages need."""

import torch
from torch import Tensor


def above_zero(values: Tensor) -> Tensor:
    """Return values ≥ 0 with the smallest positive number in place of 0, to divide by or to take logarithms of."""
    return values.clamp_min(torch.finfo(values.dtype).tiny)


def with_axes_of(values: Tensor, other: Tensor) -> Tensor:
    """Return values (N, ...) with further axes of size 1 behind, so that they have as many as another tensor."""
    return values.view(*values.shape, *[1] * (other.ndim - values.ndim))

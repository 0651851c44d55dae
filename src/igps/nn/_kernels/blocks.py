"""Where compiled loops work on tensors, and how many bodies are computed at once."""

from collections.abc import Callable

import torch
from torch import Tensor

from igps.retrieval.distances import in_transforms

BLOCK = 2**25
"""Numbers of a block, which fill a device."""


def in_loops(device: torch.device) -> bool:
    """Whether compiled loops work on tensors of a device; where not, operations of PyTorch do, which can be traced."""
    return device.type == "cpu" and not torch.compiler.is_compiling() and not in_transforms()


def of_bodies(function: Callable[..., Tensor], points: Tensor, others: Tensor, *more: Tensor) -> Tensor:
    """What a function of tensors of bodies, (N, P, ...), (N, T, ...) and more, makes of all; it looks at P·T pairs.

    On the CPU one body comes after the other, as their pairs then stay in its cache; elsewhere as many as fill a
    device; traced, all.
    """
    given = (points, others, *more)
    if torch.compiler.is_compiling():
        return function(*given)
    n_bodies = 1 if in_loops(points.device) else max(1, BLOCK // (points.shape[1] * others.shape[1] or 1))
    return torch.cat([function(*some) for some in zip(*(one.split(n_bodies) for one in given), strict=True)])

"""The choice between compiled loops and operations of PyTorch, and the number of bodies computed at once."""

from collections.abc import Callable

import torch
from torch import Tensor

from igps.retrieval.distances import in_transforms

BLOCK = 2**25
"""Number of entries in a block; enough to keep a GPU busy."""


def uses_loops(device: torch.device) -> bool:
    """Whether tensors of a device are processed by compiled loops; otherwise operations of PyTorch are used."""
    return device.type == "cpu" and not torch.compiler.is_compiling() and not in_transforms()


def map_bodies(function: Callable[..., Tensor], points: Tensor, others: Tensor, *more: Tensor) -> Tensor:
    """Apply a function to tensors of N bodies, (N, P, ...), (N, T, ...) and more, in batches of bodies.

    The function takes memory for P·T pairs of each body. On the CPU a batch is one body, whose pairs then stay in the
    cache; on other devices a batch has up to `BLOCK` pairs. Traced code processes all bodies at once.
    """
    tensors = (points, others, *more)
    if torch.compiler.is_compiling():
        return function(*tensors)
    n_bodies = 1 if uses_loops(points.device) else max(1, BLOCK // (points.shape[1] * others.shape[1] or 1))
    return torch.cat([function(*batch) for batch in zip(*(x.split(n_bodies) for x in tensors), strict=True)])

"""What chooses some of a batch or a dataset."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Indices = slice | Sequence[int] | Sequence[bool] | Sequence[str] | Tensor | NDArray[Any]
"""Some of a batch or dataset: a slice, numbers, a mask, and of a dataset names."""


def scalar_index(index: Any) -> Any:
    """The number in an array without dimensions, as permutations give them one by one; any other index as it is."""
    return operator.index(index) if isinstance(index, Tensor | np.ndarray) and index.ndim == 0 else index


def resolve_indices(index: Indices, n: int) -> list[int]:
    """The numbers that a slice, numbers, or a mask choose among n; an IndexError where they do not fit."""
    if isinstance(index, slice):
        return list(range(n))[index]
    given = index.cpu() if isinstance(index, Tensor) else torch.as_tensor(np.asarray(index), device="cpu")
    if given.dtype == torch.bool and given.shape != (n,):
        raise IndexError(f"mask: expected {n} entries, got an array of shape {tuple(given.shape)}.")
    found: list[int] = torch.arange(n, device="cpu")[given if given.numel() else given.long()].tolist()
    return found

"""Indices of batches and datasets."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Indices = slice | Sequence[int] | Sequence[bool] | Sequence[str] | Tensor | NDArray[Any]
"""Index of several items: a slice, integers, or a mask, and for datasets also names."""


def scalar_index(index: Any) -> Any:
    """Convert an array without dimensions, such as an element of a permutation, to an integer; return others as is."""
    if isinstance(index, Tensor | np.ndarray) and index.ndim == 0:
        return operator.index(index)
    return index


def resolve_indices(index: Indices, n: int) -> list[int]:
    """Return the indices of n items that a slice, integers, or a mask select; raise an IndexError if out of range."""
    if isinstance(index, slice):
        return list(range(n))[index]
    if isinstance(index, Tensor):
        index = index.cpu().numpy()
    array = torch.as_tensor(np.asarray(index), device="cpu")
    if array.dtype == torch.bool and array.shape != (n,):
        raise IndexError(f"mask: expected {n} entries, got an array of shape {tuple(array.shape)}.")
    if not array.numel():
        return []
    indices: list[int] = torch.arange(n, device="cpu")[array].tolist()
    return indices

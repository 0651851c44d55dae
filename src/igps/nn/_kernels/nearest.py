"""The smallest entries of each row, for the few nearest of many points."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps._arrays import Integers, Real
from igps._compiled import compiled
from igps.nn._kernels import blocks


def smallest(values: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """The n smallest entries of each row of (..., P, T), the smallest first: (..., P, n) values and their columns.

    No gradient flows through them. The columns of infinite entries say nothing.
    """
    values = values.detach()
    if not blocks.in_loops(values.device):
        found = values.topk(n, dim=-1, largest=False)
        return found.values, found.indices
    # PyTorch copies and partly sorts each row, which takes some times as long as to keep the few smallest of it.
    rows = values.contiguous().numpy().reshape(-1, values.shape[-1])
    kept, columns = np.full((len(rows), n), np.inf, rows.dtype), np.zeros((len(rows), n), np.int64)
    if n:
        keep_smallest(rows, kept, columns)
    shape = (*values.shape[:-1], n)
    return torch.from_numpy(kept.reshape(shape)), torch.from_numpy(columns.reshape(shape))


@compiled()
def keep_smallest(values: NDArray[Real], kept: NDArray[Real], columns: Integers) -> None:
    """Write the smallest entries of each row of (P, T) in order to (P, n), which holds infinity, and their columns."""
    last = kept.shape[1] - 1
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            if value < kept[i, last]:
                k = last
                while k > 0 and kept[i, k - 1] > value:
                    kept[i, k], columns[i, k] = kept[i, k - 1], columns[i, k - 1]
                    k -= 1
                kept[i, k], columns[i, k] = value, j

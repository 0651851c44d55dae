"""The smallest entries of each row of a matrix, as for nearest neighbours."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps._arrays import Integers, Real
from igps._compiled import compiled
from igps.nn._kernels import blocks


def smallest(values: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Return the n smallest entries (..., P, n) of each row of (..., P, T), in ascending order, and their columns.

    There is no gradient. The columns of infinite entries are undefined.
    """
    values = values.detach()
    if not blocks.uses_loops(values.device):
        top = values.topk(n, dim=-1, largest=False)
        return top.values, top.indices
    # Faster than PyTorch, which copies and partly sorts each row.
    rows = values.contiguous().numpy().reshape(-1, values.shape[-1])
    entries = np.full((len(rows), n), np.inf, rows.dtype)
    columns = np.zeros((len(rows), n), np.int64)
    if n:
        keep_smallest(rows, entries, columns)
    shape = (*values.shape[:-1], n)
    return torch.from_numpy(entries.reshape(shape)), torch.from_numpy(columns.reshape(shape))


@compiled()
def keep_smallest(values: NDArray[Real], entries: NDArray[Real], columns: Integers) -> None:
    """Write the smallest entries of each row of (P, T) and their columns to (P, n); `entries` starts as infinity."""
    last = entries.shape[1] - 1
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            if value < entries[i, last]:
                k = last
                while k > 0 and entries[i, k - 1] > value:
                    entries[i, k], columns[i, k] = entries[i, k - 1], columns[i, k - 1]
                    k -= 1
                entries[i, k] = value
                columns[i, k] = j

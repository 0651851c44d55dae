"""Reusable shared memory, in which worker processes of a DataLoader pass batches to the main process.

New shared memory takes several times as long as copying a batch into it, because the system has to find and clear its
pages. Therefore, a worker reuses a block as soon as no tensor in either process refers to it.
"""

import math
import mmap
import os
import weakref
from collections.abc import Sequence
from multiprocessing.reduction import DupFd, ForkingPickler
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import get_worker_info

from igps.data.batch import SignatureBatch

# Alignment of arrays in bytes, and size of the header of a block: its first byte is 1 while the consumer uses the block
_ALIGNMENT = 64
_MAX_FREE_BLOCKS = 4  # larger numbers of free blocks in a worker are closed


class _Block:
    """Shared memory of a worker process for one batch at a time."""

    def __init__(self, n_bytes: int) -> None:
        self.handle = os.memfd_create("igps-batch")
        os.ftruncate(self.handle, _ALIGNMENT + n_bytes)
        self.memory = mmap.mmap(self.handle, _ALIGNMENT + n_bytes)
        self.start = self.lend().ctypes.data
        self.n_bytes = n_bytes

    def lend(self) -> NDArray[np.uint8]:
        array = np.frombuffer(self.memory, np.uint8, offset=_ALIGNMENT)
        self._lent = weakref.ref(array)
        return array

    @property
    def is_free(self) -> bool:
        # In this order, because a batch is marked as sent before its last reference in this process is dropped
        return self._lent() is None and not self.memory[0]

    def close(self) -> None:
        self.memory.close()
        os.close(self.handle)


_blocks: list[_Block] = []


def empty_arrays(
    shapes: Sequence[tuple[int, ...]], dtypes: Sequence[np.dtype[Any]]
) -> list[NDArray[Any]]:
    """Return empty arrays. In a worker process on Linux, they lie in one shared block."""
    if get_worker_info() is None or not hasattr(os, "memfd_create"):
        # NumPy requests huge pages, which the system provides many times faster
        return [np.empty(shape, dtype) for shape, dtype in zip(shapes, dtypes, strict=True)]
    sizes = [math.prod(shape) * dtype.itemsize for shape, dtype in zip(shapes, dtypes, strict=True)]
    *starts, end = np.cumsum([0, *(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)]).tolist()
    memory = _free_block(end).lend()
    return [
        memory[start : start + size].view(dtype).reshape(shape)
        for start, size, shape, dtype in zip(starts, sizes, shapes, dtypes, strict=True)
    ]


def _free_block(min_bytes: int) -> _Block:
    """Return a free block, reused or new, and close free blocks that are too small or too many."""
    free = sorted(
        (block for block in _blocks if block.is_free), key=lambda block: block.n_bytes, reverse=True
    )
    has_fitting = bool(free) and free[0].n_bytes >= min_bytes
    for block in free[_MAX_FREE_BLOCKS:] if has_fitting else free:
        _blocks.remove(block)
        block.close()
    if has_fitting:
        return free[0]
    _blocks.append(_Block(min_bytes))
    return _blocks[-1]


def _reduce(batch: SignatureBatch) -> Any:
    """Reduce a batch to its block and the places of its tensors, or as usual if it has no block or was sent before."""
    address = batch.labels.data_ptr()
    block = next(
        (b for b in _blocks if b.start <= address < b.start + b.n_bytes and not b.memory[0]), None
    )
    if block is None:
        return batch.__reduce_ex__(2)

    def place(values: Tensor) -> Any:
        offset = values.data_ptr() - block.start  # bytes
        return (
            (offset, values.dtype, values.shape, values.stride())
            if 0 <= offset < block.n_bytes
            else values
        )

    block.memory[0] = 1
    return _rebuild, (DupFd(block.handle), _ALIGNMENT + block.n_bytes, vars(batch.map(place)))


def _rebuild(handle: Any, n_bytes: int, fields: dict[str, Any]) -> SignatureBatch:
    """Rebuild a batch in the consumer's process; the worker gets the block back when the last tensor is freed."""
    descriptor = handle.detach()
    memory = mmap.mmap(descriptor, n_bytes)
    os.close(descriptor)
    array = np.frombuffer(memory, np.uint8, offset=_ALIGNMENT)
    weakref.finalize(array, _release, memory, os.getpid()).atexit = False
    content = torch.from_numpy(array)

    def tensor(place: Any) -> Tensor:
        if isinstance(place, Tensor):
            return place
        offset, dtype, shape, strides = place
        return content[offset:].view(dtype).as_strided(shape, strides)

    return SignatureBatch(**fields).map(tensor)


def _release(memory: mmap.mmap, owner: int) -> None:
    if (
        os.getpid() == owner
    ):  # a forked child has copies of the tensors, and must not release those of its parent
        memory[0] = 0


ForkingPickler.register(SignatureBatch, _reduce)

"""Shared memory in which worker processes of a DataLoader hand batches over, and which they use again.

New shared memory costs several times the copy of a batch into it, as the system has to find and clear its pages. So a
worker keeps its blocks, and fills one anew when nothing in either process refers to it any more.
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

_ALIGNED = 64  # bytes; so many in front tell whether the consumer has the block
_N_SPARE = 4  # blocks without use that a worker keeps


class _Block:
    """Memory of a worker process, for one batch at a time."""

    def __init__(self, n_bytes: int) -> None:
        self.handle = os.memfd_create("igps-batch")
        os.ftruncate(self.handle, _ALIGNED + n_bytes)
        self.memory = mmap.mmap(self.handle, _ALIGNED + n_bytes)
        self.start, self.n_bytes = self.lend().ctypes.data, n_bytes

    def lend(self) -> NDArray[np.uint8]:
        array = np.frombuffer(self.memory, np.uint8, offset=_ALIGNED)
        self._lent = weakref.ref(array)
        return array

    @property
    def free(self) -> bool:
        # In this order: a batch is marked as sent before the last reference to it here goes.
        return self._lent() is None and not self.memory[0]

    def close(self) -> None:
        self.memory.close()
        os.close(self.handle)


_blocks: list[_Block] = []


def empty_arrays(shapes: Sequence[tuple[int, ...]], kinds: Sequence[np.dtype[Any]]) -> list[NDArray[Any]]:
    """Empty arrays of these shapes and types; in a worker process, where the system can, in one block to hand over."""
    if get_worker_info() is None or not hasattr(os, "memfd_create"):
        # NumPy asks for large pages, which come many times faster.
        return [np.empty(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)]
    sizes = [math.prod(shape) * kind.itemsize for shape, kind in zip(shapes, kinds, strict=True)]
    *starts, end = np.cumsum([0, *(-(-size // _ALIGNED) * _ALIGNED for size in sizes)]).tolist()
    whole = _block(end).lend()
    return [
        whole[start : start + size].view(kind).reshape(shape)
        for start, size, shape, kind in zip(starts, sizes, shapes, kinds, strict=True)
    ]


def _block(n_bytes: int) -> _Block:
    """A free block of at least this size."""
    free = sorted((block for block in _blocks if block.free), key=lambda block: block.n_bytes, reverse=True)
    fits = bool(free) and free[0].n_bytes >= n_bytes
    for block in free[_N_SPARE:] if fits else free:
        _blocks.remove(block)
        block.close()
    if fits:
        return free[0]
    _blocks.append(_Block(n_bytes))
    return _blocks[-1]


def _reduced(batch: SignatureBatch) -> Any:
    """A batch as its block and where its tensors lie in it; as usual if it lies in none, or was sent before."""
    at = batch.labels.data_ptr()
    block = next((one for one in _blocks if one.start <= at < one.start + one.n_bytes and not one.memory[0]), None)
    if block is None:
        return batch.__reduce_ex__(2)

    def place(values: Tensor) -> Any:
        start = values.data_ptr() - block.start  # bytes
        return (start, values.dtype, values.shape, values.stride()) if 0 <= start < block.n_bytes else values

    block.memory[0] = 1
    return _rebuilt, (DupFd(block.handle), _ALIGNED + block.n_bytes, vars(batch.map(place)))


def _rebuilt(handle: Any, n_bytes: int, fields: dict[str, Any]) -> SignatureBatch:
    """The batch in the consumer's process; its worker gets the memory back when the last tensor is freed."""
    descriptor = handle.detach()
    memory = mmap.mmap(descriptor, n_bytes)
    os.close(descriptor)
    array = np.frombuffer(memory, np.uint8, offset=_ALIGNED)
    weakref.finalize(array, _release, memory, os.getpid()).atexit = False
    whole = torch.from_numpy(array)

    def tensor(place: Any) -> Tensor:
        if isinstance(place, Tensor):
            return place
        start, dtype, shape, strides = place
        return whole[start:].view(dtype).as_strided(shape, strides)

    return SignatureBatch(**fields).map(tensor)


def _release(memory: mmap.mmap, process: int) -> None:
    if os.getpid() == process:  # a forked child has a copy of the tensors, not the batch
        memory[0] = 0


ForkingPickler.register(SignatureBatch, _reduced)

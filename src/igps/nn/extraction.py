"""Descriptors of a whole dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor, nn
from tqdm import tqdm

from igps.data.dataset import SignatureDataset, collate, n_cores


def describe(
    dataset: SignatureDataset, descriptor: nn.Module, *, batch_size: int = 1, progress: bool = False
) -> Tensor:
    """Descriptors of all meshes of a dataset, without gradients, computed on the descriptor's device.

    Signatures that are not cached are computed on the way; `dataset.precompute()` does that on all cores.

    Args:
        dataset: N meshes.
        descriptor: `SignatureBatch` to (N, ...), such as a `VolumetricDescriptor`.
        batch_size: shapes at a time.
        progress: show a bar.

    Returns:
        (N, ...) on the CPU.
    """
    device = next(descriptor.parameters(), next(descriptor.buffers(), torch.empty(0))).device
    batches = [range(i, min(i + batch_size, len(dataset))) for i in range(0, len(dataset), batch_size)]

    def one(batch: range) -> Tensor:
        with torch.inference_mode():  # holds for the thread that enters it
            return descriptor(collate([dataset[i] for i in batch]).to(device)).cpu()

    with tqdm(desc="descriptors", total=len(batches), disable=not progress) as bar:
        parts = []
        for part in _parallel(one, batches) if device.type == "cpu" else map(one, batches):
            parts.append(part)
            bar.update()
    return torch.cat(parts)


def _parallel(function: Callable[[range], Tensor], batches: list[range]) -> Iterator[Tensor]:
    # One single-threaded shape per core. Splitting each small product over all cores instead makes every one of them
    # wait for the slowest core, which on a machine with other work to do costs many times the product itself.
    n_threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(n_cores(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield from pool.map(function, batches)
    finally:
        torch.set_num_threads(n_threads)  # or every thread started later would inherit the workers' one

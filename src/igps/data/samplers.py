"""Batch sampler that reduces padding."""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.utils.data import Sampler

from igps._parameters import check_at_least

_BATCHES_PER_BUCKET = 20


class BucketBatchSampler(Sampler[list[int]]):
    """Sampler of random batches of shapes of similar size, for the `batch_sampler` of a `DataLoader`.

    The shapes are shuffled, sorted by size within buckets of twenty batches, and cut into batches, which are yielded in
    random order. Each shape occurs once per epoch.

    Example:
        >>> sizes = [900, 1000, 2000, 950, 2100, 1900]
        >>> sampler = BucketBatchSampler(sizes, 3, generator=torch.Generator().manual_seed(0))
        >>> sorted(sorted(sizes[i] for i in batch) for batch in sampler)
        [[900, 950, 1000], [1900, 2000, 2100]]

    Args:
        sizes: (N,) sizes of the shapes, see `SignatureDataset.sizes`.
        batch_size: number of shapes in a batch; one batch may be smaller.
        generator: generator of the random order; PyTorch's global generator if None.
    """

    def __init__(
        self,
        sizes: Sequence[int] | Tensor,
        batch_size: int,
        *,
        generator: torch.Generator | None = None,
    ) -> None:
        check_at_least(1, batch_size=batch_size)
        self.sizes = torch.as_tensor(sizes)
        self.batch_size = batch_size
        self.generator = generator

    def __len__(self) -> int:
        return math.ceil(len(self.sizes) / self.batch_size)

    def __iter__(self) -> Iterator[list[int]]:
        order = torch.randperm(len(self.sizes), generator=self.generator)
        batches: list[list[int]] = []
        for bucket in order.split(_BATCHES_PER_BUCKET * self.batch_size):
            # A stable sort keeps shapes of equal size in their random order
            ranked = torch.sort(self.sizes[bucket], stable=True).indices
            by_size = bucket[ranked]
            batches += [batch.tolist() for batch in by_size.split(self.batch_size) if len(batch)]
        for i in torch.randperm(len(batches), generator=self.generator).tolist():
            yield batches[i]

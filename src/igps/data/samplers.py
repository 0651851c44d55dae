"""Batches of shapes of like size, so that padding costs little."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.utils.data import Sampler

from igps._parameters import check_at_least

_BATCHES_IN_A_BUCKET = 20


class BucketBatchSampler(Sampler[list[int]]):
    """Random batches of shapes of like size: the `batch_sampler` of a `DataLoader`.

    The shapes are shuffled, sorted by size within buckets of twenty batches, and cut into batches, which come in random
    order. Each shape comes once an epoch.

    Example:
        >>> sizes = [900, 1000, 2000, 950, 2100, 1900]
        >>> sampler = BucketBatchSampler(sizes, 3, generator=torch.Generator().manual_seed(0))
        >>> sorted(sorted(sizes[i] for i in batch) for batch in sampler)
        [[900, 950, 1000], [1900, 2000, 2100]]

    Args:
        sizes: (N,) of the shapes, see `SignatureDataset.sizes`.
        batch_size: shapes in a batch; the last batch of the last bucket has what is left.
        drop_last: leave out the batch with fewer.
        generator: of the order; PyTorch's global one if None.
    """

    def __init__(
        self,
        sizes: Sequence[int] | Tensor,
        batch_size: int,
        *,
        drop_last: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        check_at_least(1, batch_size=batch_size)
        self.sizes = torch.as_tensor(sizes)
        self.batch_size = batch_size
        self.drop_last = drop_last
        self.generator = generator

    def __len__(self) -> int:
        whole, rest = divmod(len(self.sizes), self.batch_size)
        return whole + (rest > 0 and not self.drop_last)

    def __iter__(self) -> Iterator[list[int]]:
        order = torch.randperm(len(self.sizes), generator=self.generator)
        batches: list[list[int]] = []
        for bucket in order.split(_BATCHES_IN_A_BUCKET * self.batch_size):
            # By size; shapes of one size stay in the order in which they were shuffled.
            by_size = bucket[torch.sort(self.sizes[bucket], stable=True).indices]
            batches += [batch.tolist() for batch in by_size.split(self.batch_size)]
        least = self.batch_size if self.drop_last else 1
        batches = [batch for batch in batches if len(batch) >= least]
        for i in torch.randperm(len(batches), generator=self.generator).tolist():
            yield batches[i]

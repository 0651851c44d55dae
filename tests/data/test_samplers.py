import pytest
import torch

from igps.data.samplers import BucketBatchSampler

SIZES = torch.randint(
    1000,
    4000,
    (403,),
    generator=torch.Generator().manual_seed(0),
)


def test_every_shape_comes_once_in_batches_of_the_size_asked():
    sampler = BucketBatchSampler(SIZES, 8, generator=torch.Generator().manual_seed(0))
    batches = list(sampler)
    assert len(batches) == len(sampler) == 51
    assert sorted(map(len, batches))[:2] == [3, 8]
    drawn = [i for batch in batches for i in batch]
    assert len(set(drawn)) == len(drawn) == 403


def padding(batches):
    """Padding rows of all batches, over the rows of their shapes."""
    n_rows = sum(int(SIZES[one].sum()) for one in batches)
    n_padded = sum(len(one) * int(SIZES[one].max()) for one in batches)
    return n_padded / n_rows - 1


def test_padding_is_a_small_part_of_that_of_random_batches():
    sampler = BucketBatchSampler(
        SIZES.tolist(),
        8,
        generator=torch.Generator().manual_seed(0),
    )
    random = torch.randperm(403, generator=torch.Generator().manual_seed(0)).split(8)
    assert padding([one.tolist() for one in random]) > 0.3
    assert padding(list(sampler)) < 0.1


def test_epochs_differ_and_seeds_say_all():
    def epochs(seed):
        sampler = BucketBatchSampler(SIZES, 8, generator=torch.Generator().manual_seed(seed))
        return [list(sampler), list(sampler)]

    first = epochs(0)
    assert first == epochs(0)
    assert first[0] != first[1]
    assert {frozenset(one) for one in first[0]} != {frozenset(one) for one in first[1]}
    with pytest.raises(ValueError, match="batch_size: expected at least 1"):
        BucketBatchSampler(SIZES, 0)


def test_no_shapes_make_no_batch():
    assert list(BucketBatchSampler([], 8)) == []

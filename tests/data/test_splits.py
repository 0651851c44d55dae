import pytest
import torch

from igps.data.splits import split_seen, split_unseen

ORDER = torch.randperm(48, generator=torch.Generator().manual_seed(1))
LABELS = torch.arange(8).repeat_interleave(6)[ORDER]


def classes(indices):
    return sorted(LABELS[list(indices)].tolist())


def disjoint(split):
    parts = [set(part) for part in (split.train, split.validation, split.test)]
    return sum(map(len, parts)) == len(set.union(*parts))


def test_seen_split_takes_the_same_number_of_every_class():
    split = split_seen(LABELS, 4, n_validation=1, seed=3)
    assert disjoint(split)
    assert classes(split.train) == sorted([*range(8)] * 3)
    assert classes(split.validation) == [*range(8)]
    assert classes(split.test) == sorted([*range(8)] * 2)


def test_unseen_split_shares_no_class():
    split = split_unseen(LABELS, 5, n_validation=2, seed=3)
    assert disjoint(split)
    parts = [set(classes(part)) for part in (split.train, split.validation, split.test)]
    assert [len(part) for part in parts] == [3, 2, 3]
    assert len(set.union(*parts)) == 8
    assert len(split.train) == 3 * 6


def test_a_whole_number_may_be_a_float():
    labels = torch.arange(3).repeat_interleave(4)
    assert split_seen(labels, 3.0, n_validation=1.0) == split_seen(labels, 3, n_validation=1)


def test_shares_leave_two_of_each_class_to_validate_and_to_test():
    labels = torch.arange(3).repeat_interleave(torch.tensor([5, 8, 20]))
    split = split_seen(labels, 0.75, n_validation=0.25)
    parts = (split.train, split.validation, split.test)
    counts = [torch.bincount(labels[list(part)]).tolist() for part in parts]
    assert counts == [[1, 4, 11], [2, 2, 4], [2, 2, 5]]
    of_classes = split_unseen(labels, 0.5, n_validation=0.5)
    for part in (of_classes.train, of_classes.test):
        assert len(labels[list(part)].unique()) == 1


def test_more_training_classes_are_added_to_fewer():
    many, few = (split_unseen(LABELS, n, seed=5) for n in (6, 3))
    assert set(few.train) < set(many.train)


def test_validation_is_taken_from_the_training_part_alone():
    for split in (split_seen, split_unseen):
        assert split(LABELS, 4, seed=2).test == split(LABELS, 4, n_validation=2, seed=2).test


def test_splits_depend_on_the_seed_alone():
    for split in (split_seen, split_unseen):
        torch.manual_seed(0)
        first = split(LABELS, 4, seed=1)
        torch.manual_seed(1)
        assert split(LABELS, 4, seed=1) == first
        assert split(LABELS, 4, seed=2) != first


@pytest.mark.parametrize(
    ("split", "arguments", "message"),
    [
        (split_seen, {"n_train": 6}, "n_train"),
        (split_seen, {"n_train": 3, "n_validation": 3}, "n_validation"),
        (split_seen, {"n_train": 2.5}, "n_train"),
        (split_seen, {"n_train": 0}, "n_train: expected a number above 0"),
        (split_seen, {"n_train": 0.5, "n_validation": 1}, "n_validation: expected a share below 1"),
        (split_unseen, {"n_train": 8}, "n_train"),
        (split_unseen, {"n_train": 8}, "n_train: expected fewer than the 8 classes"),
        (split_unseen, {"n_train": 3, "n_validation": 3}, "n_validation"),
    ],
)
def test_impossible_splits_are_refused(split, arguments, message):
    with pytest.raises(ValueError, match=message):
        split(LABELS, **arguments)


def test_a_share_of_a_class_of_four_is_refused_by_its_class():
    labels = torch.tensor([0] * 6 + [1] * 4)
    with pytest.raises(ValueError, match="at least 5 shapes of a class, got 4 of class 1"):
        split_seen(labels, 0.5)

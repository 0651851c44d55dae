"""Seeded splits of a labelled collection into training, validation and test."""

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from igps._parameters import check_one_of

SplitProtocol = Literal["seen", "unseen"]
"""Whether test classes are seen in training: "seen" splits the shapes of each class, "unseen" splits the classes."""


@dataclass(frozen=True)
class Split:
    """Indices of the shapes of the three disjoint parts."""

    train: tuple[int, ...]  # to fit parameters
    validation: tuple[int, ...]  # to choose between models; may be empty
    test: tuple[int, ...]  # for the final evaluation


@dataclass(frozen=True)
class Parts:
    """How the shapes of a collection are divided.

    Args:
        protocol: see `SplitProtocol`.
        n_train: number of shapes of each class ("seen") or of classes ("unseen") in training and validation together;
            a share if below 1.
        n_validation: how many of these are for validation, 0 or at least 2 of a class; a share if below 1.
        seed: of the random numbers.
    """

    protocol: SplitProtocol = "seen"
    n_train: int | float = 10
    n_validation: int | float = 2
    seed: int = 0

    def split(self, labels: Tensor) -> Split:
        """Split shapes with labels (N,); raise a ValueError if validation shapes cannot retrieve each other."""
        check_one_of(get_args(SplitProtocol), protocol=self.protocol)
        divide = split_seen if self.protocol == "seen" else split_unseen
        split = divide(labels, self.n_train, n_validation=self.n_validation, seed=self.seed)
        validation = labels[list(split.validation)]
        if len(validation) and len(validation.unique()) == len(validation):
            raise ValueError(
                "n_validation: expected at least 2 bodies of a class, which retrieve each other, got "
                f"{self.n_validation}. Give 2 or more, or 0 for no validation."
            )
        return split


def split_seen(labels: Tensor, n_train: float, *, n_validation: float = 0, seed: int = 0) -> Split:
    """Split the shapes of each class, so that every class is in every part.

    Args:
        labels: (N,) integer classes.
        n_train: number of shapes of each class in training and validation together; below 1 a share, which gives at
            least 3 shapes and leaves at least 2.
        n_validation: how many of these are for validation; below 1 a share, which gives at least 2 and leaves 1.

    Raises:
        ValueError: a class has at most `n_train` shapes, or fewer than 5 for a share; or none are left for training.
    """
    _check(n_validation, n_train)
    generator = torch.Generator().manual_seed(seed)
    train = list[int]()
    validation = list[int]()
    test = list[int]()
    for label in labels.unique().tolist():
        members = torch.nonzero(labels == label).flatten()
        n_fit = _count(n_train, len(members), 3, 2)
        if 0 < n_train < 1 and len(members) < 5:
            raise ValueError(
                f"n_train: a share expects at least 5 shapes of a class, got {len(members)} of class {label}. "
                "Give a number of shapes, or leave the class out."
            )
        if len(members) <= n_fit:
            raise ValueError(
                f"n_train: expected fewer than the {len(members)} shapes of class {label}, got {n_train}."
            )
        n_held_out = _count(n_validation, n_fit, 2)
        order = torch.randperm(len(members), generator=generator)
        shuffled = members[order].tolist()
        train += shuffled[n_held_out:n_fit]
        validation += shuffled[:n_held_out]
        test += shuffled[n_fit:]
    return Split(tuple(sorted(train)), tuple(sorted(validation)), tuple(sorted(test)))


def split_unseen(
    labels: Tensor, n_train: float, *, n_validation: float = 0, seed: int = 0
) -> Split:
    """Split the classes, so that no class is in two parts.

    With the same seed, a larger `n_train` adds training classes without removing any.

    Args:
        labels: (N,) integer classes.
        n_train: number of classes in training and validation together; below 1 a share, which leaves at least 1.
        n_validation: how many of these are for validation; below 1 a share, which leaves at least 1.

    Raises:
        ValueError: there are too few classes, or none are left for training.
    """
    classes = labels.unique()
    _check(n_validation, n_train)
    n_fit = _count(n_train, len(classes), 1)
    n_held_out = _count(n_validation, n_fit, 1)
    if n_fit >= len(classes):
        raise ValueError(f"n_train: expected fewer than the {len(classes)} classes, got {n_train}.")
    generator = torch.Generator().manual_seed(seed)
    shuffled = classes[torch.randperm(len(classes), generator=generator)]

    def members(chosen: Tensor) -> tuple[int, ...]:
        return tuple(torch.nonzero(torch.isin(labels, chosen)).flatten().tolist())

    return Split(
        members(shuffled[n_held_out:n_fit]),
        members(shuffled[:n_held_out]),
        members(shuffled[n_fit:]),
    )


def _count(amount: float, n: int, min_count: int, min_left: int = 1) -> int:
    """Return a whole number unchanged, or a share of n as a number of at least `min_count` that leaves `min_left`."""
    if not 0 < amount < 1:
        return int(amount)
    count = max(round(amount * n), min_count)
    return min(count, n - min_left)


def _check(n_validation: float, n_train: float) -> None:
    for name, value in (("n_train", n_train), ("n_validation", n_validation)):
        if not (0 <= value < 1 or value == int(value)):
            raise ValueError(f"{name}: expected a whole number, or a share below 1, got {value}.")
    if n_train <= 0:
        raise ValueError(f"n_train: expected a number above 0, got {n_train}.")
    if not 0 <= n_validation < max(n_train, 1):
        expected = (
            f"0 to n_train - 1 = {n_train - 1}"
            if n_train >= 1
            else "a share below 1, as n_train is a share"
        )
        raise ValueError(f"n_validation: expected {expected}, got {n_validation}.")

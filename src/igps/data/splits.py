"""Seeded splits of a labelled collection into training, validation and test parts."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

SplitProtocol = Literal["seen", "unseen"]
"""Whether the classes of the test part are seen in training (each class is split) or not (the classes are split)."""


@dataclass(frozen=True)
class Split:
    """Indices of the shapes of each part; no shape is in two of them."""

    train: tuple[int, ...]  # to fit parameters to
    validation: tuple[int, ...]  # taken from the training part, to choose between models; may be empty
    test: tuple[int, ...]  # to be looked at once


def split_seen(labels: Tensor, n_train: float, *, n_validation: float = 0, seed: int = 0) -> Split:
    """Every class in every part: `n_train` shapes of each train, the others test.

    Args:
        labels: (N,) integer classes.
        n_train: shapes of each class in training and validation together; below 1 a share of them,
            three or more, which leaves two.
        n_validation: how many of those validate; below 1 a share, two or more, which leaves one to train on.

    Raises:
        ValueError: a class has no more than `n_train` shapes, or for a share fewer than five; or `n_validation`
            leaves none to train on.
    """
    _check(n_validation, n_train)
    generator = torch.Generator().manual_seed(seed)
    parts: tuple[list[int], list[int], list[int]] = ([], [], [])
    for label in labels.unique().tolist():
        members = torch.nonzero(labels == label).flatten()
        n_fit = _count(n_train, len(members), 3, 2)
        if 0 < n_train < 1 and len(members) < 5:
            raise ValueError(f"n_train: a share expects at least 5 shapes of a class, got {len(members)} of {label}.")
        if len(members) <= n_fit:
            raise ValueError(f"n_train: expected fewer than the {len(members)} shapes of class {label}, got {n_train}.")
        n_held = _count(n_validation, n_fit, 2)
        drawn = members[torch.randperm(len(members), generator=generator)].tolist()
        for part, chosen in zip(parts, (drawn[n_held:n_fit], drawn[:n_held], drawn[n_fit:]), strict=True):
            part.extend(chosen)
    train, validation, test = (tuple(sorted(part)) for part in parts)
    return Split(train, validation, test)


def split_unseen(
    labels: Tensor, n_train: float, *, n_validation: float = 0, n_test: int | None = None, seed: int = 0
) -> Split:
    """No class in two parts: `n_train` classes train, others test.

    With the same seed and `n_test` the test classes stay the same whatever `n_train`, and the training classes of a
    smaller `n_train` are among those of a larger.

    Args:
        labels: (N,) integer classes.
        n_train: classes in training and validation together; below 1 a share of them, which leaves one.
        n_validation: how many of those validate; below 1 a share, which leaves one to train on.
        n_test: classes to test; all others if None.

    Raises:
        ValueError: not so many classes, or `n_validation` leaves none to train on.
    """
    classes = labels.unique()
    _check(n_validation, n_train)
    n_fit = _count(n_train, len(classes), 1)
    n_held = _count(n_validation, n_fit, 1)
    n_test = len(classes) - n_fit if n_test is None else n_test
    if n_test < 1 or n_fit + n_test > len(classes):
        raise ValueError(f"n_train, n_test: expected at most {len(classes)} classes together, got {n_train}, {n_test}.")
    drawn = classes[torch.randperm(len(classes), generator=torch.Generator().manual_seed(seed))]

    def members(chosen: Tensor) -> tuple[int, ...]:
        return tuple(torch.nonzero(torch.isin(labels, chosen)).flatten().tolist())

    fit = drawn[:n_fit]
    return Split(members(fit[n_held:]), members(fit[:n_held]), members(drawn[len(drawn) - n_test :]))


def _count(wanted: float, n: int, least: int, rest: int = 1) -> int:
    """A whole number as it is; a share below 1 of n as a number, at least `least`, which leaves at least `rest`."""
    return min(max(round(wanted * n), least), n - rest) if 0 < wanted < 1 else int(wanted)


def _check(n_validation: float, n_train: float) -> None:
    for name, value in (("n_train", n_train), ("n_validation", n_validation)):
        if not (0 <= value < 1 or value == int(value)):
            raise ValueError(f"{name}: expected a whole number, or a share below 1, got {value}.")
    if not 0 <= n_validation < max(n_train, 1 if n_train > 0 else 0):
        raise ValueError(f"n_validation: expected 0 to n_train - 1 = {n_train - 1}, got {n_validation}.")

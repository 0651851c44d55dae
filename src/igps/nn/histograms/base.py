"""What all histograms of the samples of a body share, whether they count samples or pairs of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements
from igps.nn.batch_features import SampleKind, View, Views, check_kind


class SampleHistogram(nn.Module, ABC):
    """A histogram of some samples of each body, whose cells sum to 1.

    Args:
        samples: "interior" or "surface".
        n_samples: of a body with more samples, a subset of so many that is always the same; None uses all.
        n_training_samples: in training mode, a random subset of so many, another one each time: it is faster, and a
            head cannot learn the samples by heart. None uses the same as in evaluation.

    Raises:
        ValueError: an unknown kind of samples, or fewer than two.
    """

    def __init__(
        self, samples: SampleKind, n_samples: int | None = None, n_training_samples: int | None = None
    ) -> None:
        super().__init__()
        check_kind(samples)
        for name, value in (("n_samples", n_samples), ("n_training_samples", n_training_samples)):
            if value is not None and value < 2:
                raise ValueError(f"{name}: expected None or at least 2, got {value}.")
        self.samples: SampleKind = samples
        self.n_samples = n_samples
        self.n_training_samples = n_training_samples

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Of a body's histogram."""

    @property
    @abstractmethod
    def requirements(self) -> Requirements:
        """What it needs of a body."""

    @abstractmethod
    def of_view(self, view: View) -> Tensor:
        """(N, ...) histograms of the samples in a view."""

    @property
    def n_cells(self) -> int:
        """Cells of a body's histogram."""
        return math.prod(self.shape)

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, ...) histograms, each body's of sum 1.

        Raises:
            ValueError: a body without two samples, attributes that are missing, or values that are not finite.
        """
        return self.of_views(Views(batch, self.training))

    def of_views(self, views: Views) -> Tensor:
        """`forward` of a batch whose views are shared with other histograms."""
        return self.of_view(views.of(self.samples, self.n_samples, self.n_training_samples))


def joint(memberships: list[Tensor]) -> Tensor:
    """(P, C) memberships of points in all combinations of classes, from those in classes of several kinds."""
    found = memberships[0]
    for one in memberships[1:]:
        found = (found[:, :, None] * one[:, None, :]).flatten(1)
    return found


def counted(one: Tensor, other: Tensor) -> Tensor:
    """(C, D) shares of points in combinations of classes, from memberships (P, C) and (P, D).

    Raises:
        ValueError: no point.
    """
    if not len(one):
        raise ValueError("samples: expected at least one of each body, got none.")
    return one.T @ other / len(one)


def present(view: View) -> list[Tensor | slice]:
    """Which samples of each body are real; where nothing is padding, nothing need be copied."""
    return [slice(None) if bool(torch.all(real)) else real for real in view.samples.mask]

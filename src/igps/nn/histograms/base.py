"""What the parts of a description share, and the histograms of samples among them."""

import math
from abc import ABC, abstractmethod
from functools import reduce
from operator import or_

import torch
from torch import Tensor, nn

from igps._parameters import check_at_least, check_one_of
from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements, embedding_requirements
from igps.nn.axes.pairs import DistanceAxis, PairAxis
from igps.nn.axes.points import PointAxis
from igps.nn.batch_features import BatchFeatures, SampleFeatures
from igps.nn.specification import Specified
from igps.signature.signature import SAMPLE_KINDS, SampleKind


class DescriptionPart(Specified, ABC):
    """A module that makes one part of a description: non-negative numbers of sum 1 for each body.

    A part of your own defines `shape`, `requirements` and `of_features`, and, where it heeds the `weights` of samples,
    `degree`: a part is as many times as large, to that power, where all samples weigh as many times as much.
    """

    degree: int = 1

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Of a body's part."""

    @property
    @abstractmethod
    def requirements(self) -> Requirements:
        """What it needs of a body."""

    @abstractmethod
    def of_features(self, features: BatchFeatures) -> Tensor:
        """(N, ...) parts of N shapes."""

    @property
    def n_cells(self) -> int:
        """Numbers of a body's part."""
        return math.prod(self.shape)

    def forward(self, batch: SignatureBatch | BatchFeatures) -> Tensor:
        """(N, ...) parts of N shapes, of a batch or of features that several parts share.

        Raises:
            ValueError: a body without two samples, attributes that are missing, or values that are not finite.
        """
        return self.of_features(batch if isinstance(batch, BatchFeatures) else BatchFeatures(batch, self.training))


class SampleHistogram(DescriptionPart):
    """A histogram of some samples of each body, whose cells sum to 1.

    Args:
        samples: "interior" or "surface".
        n_samples: of a body with more samples, a subset of so many that is always the same; None uses all.
        n_training_samples: in training mode, a random subset of so many, another one each time: it is faster, and a
            head cannot learn the samples by heart. None uses the same as in evaluation.

    Raises:
        ValueError: an unknown kind of samples, or fewer than two.
    """

    embedding: nn.Module

    def __init__(
        self, samples: SampleKind, n_samples: int | None = None, n_training_samples: int | None = None
    ) -> None:
        super().__init__()
        check_one_of(SAMPLE_KINDS, samples=samples)
        check_at_least(2, n_samples=n_samples, n_training_samples=n_training_samples)
        self.samples: SampleKind = samples
        self.n_samples = n_samples
        self.n_training_samples = n_training_samples

    @property
    def requirements(self) -> Requirements:
        """Those of the embedding."""
        return embedding_requirements(self.embedding)

    @abstractmethod
    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, ...) histograms of some samples of N shapes."""

    def of_features(self, features: BatchFeatures) -> Tensor:
        """(N, ...) histograms of N shapes."""
        return self.of_samples(features.of(self.samples, self.n_samples, self.n_training_samples))


class AxesHistogram(SampleHistogram):
    """A histogram along some axes."""

    axes: nn.ModuleList

    @property
    def point_axes(self) -> list[PointAxis]:
        """The axes of points."""
        return [one for one in self.axes if isinstance(one, PointAxis)]

    @property
    def pair_axes(self) -> list[PairAxis]:
        """The axes of pairs in the order of the histogram's dimensions: distances before cosines."""
        axes = [one for one in self.axes if isinstance(one, PairAxis)]
        return sorted(axes, key=lambda one: not isinstance(one, DistanceAxis))

    @property
    def requirements(self) -> Requirements:
        """What all axes together need of a body."""
        axes: list[PointAxis | PairAxis] = [*self.point_axes, *self.pair_axes]
        return reduce(or_, (axis.requirements(self.embedding) for axis in axes))


def joint(memberships: list[Tensor]) -> Tensor:
    """(..., P, C) memberships of points in all combinations of classes, from those in classes of several kinds."""
    return reduce(lambda one, other: (one[..., :, None] * other[..., None, :]).flatten(-2), memberships)


def counted(one: Tensor, other: Tensor, n_points: Tensor) -> Tensor:
    """(..., C, D) shares of points, at least one, in combinations of classes (..., P, C) and (..., P, D)."""
    if not torch.compiler.is_compiling() and int(n_points.min()) < 1:
        raise ValueError("samples: expected at least one of each body, got none.")
    return one.mT @ other / n_points[..., None, None]

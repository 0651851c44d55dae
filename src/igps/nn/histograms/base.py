"""Base classes of the parts of a description, and of histograms of samples."""

import math
from abc import ABC, abstractmethod
from functools import reduce
from operator import or_

import torch
from torch import Tensor, nn

from igps._parameters import check_at_least, check_one_of
from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements, embedding_requirements
from igps.nn._kernels.batches import map_by_size, on_one_thread
from igps.nn.axes.pairs import DistanceAxis, EmbeddedPairCosines, PairAxis
from igps.nn.axes.points import PointAxis
from igps.nn.batch_features import BatchFeatures, SampleFeatures
from igps.nn.specification import Specified
from igps.signature.signature import SAMPLE_KINDS, SampleKind


class DescriptionPart(Specified, ABC):
    """A module that computes one part of a description: non-negative numbers of sum 1 for each body.

    A part of your own defines `shape`, `requirements` and `of_features`. If it uses the `weights` of samples, it also
    defines `degree`: if all weights are multiplied by t, the part is multiplied by t to the power `degree`.
    """

    degree: int = 1

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """The shape of the part of one body."""

    @property
    @abstractmethod
    def requirements(self) -> Requirements:
        """The data that a body must have."""

    @abstractmethod
    def of_features(self, features: BatchFeatures) -> Tensor:
        """Return the parts (N, ...) of N shapes."""

    def n_read(self, training: bool) -> tuple[float, float]:
        """The largest numbers of interior and surface samples of a body that are read, by default infinite."""
        return math.inf, math.inf

    @property
    def n_cells(self) -> int:
        """The number of entries of the part of one body."""
        return math.prod(self.shape)

    def forward(self, batch: SignatureBatch | BatchFeatures) -> Tensor:
        """Return the parts (N, ...) of N shapes, from a batch or from features that several parts share.

        Raises:
            ValueError: a body has fewer than two samples, an attribute is missing, or values are not finite.
        """
        bodies = batch.batch if isinstance(batch, BatchFeatures) else batch
        if bodies.device.type == "meta":  # tensors without values
            return torch.empty(len(bodies), *self.shape, device="meta")
        if isinstance(batch, BatchFeatures):
            return self.of_features(batch)

        def of_group(group: SignatureBatch) -> Tensor:
            return self.of_features(BatchFeatures(group, self.training))

        n_read = self.n_read(self.training)
        return on_one_thread(lambda bodies: map_by_size(of_group, bodies, n_read), batch, self)


class SampleHistogram(DescriptionPart):
    """A histogram of the samples of each body, whose cells sum to 1.

    Args:
        samples: "interior" or "surface".
        n_samples: size of a fixed subset, for bodies with more samples; None uses all samples.
        n_training_samples: size of a random subset, drawn at each step in training mode, which is faster and prevents a
            head from memorising the samples. None uses the same samples as in evaluation mode.

    Raises:
        ValueError: an unknown kind of samples, or a number of samples below two.
    """

    embedding: nn.Module

    def __init__(
        self,
        samples: SampleKind,
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__()
        check_one_of(SAMPLE_KINDS, samples=samples)
        check_at_least(2, n_samples=n_samples, n_training_samples=n_training_samples)
        self.samples: SampleKind = samples
        self.n_samples = n_samples
        self.n_training_samples = n_training_samples

    reads_both_kinds: bool = False  # whether it also reads all samples of the other kind

    def n_read(self, training: bool) -> tuple[float, float]:
        """The largest numbers of interior and surface samples of a body that are read."""
        n_drawn = self.n_training_samples if training else None
        own = n_drawn or self.n_samples or math.inf
        others = math.inf if self.reads_both_kinds else 0
        return (own, others) if self.samples == "interior" else (others, own)

    @property
    def requirements(self) -> Requirements:
        """The requirements of the embedding."""
        return embedding_requirements(self.embedding)

    @abstractmethod
    def of_samples(self, features: SampleFeatures) -> Tensor:
        """Return histograms (N, ...) of the samples of N shapes."""

    def of_features(self, features: BatchFeatures) -> Tensor:
        """Return histograms (N, ...) of N shapes."""
        return self.of_samples(features.of(self.samples, self.n_samples, self.n_training_samples))


class AxesHistogram(SampleHistogram):
    """A histogram along one or several axes."""

    axes: nn.ModuleList

    @property
    def reads_both_kinds(self) -> bool:  # type: ignore[override]
        """Whether an axis also reads the samples of the other kind."""
        return any(isinstance(axis, EmbeddedPairCosines) for axis in self.axes)

    @property
    def point_axes(self) -> list[PointAxis]:
        """The axes of points."""
        return [axis for axis in self.axes if isinstance(axis, PointAxis)]

    @property
    def pair_axes(self) -> list[PairAxis]:
        """The axes of pairs in the order of the histogram's dimensions: distances before others."""
        axes = [axis for axis in self.axes if isinstance(axis, PairAxis)]
        return sorted(axes, key=lambda axis: not isinstance(axis, DistanceAxis))

    @property
    def requirements(self) -> Requirements:
        """The union of the requirements of all axes."""
        axes: list[PointAxis | PairAxis] = [*self.point_axes, *self.pair_axes]
        return reduce(or_, (axis.requirements(self.embedding) for axis in axes))


def joint(memberships: list[Tensor]) -> Tensor:
    """Return memberships (..., P, C) in all combinations of the classes of several axes."""
    combined, *others = memberships
    for other in others:
        products = combined[..., :, None] * other[..., None, :]
        combined = products.flatten(-2)
    return combined


def counted(first: Tensor, second: Tensor, n_points: Tensor) -> Tensor:
    """Return the shares (..., C, D) of at least one point in combinations of classes (..., P, C) and (..., P, D)."""
    if not torch.compiler.is_compiling() and int(n_points.min()) < 1:
        raise ValueError("samples: expected at least one of each body, got none.")
    return first.mT @ second / n_points[..., None, None]

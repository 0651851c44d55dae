"""Joint histograms over the samples of a body, as products of axes of points."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from igps.nn.axes.points import PointAxis
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import AxesHistogram, counted, joint
from igps.signature.signature import SampleKind


class PointHistogram(AxesHistogram):
    """The joint histogram of the samples of each body along some axes of points: how much of it is of each kind.

    Example:
        >>> from igps.nn.axes import BallRadius, Potential
        >>> PointHistogram([BallRadius("inside"), Potential(6, soft=True)]).shape
        (4, 6)

    Args:
        axes: of points, in the order of the histogram's dimensions.
        embedding: see `PairHistogram`.
        samples, n_samples, n_training_samples: see `SampleHistogram`.

    Raises:
        ValueError: no axis, or one that is not of points.
    """

    def __init__(
        self,
        axes: Sequence[PointAxis],
        embedding: nn.Module | None = None,
        samples: SampleKind = "surface",
        *,
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        if not axes or not all(isinstance(one, PointAxis) for one in axes):
            raise ValueError(
                f"axes: expected at least one, and all of points, got {[type(one).__name__ for one in axes]}. Axes of "
                "pairs belong to a PairHistogram."
            )
        self.axes = nn.ModuleList(axes)
        self.embedding = embedding or SpectralEmbedding()

    @property
    def shape(self) -> tuple[int, ...]:
        """Classes along each axis."""
        return tuple(one.n_classes for one in self.point_axes)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, C, ...) histograms of some samples of N shapes."""
        mask = features.samples.mask
        memberships = []
        for axis in self.point_axes:
            values = axis.values(features, self.embedding)
            # Padding may hold anything, and counts nowhere
            real = mask.view(*mask.shape, *[1] * (values.ndim - 2))
            memberships.append(axis.memberships(torch.where(real, values, 0)))
        return point_histogram(memberships, mask, features.weights())


def point_histogram(memberships: Sequence[Tensor], mask: Tensor, weights: Tensor | None = None) -> Tensor:
    """The joint histogram of the samples of each body, from their memberships in the classes of each axis.

    Args:
        memberships: (N, P, C) of one axis after the other, such as `soft_memberships` gives.
        mask: (N, P) which samples are there.
        weights: (N, P) what each counts; 1 if None.

    Returns:
        (N, C, ...) shares of the samples, of sum 1 where memberships sum to 1 and samples count 1.

    Raises:
        ValueError: a body without samples.
    """
    first, *others = memberships
    rest = joint([torch.ones_like(first[..., :1]), *others])
    counts = mask if weights is None else mask * weights
    shares = counted(first * counts.unsqueeze(2), rest, mask.sum(dim=1))
    return shares.view(mask.shape[0], *(one.shape[-1] for one in memberships))

"""Joint histograms of the samples of a body, along one or several axes of points."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from igps._tensors import with_axes_of
from igps.nn.axes.points import PointAxis
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import AxesHistogram, counted, joint
from igps.signature.signature import SampleKind


class PointHistogram(AxesHistogram):
    """The joint histogram of the samples of each body along one or several axes of points.

    Example:
        >>> from igps.nn.axes import BallRadius, Potential
        >>> PointHistogram([BallRadius("inside"), Potential(6, soft=True)]).shape
        (4, 6)

    Args:
        axes: of points, in the order of the histogram's dimensions.
        embedding: see `PairHistogram`.
        samples, n_samples, n_training_samples: see `SampleHistogram`.

    Raises:
        ValueError: there is no axis, or an axis that is not of points.
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
        if not axes or not all(isinstance(axis, PointAxis) for axis in axes):
            names = [type(axis).__name__ for axis in axes]
            raise ValueError(
                f"axes: expected axes of points, got {names}. Axes of pairs belong to a PairHistogram."
            )
        self.axes = nn.ModuleList(axes)
        self.embedding = embedding or SpectralEmbedding()

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of classes along each axis."""
        return tuple(axis.n_classes for axis in self.point_axes)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """Return histograms (N, C, ...) of the samples of N shapes."""
        mask = features.samples.mask
        memberships = []
        for axis in self.point_axes:
            values = axis.values(features, self.embedding)
            # Padding may hold NaN, which `memberships` refuses.
            known = torch.where(with_axes_of(mask, values), values, 0)
            memberships.append(axis.memberships(known))
        return point_histogram(memberships, mask, features.weights())


def point_histogram(
    memberships: Sequence[Tensor], mask: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Return the joint histogram of the samples of each body, from their memberships in the classes of each axis.

    Args:
        memberships: (N, P, C) for each axis, such as the result of `soft_memberships`.
        mask: (N, P) true where a sample is real.
        weights: (N, P) of the samples; 1 if None.

    Returns:
        (N, C, ...) shares of the samples, of sum 1 if memberships sum to 1 and weights are 1.

    Raises:
        ValueError: a body has no samples.
    """
    first, *others = memberships
    other_classes = joint([torch.ones_like(first[..., :1]), *others])
    counts = mask if weights is None else mask * weights
    shares = counted(first * counts.unsqueeze(2), other_classes, mask.sum(dim=1))
    n_classes = [x.shape[-1] for x in memberships]
    return shares.view(mask.shape[0], *n_classes)

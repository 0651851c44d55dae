"""Joint histograms over all pairs of the samples of a body, as products of axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from operator import or_

import torch
from torch import Tensor, nn

from igps.data.requirements import Requirements
from igps.nn._kernels.hard_pairs import class_pairs, hard_pair_histogram
from igps.nn._kernels.oriented_pairs import oriented_pair_histogram
from igps.nn._kernels.soft_pairs import soft_pair_histogram
from igps.nn.axes import PairAxis, PointAxis, axis_of
from igps.nn.axes.pairs import DistanceAxis, Distances, OrientedPoints
from igps.nn.batch_features import SampleKind, View
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram, joint, present


class PairHistogram(SampleHistogram):
    """The joint histogram of all pairs of samples of each body, along some axes.

    Axes of points sort the samples into classes: their combinations are C classes, and the histogram has a row for
    every unordered pair of them. Axes of pairs are the other dimensions. Each unordered pair of distinct samples counts
    once; all cells of a body sum to 1. The paper's histogram is the product of a potential and an interior distance.

    Example:
        >>> import trimesh
        >>> from igps.data.batch import collate
        >>> from igps.mesh.mesh import Mesh
        >>> from igps.signature.signature import SignatureConfig, compute_signature
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> signature = compute_signature(Mesh(ball.vertices, ball.faces), SignatureConfig(n_eigenpairs=20))
        >>> histograms = PairHistogram()(collate([signature]))
        >>> tuple(histograms.shape), round(float(histograms.sum()), 4)
        ((1, 10, 64), 1.0)

    Args:
        axes: `PointAxis` and `PairAxis` modules, or names of `igps.nn.axes.AXES`; at least one of pairs. The class
            along the first axis of points changes slowest.
        embedding: eigenfunctions (N, P, K), eigenvalues (N, K) and areas (N,) to coordinates (N, P, D), for the axes
            that have none of their own; the commute time if None.
        samples, n_samples, n_training_samples: see `SampleHistogram`.

    Raises:
        ValueError: an unknown axis or kind of samples, no axis of pairs, or too few samples to form a pair.
    """

    def __init__(
        self,
        axes: Sequence[PointAxis | PairAxis | str] = ("potential", "interior_distance"),
        embedding: nn.Module | None = None,
        samples: SampleKind = "interior",
        *,
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        given = [axis_of(one) if isinstance(one, str) else one for one in axes]
        if unknown := [one for one in given if not isinstance(one, PointAxis | PairAxis)]:
            raise ValueError(f"axes: expected axes of points or of pairs, got {type(unknown[0]).__name__}.")
        self.axes = nn.ModuleList(given)
        if not self.pair_axes:
            raise ValueError("axes: expected at least one of pairs, such as 'interior_distance', got none.")
        self.embedding: nn.Module = embedding or SpectralEmbedding()

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
    def shape(self) -> tuple[int, ...]:
        """Of a body's histogram: pairs of classes, and bins along each axis of pairs."""
        bins = [n for one in self.pair_axes for n in one.shape]
        return (len(class_pairs(math.prod(one.n_classes for one in self.point_axes))), *bins)

    @property
    def requirements(self) -> Requirements:
        """What all axes together need of a body."""
        axes: list[PointAxis | PairAxis] = [*self.point_axes, *self.pair_axes]
        return reduce(or_, (axis.requirements(self.embedding) for axis in axes))

    def of_view(self, view: View) -> Tensor:
        """(N, C(C+1)/2, B, ...) histograms of the samples in a view."""
        values = [one.values(view, self.embedding) for one in self.point_axes]
        pairs = [one.pairs(view, self.embedding) for one in self.pair_axes]
        return torch.stack(
            [
                self._of_shape([value[i, real] for value in values], [one.of_shape(i, real) for one in pairs])
                for i, real in enumerate(present(view))
            ]
        )

    def _of_shape(self, values: list[Tensor], pairs: list[Distances | OrientedPoints]) -> Tensor:
        everything = torch.ones(len(pairs[0].points), 1, device=pairs[0].points.device)
        classes = [one.memberships(value) for one, value in zip(self.point_axes, values, strict=True)]
        return joint_histogram(joint([everything, *classes]), pairs)


# Its loops over data gain nothing by torch.compile, which is to leave it alone. This mark says so as
# torch.compiler.disable does, but that imports the compiler: a second and a half for everybody.
PairHistogram._of_shape._torchdynamo_disable = True  # type: ignore[attr-defined]


def joint_histogram(memberships: Tensor, pairs: Sequence[Distances | OrientedPoints]) -> Tensor:
    """The joint histogram of one body, by the fastest of the algorithms that count the same.

    Where no gradient is asked for, points in one class each and a single distance in equal bins take the shortest way.

    Args:
        memberships: (P, C) of the points in classes, rows of sum 1.
        pairs: what is counted of their pairs.

    Returns:
        (C(C+1)/2, B, ...) of sum 1; the dimensions of distances come before those of oriented points.
    """
    distances = [one for one in pairs if isinstance(one, Distances)]
    oriented = [one for one in pairs if isinstance(one, OrientedPoints)]
    axes = [(one.points, one.centres) for one in distances]
    if oriented:
        return oriented_pair_histogram(
            memberships, axes, [(one.points, one.directions, one.towards, one.between) for one in oriented]
        )
    (first, *others) = distances
    differentiated = torch.is_grad_enabled() and any(
        tensor.requires_grad for tensor in (memberships, first.points, first.centres)
    )
    hard = bool(((memberships == 0) | (memberships == 1)).all())
    if first.equal and not others and hard and not differentiated:
        level = memberships.argmax(dim=1)
        width = 2 * float(first.centres[0])  # the first centre is the middle of the first bin
        return hard_pair_histogram(first.points, level, memberships.shape[1], len(first.centres), width)
    return soft_pair_histogram(memberships, axes)

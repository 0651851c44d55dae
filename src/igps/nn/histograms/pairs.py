"""Joint histograms of all pairs of samples of a body, along one or several axes."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from igps._parameters import check_at_least, check_positive
from igps.nn._kernels.pairs import check_pairs, class_pairs, count_pairs
from igps.nn._kernels.pairs_by_torch import PairValues, centres_of, euclidean_distances
from igps.nn.axes import PairAxis, PointAxis, axis_of
from igps.nn.axes.points import largest_members
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import AxesHistogram
from igps.signature.signature import SampleKind


class PairHistogram(AxesHistogram):
    """The joint histogram of all pairs of samples of each body, along one or several axes.

    The axes of points sort the samples into C classes, the combinations of the classes of each axis. The histogram has
    a row for every unordered pair of classes; the axes of pairs are the other dimensions. Each unordered pair of
    distinct samples counts once, and the cells of a body sum to 1. The default axes are those of Rustamov (2010).

    Example:
        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=20))
        >>> histograms = PairHistogram()(collate([signature]))
        >>> tuple(histograms.shape), round(float(histograms.sum()), 4)
        ((1, 10, 64), 1.0)

    Args:
        axes: `PointAxis` and `PairAxis` modules, or names in `igps.nn.axes.AXES`; at least one axis of pairs. The class
            along the first axis of points varies slowest.
        embedding: maps eigenfunctions (N, P, K), eigenvalues (N, K) and areas (N,) to coordinates (N, P, D), for the
            axes without an embedding of their own; the commute time if None.
        samples, n_samples, n_training_samples: see `SampleHistogram`.

    Raises:
        ValueError: an unknown axis or kind of samples, no axis of pairs, or a number of samples below two.
    """

    degree = 2

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
        modules = [axis_of(axis) if isinstance(axis, str) else axis for axis in axes]
        for axis in modules:
            if not isinstance(axis, PointAxis | PairAxis):
                raise ValueError(
                    f"axes: expected axes of points or of pairs, got {type(axis).__name__}."
                )
        self.axes = nn.ModuleList(modules)
        if not self.pair_axes:
            raise ValueError(
                "axes: expected at least one axis of pairs, such as 'interior_distance', got none."
            )
        self.embedding = embedding or SpectralEmbedding()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one histogram: the number of pairs of classes, and of bins along each axis of pairs."""
        bins = [n for axis in self.pair_axes for n in axis.shape]
        n_classes = math.prod(axis.n_classes for axis in self.point_axes)
        return (len(class_pairs(n_classes)), *bins)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """Return histograms (N, C(C+1)/2, B, ...) of the samples of N shapes."""
        mask = features.samples.mask
        pairs = [axis.pairs(features, self.embedding) for axis in self.pair_axes]
        check_pairs(pairs, mask)
        classes = torch.zeros(*mask.shape, 1, dtype=torch.long, device=mask.device)
        weights = torch.ones_like(classes, dtype=pairs[0].inputs[0].dtype)
        n_classes = 1
        for axis in self.point_axes:
            values = axis.values(features, self.embedding)
            axis_classes, axis_weights = axis.members(values, mask)
            combined = classes.unsqueeze(3) * axis.n_classes + axis_classes.unsqueeze(2)
            products = weights.unsqueeze(3) * axis_weights.unsqueeze(2)
            classes = combined.flatten(2)
            weights = products.flatten(2)
            n_classes *= axis.n_classes
        sample_weights = features.weights()
        if sample_weights is not None:
            weights = weights * sample_weights.unsqueeze(2)
        return count_pairs(classes, weights, n_classes, pairs, mask)


def joint_histogram(
    memberships: Tensor, pairs: Sequence[PairValues], mask: Tensor | None = None
) -> Tensor:
    """Return the joint histogram of all pairs of points by the classes of the points and the bins of the pairs' values.

    Args:
        memberships: (P, C) of the points in classes, rows of sum 1; or (N, P, C) of N shapes.
        pairs: the values of pairs, such as `euclidean_distances` or `oriented_pairs`.
        mask: (N, P) true where a point is real; all if None.

    Returns:
        (C(C+1)/2, B, ...) of sum 1, or (N, C(C+1)/2, B, ...), in the type of the first inputs, float32 at least.

    Raises:
        ValueError: there are fewer than two points, shapes of tensors do not match, values are not finite, memberships
            are negative or do not sum to 1, or centres do not ascend.
    """
    if mask is None:
        mask = torch.ones_like(memberships[..., 0], dtype=torch.bool)
    if memberships.ndim == 2:
        batched = []
        for pair in pairs:
            inputs = tuple(x[None] for x in pair.inputs)
            batched.append(replace(pair, inputs=inputs))
        return joint_histogram(memberships[None], batched, mask[None])[0]
    check_pairs(pairs, mask)
    for centres in centres_of(pairs):
        is_row = centres.ndim == 1 and len(centres) > 1
        if not is_row or not centres.isfinite().all() or not (centres.diff() > 0).all():
            raise ValueError(
                f"centres: expected two or more finite, ascending values, got {centres.tolist()}."
            )
    real = memberships[mask]
    errors = (real.sum(dim=1) - 1).abs()
    # Both comparisons are false for NaN.
    if not bool((real >= 0).all() & (errors < 1e-3).all()):
        raise ValueError(
            "memberships: expected non-negative rows of sum 1, got others; divide each row by its sum."
        )
    classes, weights = largest_members(memberships, mask)
    return count_pairs(classes, weights, memberships.shape[2], pairs, mask)


def pair_histogram(
    embedding: Tensor,
    potential: Tensor,
    *,
    distance_range: float = 4.0,
    potential_range: float = 1.5,
    n_classes: int = 4,
    n_bins: int = 64,
) -> Tensor:
    """Return the histogram of distances for every unordered pair of potential classes (Rustamov 2010, section 4).

    Each unordered pair of distinct points counts once, in the row of the classes of the two points. The classes are
    `n_classes` equal intervals of [0, `potential_range`]. The bins have their centres in the middle of `n_bins` equal
    intervals of [0, `distance_range`]; a distance is shared linearly between the two bins whose centres surround it.
    Values beyond a range count in its last class or bin.

    Args:
        embedding: (P, D) points; their Euclidean distances are counted.
        potential: (P,) non-negative.
        distance_range: end of the last bin.
        potential_range: end of the last class.
        n_classes: C.
        n_bins: B.

    Returns:
        (C(C+1)/2, B) in the embedding's type, float32 at least, of sum 1; row order (0,0), (0,1), … (0,C−1), (1,1), …

    Raises:
        ValueError: there are fewer than two points, shapes of tensors do not match, or values are not finite.
    """
    if embedding.ndim != 2:
        raise ValueError(f"embedding: expected shape (P, D), got {tuple(embedding.shape)}.")
    if potential.shape != embedding.shape[:1]:
        raise ValueError(
            f"potential: expected shape ({len(embedding)},), one per point, got {tuple(potential.shape)}."
        )
    is_sound = (potential >= 0) & torch.isfinite(potential)
    if not bool(is_sound.all()):
        raise ValueError("potential: expected non-negative, finite values, got others.")
    check_at_least(1, n_classes=n_classes)
    check_at_least(2, n_bins=n_bins)
    check_positive(distance_range=distance_range, potential_range=potential_range)
    classes = (potential * (n_classes / potential_range)).long()
    classes = classes.clamp(max=n_classes - 1)
    dtype = torch.promote_types(embedding.dtype, torch.float32)
    numbers = torch.arange(n_bins, dtype=dtype, device=embedding.device)
    centres = (numbers + 0.5) * (distance_range / n_bins)
    memberships = one_hot(classes, n_classes).to(dtype)
    return joint_histogram(memberships, [euclidean_distances(embedding, centres)])

"""Histograms of the pieces of a body without its middle."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from igps._tensors import above_zero
from igps.descriptors.pretrained._merge_tree import merge_trees
from igps.nn.axes.points import soft_memberships
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram
from igps.signature.signature import SampleKind

# Centres of the first and last bins, as logarithms to base 2. Sizes start at one sample in 64. The length of a ball is
# −0.8, and that of a rod a hundred times as long as it is thick is 2.5.
_MIN_SIZE = -6.0
_MAX_SIZE = -0.5
_MIN_LENGTH = -1.0
_MAX_LENGTH = 2.5
_MIN_SAMPLES = 4  # fewer samples do not determine a length


class PieceHistogram(SampleHistogram):
    """Joint histograms of the sizes and lengths of the pieces of a body without its middle, at several levels.

    At each level, a share of the samples remains, those with the largest barycentroid potential: the ends of limbs at
    low levels, whole limbs at middle ones, and the body except its middle at high ones. The pieces are the connected
    components of the remaining samples, see `merge_trees`. Each sample counts in the bins of the size and length of its
    piece. The size is the share of all samples. The length is √(12 λ₁) over the square root of the area of the piece,
    where λ₁ is the largest eigenvalue of the covariance of its samples; for a rod, √(12 λ₁) is its length. Sizes are
    pose-invariant, and so are lengths as long as limbs only rotate.

    The histogram is differentiable in the positions of the samples for fixed pieces; sizes have no gradient.

    Example:
        >>> PieceHistogram([0.1, 0.3]).shape
        (2, 6, 5)

    Args:
        levels: shares of the samples that remain, ascending.
        embedding: of the potential, and of the graph on which pieces are connected.
        samples, n_samples, n_training_samples: see `SampleHistogram`.
        n_bins: of size and length, both in geometric progression.
    """

    sizes: Tensor
    lengths: Tensor

    def __init__(
        self,
        levels: Sequence[float] = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6),
        embedding: nn.Module | None = None,
        samples: SampleKind = "surface",
        *,
        n_bins: tuple[int, int] = (6, 5),
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        is_ascending = list(levels) == sorted(levels)
        if not levels or not is_ascending or not 0 < levels[0] <= levels[-1] <= 1:
            raise ValueError(
                f"levels: expected shares above 0 and up to 1, ascending, got {tuple(levels)}."
            )
        if len(n_bins) != 2 or min(n_bins) < 2:
            raise ValueError(f"n_bins: expected two numbers, each at least 2, got {n_bins}.")
        self.levels = tuple(levels)
        self.n_bins = n_bins
        self.embedding = embedding or SpectralEmbedding()
        n_sizes, n_lengths = n_bins
        self.register_buffer("sizes", torch.linspace(_MIN_SIZE, _MAX_SIZE, n_sizes))
        self.register_buffer("lengths", torch.linspace(_MIN_LENGTH, _MAX_LENGTH, n_lengths))

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of levels, and of the bins of size and length."""
        return (len(self.levels), *self.n_bins)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, L, ...) histograms of the samples of N shapes."""
        mask = features.samples.mask
        points = features.positions()
        weights = features.weights_or_ones(points[..., 0])
        points = points.masked_fill(~mask[:, :, None], 0)
        is_traced = torch.compiler.is_compiling()  # traced code cannot depend on values of tensors
        if not is_traced and not torch.isfinite(points).all():
            raise ValueError("PieceHistogram: expected finite positions, got NaN or infinity.")
        _, peaks = merge_trees(features, self.embedding, self.levels)
        remains = peaks >= 0
        n_samples = mask.shape[1]
        # The pieces of a level are numbered in the order of their peaks. Samples that do not remain get a piece, too,
        # but are left out of all sums.
        is_peak = peaks == torch.arange(n_samples, device=peaks.device)
        numbers = is_peak.cumsum(dim=2) - 1
        piece = numbers.gather(2, peaks.clamp_min(0))
        piece = piece.masked_fill(~remains, 0)
        n_pieces = n_samples if is_traced else int(piece.max()) + 1

        def sums(values: Tensor) -> Tensor:
            """Sum values (N, P, k) or (N, L, P, k) of the samples over each piece: (N, L, pieces, k)."""
            if values.ndim == 3:
                values = values[:, None]
            values = torch.where(remains[..., None], values, 0)
            zeros = values.new_zeros(*remains.shape[:2], n_pieces, values.shape[-1])
            index = piece[..., None].expand_as(values)
            return zeros.scatter_add(2, index, values)

        n_points = sums(torch.ones_like(points[..., :1])).clamp_min(1)
        means = sums(points) / n_points
        index = piece[..., None].expand(*remains.shape, 3)
        centred = points[:, None] - means.gather(2, index)
        products = centred[..., :, None] * centred[..., None, :]
        covariance = sums(products.flatten(3)) / n_points
        # Small pieces get distinct eigenvalues: equal ones have no second derivatives.
        is_small = n_points < _MIN_SAMPLES
        distinct = covariance.new_tensor([1, 0, 0, 0, 2, 0, 0, 0, 3])
        covariance = torch.where(is_small, distinct, covariance)
        eigenvalues = torch.linalg.eigvalsh(covariance.unflatten(3, (3, 3)))
        largest = eigenvalues[..., -1]
        sizes = n_points[..., 0] / mask.sum(dim=1)[:, None, None]
        squared_lengths = 12 * torch.where(is_small[..., 0], 0, largest) / sizes
        log_lengths = above_zero(squared_lengths).log2() / 2
        piece_weights = sums(weights[..., None].to(points.dtype))
        by_size = soft_memberships(sizes.log2(), self.sizes) * piece_weights
        by_length = soft_memberships(log_lengths, self.lengths)
        counts = by_size.mT @ by_length
        n_counted = remains.sum(dim=(1, 2))
        return counts / n_counted[:, None, None, None]

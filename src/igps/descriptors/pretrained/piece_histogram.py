"""Into which pieces a body falls when its middle is taken away."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from igps.descriptors.pretrained._merge_tree import merge_trees
from igps.nn.axes.points import soft_memberships
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram
from igps.signature.signature import SampleKind

# Centres are logarithms to base 2. Of sizes, from one sample in 64 on
_SMALLEST, _LARGEST = -6.0, -0.5
# Of lengths: a ball lies at −0.8, a rod that is a hundred times as long as it is thick at 2.5
_ROUNDEST, _LONGEST = -1.0, 2.5
# Of fewer samples the length says nothing
_FEWEST = 4


class PieceHistogram(SampleHistogram):
    """How large and how long the pieces are that are left of a body without its middle, at several levels.

    At each level a share of the samples is left, those of the largest barycentroid potential: first the ends of limbs,
    then whole limbs, at last the body but for its middle. Each sample counts by the size of the piece it belongs to, as
    a share of all samples, and by the length of that piece, √(12 λ₁), λ₁ the largest eigenvalue of the covariance of
    its samples (a rod's own length), over the root of its area. Sizes are pose-invariant, and so are lengths as long as
    limbs only turn. Pieces are those of `merge_trees`.

    The histogram is differentiable in places within given pieces; sizes have no gradient.

    Example:
        >>> PieceHistogram([0.1, 0.3]).shape
        (2, 6, 5)

    Args:
        levels: shares of the samples, ascending.
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
        if not levels or list(levels) != sorted(levels) or not 0 < levels[0] <= levels[-1] <= 1:
            raise ValueError(f"levels: expected shares above 0 and up to 1, ascending, got {tuple(levels)}.")
        if len(n_bins) != 2 or min(n_bins) < 2:
            raise ValueError(f"n_bins: expected two numbers, each at least 2, got {n_bins}.")
        self.levels, self.n_bins = tuple(levels), n_bins
        self.embedding = embedding or SpectralEmbedding()
        self.register_buffer("sizes", torch.linspace(_SMALLEST, _LARGEST, n_bins[0]))
        self.register_buffer("lengths", torch.linspace(_ROUNDEST, _LONGEST, n_bins[1]))

    @property
    def shape(self) -> tuple[int, ...]:
        """Levels, and the bins of size and length."""
        return (len(self.levels), *self.n_bins)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, L, ...) histograms of some samples of N shapes."""
        mask, points = features.samples.mask, features.positions()
        if not torch.isfinite(points.masked_fill(~mask[:, :, None], 0)).all():
            raise ValueError("PieceHistogram: expected finite places, got NaN or infinity.")
        trees = merge_trees(features, self.embedding, self.levels)
        pieces = torch.stack([tree.pieces for tree in trees]).to(points.device)
        left, weights = pieces >= 0, features.weights_or_ones(points[..., 0])
        # Pieces of all levels of all bodies at once, those of each level side by side
        n_shapes, n_levels, longest = left.shape
        levels = torch.arange(n_shapes * n_levels, device=pieces.device).view(n_shapes, n_levels, 1)
        found, piece, n_points = (pieces + longest * levels)[left].unique(return_inverse=True, return_counts=True)
        points = points[:, None].expand(*left.shape, 3)[left]
        weights = weights[:, None].expand_as(left)[left].to(points.dtype)

        def sums(values: Tensor) -> Tensor:
            return values.new_zeros(len(found), *values.shape[1:]).index_add(0, piece, values)

        places = points - (sums(points) / n_points[:, None])[piece]
        covariance = sums((places[:, :, None] * places[:, None, :]).flatten(1)) / n_points[:, None]
        spread = torch.linalg.eigvalsh(covariance.view(-1, 3, 3))[:, -1]
        level = found // longest
        sizes = (n_points / mask.sum(dim=1)[level // n_levels]).to(points.dtype)
        lengths = 12 * torch.where(n_points < _FEWEST, 0, spread) / sizes
        lengths = lengths.clamp_min(torch.finfo(points.dtype).tiny).log2() / 2
        of_sizes = soft_memberships(sizes.log2(), self.sizes) * sums(weights)[:, None]
        cells = of_sizes[:, :, None] * soft_memberships(lengths, self.lengths)[:, None, :]
        counts = cells.new_zeros(n_shapes * n_levels, *self.n_bins).index_add(0, level, cells)
        return counts.view(n_shapes, *self.shape) / left.sum(dim=(1, 2))[:, None, None, None]

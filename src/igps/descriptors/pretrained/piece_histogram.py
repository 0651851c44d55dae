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
        points, weights = points.masked_fill(~mask[:, :, None], 0), features.weights_or_ones(points[..., 0])
        traced = torch.compiler.is_compiling()  # what is traced cannot look at numbers
        if not traced and not torch.isfinite(points).all():
            raise ValueError("PieceHistogram: expected finite places, got NaN or infinity.")
        _, peaks = merge_trees(features, self.embedding, self.levels)
        left, n_longest = peaks >= 0, mask.shape[1]
        # Pieces of a level are numbered by their peaks, and samples that are not left count nowhere
        numbers = (peaks == torch.arange(n_longest, device=peaks.device)).cumsum(dim=2) - 1
        piece = numbers.gather(2, peaks.clamp_min(0)).masked_fill(~left, 0)
        n_pieces = n_longest if traced else int(piece.max()) + 1

        def sums(values: Tensor) -> Tensor:
            """(N, L, pieces, k) of values (N, P, k) or (N, L, P, k) of the samples."""
            of_left = torch.where(left[..., None], values if values.ndim == 4 else values[:, None], 0)
            into = of_left.new_zeros(*left.shape[:2], n_pieces, values.shape[-1])
            return into.scatter_add(2, piece[..., None].expand_as(of_left), of_left)

        n_points = sums(torch.ones_like(points[..., :1])).clamp_min(1)
        means = sums(points) / n_points
        places = points[:, None] - means.gather(2, piece[..., None].expand(*left.shape, 3))
        covariance = sums((places[..., :, None] * places[..., None, :]).flatten(3)) / n_points
        few = n_points < _FEWEST  # eigenvalues that are equal have no second derivatives
        covariance = torch.where(few, covariance.new_tensor([1, 0, 0, 0, 2, 0, 0, 0, 3]), covariance)
        spread = torch.linalg.eigvalsh(covariance.unflatten(3, (3, 3)))[..., -1]
        sizes = n_points[..., 0] / mask.sum(dim=1)[:, None, None]
        lengths = 12 * torch.where(few[..., 0], 0, spread) / sizes
        lengths = lengths.clamp_min(torch.finfo(points.dtype).tiny).log2() / 2
        of_sizes = soft_memberships(sizes.log2(), self.sizes) * sums(weights[..., None].to(points.dtype))
        counts = of_sizes.mT @ soft_memberships(lengths, self.lengths)
        return counts / left.sum(dim=(1, 2))[:, None, None, None]

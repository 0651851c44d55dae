"""Histograms of the number and lengths of a body's limbs."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps._parameters import check_at_least
from igps.descriptors.pretrained._merge_tree import merge_tree, merge_trees
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram
from igps.signature.signature import SampleKind


class BranchHistogram(SampleHistogram):
    """Lengths of a body's limbs as shares of their sum, the longest first.

    The barycentroid potential U is least in the middle of a body and has a peak at the end of each limb. The limbs are
    the branches of the merge tree of log U, on the graph of nearest samples in the embedding. The length of a limb is
    the height of its peak above the saddle where it joins another limb; the first limb reaches from the middle of the
    body to the farthest end. So a body with six equal legs has six equal shares in any pose. Histograms of pairs cannot
    count: six limbs differ little from five in them. Source: see `merge_tree`.

    The histogram is differentiable in the potential.

    Example:
        >>> BranchHistogram().shape
        (16,)

    Args:
        embedding: of the potential and of the graph.
        samples, n_samples, n_training_samples: see `SampleHistogram`.
        n_branches: number of limbs, the longest ones; the others are left out.
    """

    def __init__(
        self,
        embedding: nn.Module | None = None,
        samples: SampleKind = "surface",
        *,
        n_branches: int = 16,
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        check_at_least(2, n_branches=n_branches)
        self.embedding = embedding or SpectralEmbedding()
        self.n_branches = n_branches

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of branches."""
        return (self.n_branches,)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, B) histograms of the samples of N shapes."""
        mask = features.samples.mask
        saddles, _ = merge_trees(features, self.embedding)
        heights = features.log_potential(self.embedding).masked_fill(~mask, 0)
        above_saddle = heights - heights.gather(1, saddles)
        lengths, longest = above_saddle.sort(dim=1, descending=True)
        lengths = lengths[:, : self.n_branches]
        longest = longest[:, : self.n_branches]
        total = lengths.sum(dim=1, keepdim=True)
        shares = lengths / torch.where(total > 0, total, 1)
        weights = features.weights()
        if weights is not None:
            bodies = zip(
                saddles.cpu(),
                longest.cpu(),
                heights.detach().cpu(),
                features.neighbours(self.embedding).cpu(),
                mask.cpu(),
                strict=True,
            )
            limbs = torch.stack([_limbs(*body) for body in bodies]).to(weights)
            limb_weights = (limbs @ weights[:, :, None])[:, :, 0]
            limb_sizes = limbs.sum(dim=2).clamp_min(1)
            shares = shares * limb_weights / limb_sizes
        histogram = functional.pad(shares, (0, self.n_branches - shares.shape[1]))
        # If the potential is constant, the only branch has length 0.
        single = functional.pad(torch.ones_like(total), (0, self.n_branches - 1))
        return torch.where(total > 0, histogram, single)


def _limbs(
    saddles: Tensor, longest: Tensor, heights: Tensor, neighbours: Tensor, mask: Tensor
) -> Tensor:
    """(B, P) whether each sample belongs to each of the longest branches: to its piece just above its saddle."""
    order = heights.masked_fill(~mask, -torch.inf).argsort(descending=True, stable=True)
    n_above = order.argsort()[saddles[longest]].clamp_min(1)
    counts, level = n_above.unique(return_inverse=True)
    pieces = merge_tree(heights, neighbours, counts.tolist(), mask).pieces
    return pieces[level] == longest[:, None]

"""How many limbs the samples of a body make, and how far each reaches."""

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
    """How the length of a body's limbs is shared among them, the longest first.

    The barycentroid potential U is least in the middle of a body and has a peak at the end of each limb. The branches
    of the merge tree of log U, on the graph of nearest samples in the embedding, are the limbs, each as long as its
    peak is above where it joins another; the first reaches from the middle to the end that is farthest. So a body of
    six like legs has six like shares, however it holds them. Histograms of pairs cannot count: to them, six limbs
    differ little from five. Source: `merge_tree`.

    The histogram is differentiable in the potential.

    Example:
        >>> BranchHistogram().shape
        (16,)

    Args:
        embedding: of the potential and of the graph.
        samples, n_samples, n_training_samples: see `SampleHistogram`.
        n_branches: how many of the longest are told; the others are left out.
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
        """Branches."""
        return (self.n_branches,)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, B) histograms of some samples of N shapes."""
        (ends, _), mask = merge_trees(features, self.embedding), features.samples.mask
        heights = features.log_potential(self.embedding).masked_fill(~mask, 0)
        lengths, longest = (heights - heights.gather(1, ends)).sort(dim=1, descending=True)
        lengths, longest = lengths[:, : self.n_branches], longest[:, : self.n_branches]
        total = lengths.sum(dim=1, keepdim=True)
        shares = lengths / torch.where(total > 0, total, 1)
        if (weights := features.weights()) is not None:
            asked = ends, longest, heights.detach(), features.neighbours(self.embedding), mask
            limbs = torch.stack([_limbs(*body) for body in zip(*(one.cpu() for one in asked), strict=True)]).to(weights)
            shares = shares * (limbs @ weights[:, :, None])[:, :, 0] / limbs.sum(dim=2).clamp_min(1)
        found = functional.pad(shares, (0, self.n_branches - shares.shape[1]))
        # A body that is the same everywhere has one branch, of no length.
        return torch.where(total > 0, found, functional.pad(torch.ones_like(total), (0, self.n_branches - 1)))


def _limbs(ends: Tensor, longest: Tensor, heights: Tensor, neighbours: Tensor, mask: Tensor) -> Tensor:
    """(B, P) the samples of each of the longest branches: those of its piece before it joins another."""
    order = heights.masked_fill(~mask, -torch.inf).argsort(descending=True, stable=True)
    above = order.argsort()[ends[longest]].clamp_min(1)
    levels, which = above.unique(return_inverse=True)
    return merge_tree(heights, neighbours, levels.tolist(), mask).pieces[which] == longest[:, None]

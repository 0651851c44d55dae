"""How many limbs the samples of a body make, and how far each reaches."""

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from igps._parameters import check_at_least
from igps.descriptors.pretrained._merge_tree import MergeTree, merge_tree, merge_trees
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
        trees, heights = merge_trees(features, self.embedding), features.log_potential(self.embedding)
        peaks, saddles = (
            pad_sequence(list(one), batch_first=True).to(heights.device)
            for one in zip(*((tree.peaks, tree.saddles) for tree in trees), strict=True)
        )
        lengths, longest = (heights.gather(1, peaks) - heights.gather(1, saddles)).sort(dim=1, descending=True)
        lengths = lengths[:, : self.n_branches]
        total = lengths.sum(dim=1, keepdim=True)
        shares = lengths / torch.where(total > 0, total, 1)
        if (weights := features.weights()) is not None:
            asked = longest[:, : self.n_branches], heights.detach(), features.neighbours(self.embedding)
            of_bodies = zip(trees, *(one.cpu() for one in (*asked, features.samples.mask)), strict=True)
            limbs = torch.stack([_limbs(*body) for body in of_bodies]).to(weights)
            shares = shares * (limbs @ weights[:, :, None])[:, :, 0] / limbs.sum(dim=2).clamp_min(1)
        found = functional.pad(shares, (0, self.n_branches - shares.shape[1]))
        # A body that is the same everywhere has one branch, of no length.
        return torch.where(total > 0, found, functional.one_hot(torch.zeros_like(peaks[:, 0]), self.n_branches))


def _limbs(tree: MergeTree, longest: Tensor, heights: Tensor, neighbours: Tensor, mask: Tensor) -> Tensor:
    """(B, P) the samples of each of the longest branches: those of its piece before it joins another."""
    kept = longest[longest < len(tree.peaks)]
    order = heights.masked_fill(~mask, -torch.inf).argsort(descending=True, stable=True)
    above = order.argsort()[tree.saddles[kept]].clamp_min(1)
    levels, which = above.unique(return_inverse=True)
    pieces = merge_tree(heights, neighbours, levels.tolist(), mask).pieces[which]
    limbs = torch.zeros(len(longest), len(heights), dtype=torch.bool, device="cpu")
    limbs[: len(kept)] = pieces == tree.peaks[kept][:, None]
    return limbs

"""How many limbs the samples of a body make, and how far each reaches."""

import torch
from torch import Tensor, nn

from igps.descriptors.pretrained._merge_tree import merge_tree
from igps.nn.batch_features import SampleFeatures, SampleKind
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram, present


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
        if n_branches < 2:
            raise ValueError(f"n_branches: expected at least 2, got {n_branches}.")
        self.embedding = embedding or SpectralEmbedding()
        self.n_branches = n_branches

    @property
    def shape(self) -> tuple[int, ...]:
        """Branches."""
        return (self.n_branches,)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, B) histograms of some samples of N shapes."""
        heights, neighbours = features.log_potential(self.embedding), features.neighbours(self.embedding)
        weights = features.weights()
        found = []
        for i, real in enumerate(present(features)):
            found.append(self._of_shape(heights[i, real], neighbours[i], None if weights is None else weights[i, real]))
        return torch.stack(found)

    def _of_shape(self, heights: Tensor, neighbours: Tensor, weights: Tensor | None) -> Tensor:
        tree = merge_tree(heights, neighbours)
        lengths, longest = (heights[tree.peaks] - heights[tree.saddles]).sort(descending=True)
        lengths, longest = lengths[: self.n_branches], longest[: self.n_branches]
        found = heights.new_zeros(self.n_branches)
        if not lengths[0] > 0:  # a body that is the same everywhere has one branch, of no length
            found[0] = 1
            return found
        shares = lengths / lengths.sum()
        if weights is not None:  # a limb counts as its samples do: those of the piece that joins no other yet
            places = torch.argsort(torch.argsort(heights, descending=True, stable=True))
            counts = sorted({max(1, int(places[saddle])) for saddle in tree.saddles[longest]})
            pieces = dict(zip(counts, merge_tree(heights, neighbours, counts).pieces, strict=True))
            limbs = [pieces[max(1, int(places[tree.saddles[one]]))] == tree.peaks[one] for one in longest]
            shares = shares * torch.stack([weights[limb].mean() for limb in limbs])
        found[: len(lengths)] = shares
        return found

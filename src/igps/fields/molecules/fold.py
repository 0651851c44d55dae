"""The descriptor `fold`: distances between residues, by how far apart these stand along the chain.

Nothing in it depends on the kinds of the residues, so two proteins of one fold are near each other, whatever their
sequences are. See `igps.fields.molecules.trace` for the attribute from which it is computed.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from igps.data.requirements import Requirements
from igps.nn._kernels.pair_values import PairValues, euclidean_distances
from igps.nn._kernels.pairs import count_pairs
from igps.nn.axes import OrderedCentres, PairAxis
from igps.nn.axes.pairs import DistanceAxis
from igps.nn.axes.points import attribute_requirements
from igps.nn.batch_features import SampleFeatures
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram

TRACE = "trace"
"""The attribute with the position of the nearest residue, Å, and its place along the chain: (P, 4)."""

# Residues apart along the chain; pairs of the first two classes, the same or the next residue, are not compared.
_SEPARATIONS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 9.0, 12.5, 17.5, 25.0, 37.0, 57.0, 89.0, 130.0)
_N_NEIGHBOURS = 2
_N_BINS = 32
_REACH = 40.0  # Å
_N_SAMPLES = 2000


class ChainSeparation(PairAxis):
    """Classes of the separation of two residues along their chain, in residues."""

    def __init__(self, centres: Sequence[float] = _SEPARATIONS) -> None:
        super().__init__()
        self.centres = OrderedCentres(centres)

    @property
    def shape(self) -> tuple[int, ...]:
        """(S,)."""
        return (len(self.centres.start),)

    def requirements(self, embedding: torch.nn.Module) -> Requirements:
        """Return the requirement of the trace."""
        return attribute_requirements(TRACE)

    def pairs(self, features: SampleFeatures, embedding: torch.nn.Module) -> PairValues:
        """Return the separations of the residues that are nearest to the samples."""
        places = features.attribute(TRACE)[..., 3]
        return PairValues((places,), (self.centres(),), _separations)


class ResidueDistance(DistanceAxis):
    """Bins of the distance between two residues (Cα in proteins), Å; see `DistanceAxis`."""

    def requirements(self, embedding: torch.nn.Module) -> Requirements:
        """Return the requirement of the trace."""
        return attribute_requirements(TRACE)

    def pairs(self, features: SampleFeatures, embedding: torch.nn.Module) -> PairValues:
        """Return the distances of the residues that are nearest to the samples."""
        return euclidean_distances(features.attribute(TRACE)[..., :3], self.centres())


class FoldHistogram(SampleHistogram):
    """Distances between the residues of a chain, a histogram of sum 1 for each class of separation along the chain.

    Every residue that is nearest to a sample counts once, however many samples are near it.

    Args:
        n_bins, reach: bins of the distance, see `ResidueDistance`.
        n_samples: see `SampleHistogram`.
    """

    degree = 2
    label = "fold"

    def __init__(
        self, n_bins: int = _N_BINS, reach: float = _REACH, *, n_samples: int | None = _N_SAMPLES
    ) -> None:
        super().__init__("interior", n_samples)
        self.separation = ChainSeparation()
        self.distance = ResidueDistance(n_bins, reach)
        self.embedding = SpectralEmbedding(n_eigenpairs=1)  # the axes use none

    @property
    def shape(self) -> tuple[int, ...]:
        """(S, B)."""
        return (self.separation.shape[0] - _N_NEIGHBOURS, *self.distance.shape)

    @property
    def requirements(self) -> Requirements:
        """Return the requirement of the trace."""
        return attribute_requirements(TRACE)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """Return histograms (N, S, B) of the samples of N shapes; rows without a pair are 0."""
        mask = features.samples.mask
        axes = (self.separation, self.distance)
        pairs = [axis.pairs(features, self.embedding) for axis in axes]
        weights = _residue_weights(features.attribute(TRACE)[..., 3], mask)
        weights = weights * features.weights_or_ones(weights)
        classes = torch.zeros(*mask.shape, 1, dtype=torch.long, device=mask.device)
        counts = count_pairs(classes, weights.unsqueeze(2), 1, pairs, mask)
        rows = counts[:, 0, _N_NEIGHBOURS:]
        # The sums depend on the weights of the samples, but on no other input that may have gradients.
        sums = rows.sum(dim=2, keepdim=True).detach()
        shares = torch.where(sums > 0, rows / sums.clamp_min(torch.finfo(sums.dtype).tiny), 0)
        n_rows = (sums > 0).sum(dim=1, keepdim=True)
        return shares / n_rows.clamp_min(1)


def _separations(rows: Sequence[Tensor], columns: Sequence[Tensor]) -> Tensor:
    """Return the separations (N, 1, I, J) of places (N, I) and (N, J)."""
    return (rows[0].unsqueeze(2) - columns[0].unsqueeze(1)).abs().unsqueeze(1)


def _residue_weights(places: Tensor, mask: Tensor) -> Tensor:
    """Return weights (N, P) of samples, by their places (N, P), that add up to 1 for each residue."""
    is_same = (places.unsqueeze(2) == places.unsqueeze(1)) & mask.unsqueeze(1)
    return 1 / is_same.sum(dim=2).clamp_min(1).to(places.dtype)


def fold() -> HistogramDescriptor:
    """Histograms of the distances between residues, one for each class of their separation along the chain.

    Source: Rustamov 2010, section 4, for attributes as further dimensions.
    """
    return HistogramDescriptor(
        FoldHistogram(), name="fold", source="Rustamov 2010, section 4", invariant_to=("motion",)
    )

"""The descriptor `fold`: how residues lie to each other, by how far apart they stand along the chain.

Nothing in it depends on the kinds of the residues, so two proteins of one fold are near each other, whatever their
sequences are.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from igps.data.requirements import Requirements
from igps.nn._kernels.pairs import count_pairs
from igps.nn._kernels.pairs_by_torch import PairValues, euclidean_distances, pair_twists
from igps.nn.axes import OrderedCentres, PairAxis
from igps.nn.axes.points import attribute_requirements
from igps.nn.batch_features import SampleFeatures
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import SampleHistogram

TRACE = "trace"
"""The attribute of samples from which `fold` is computed, see `residue_attributes.trace`."""

# Residues apart along the chain; pairs of the first two classes, the same or the next residue, are not compared.
_SEPARATIONS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 9.0, 12.5, 17.5, 25.0, 37.0, 57.0, 89.0, 130.0)
_N_NEIGHBOURS = 2
# The separation at which a class counts half as much as near ones: far residues move as domains move.
_HALF_SEPARATION = 10.0
# The number of pairs at which a class counts half as much as one of many pairs: few pairs tell little.
_FEW_PAIRS = 2000.0
_DISTANCES = (2.5, 7.5, 12.5, 17.5, 22.5, 27.5, 32.5, 37.5)  # Å
# Centres of the classes of the angle and of the twist between two directions of the chain.
_TURNS = (-0.8, -0.4, 0.0, 0.4, 0.8)
_N_SAMPLES = 2000


class _TraceAxis(PairAxis):
    """Base class of axes of the residues that are nearest to the samples."""

    def __init__(self, centres: Sequence[float]) -> None:
        super().__init__()
        self.centres = OrderedCentres(centres)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of classes."""
        return (len(self.centres.start),)

    def requirements(self, embedding: torch.nn.Module) -> Requirements:
        """Return the requirement of the trace."""
        return attribute_requirements(TRACE)


class ChainSeparation(_TraceAxis):
    """Classes of the separation of two residues along their chain, in residues."""

    def pairs(self, features: SampleFeatures, embedding: torch.nn.Module) -> PairValues:
        """Return the differences of the places of the residues."""
        places = features.attribute(TRACE)[..., 6]
        return PairValues((places,), (self.centres(),), _separations)


class ResidueDistance(_TraceAxis):
    """Bins of the distance between two residues (Cα in proteins), Å."""

    def pairs(self, features: SampleFeatures, embedding: torch.nn.Module) -> PairValues:
        """Return the distances of the residues."""
        return euclidean_distances(features.attribute(TRACE)[..., :3], self.centres())


class ChainCosine(_TraceAxis):
    """Classes of the cosine of the angle between the directions of the chain at two residues."""

    def pairs(self, features: SampleFeatures, embedding: torch.nn.Module) -> PairValues:
        """Return the inner products of the directions."""
        return PairValues((features.attribute(TRACE)[..., 3:6],), (self.centres(),), _cosines)


class ChainTwist(_TraceAxis):
    """Classes of the twist of the chain between two residues, see `pair_twists`: mirror images have opposite signs."""

    def pairs(self, features: SampleFeatures, embedding: torch.nn.Module) -> PairValues:
        """Return the twists of the positions and directions."""
        trace = features.attribute(TRACE)
        return pair_twists(trace[..., :3], trace[..., 3:6], self.centres())


class FoldHistogram(SampleHistogram):
    """Distances, angles and twists of pairs of residues, a histogram for each class of separation along the chain.

    The weight of a class falls to a half at a separation of 10 residues, as far residues move with domains, and is a
    half with 2000 pairs, as fewer pairs scatter more. The weights of all classes sum to 1. Every residue that is the
    nearest of a sample counts once, however many samples are near it.

    Args:
        n_samples: see `SampleHistogram`.
    """

    degree = 2
    label = "fold"

    def __init__(self, n_samples: int | None = _N_SAMPLES) -> None:
        super().__init__("interior", n_samples)
        self.separation = ChainSeparation(_SEPARATIONS)
        self.others = torch.nn.ModuleList(
            [ResidueDistance(_DISTANCES), ChainCosine(_TURNS), ChainTwist(_TURNS)]
        )
        self.embedding = SpectralEmbedding(n_eigenpairs=1)  # the axes use none

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of classes of separation, of distance, of the cosine and of the twist."""
        bins = [n for axis in self.others for n in cast(_TraceAxis, axis).shape]
        return (self.separation.shape[0] - _N_NEIGHBOURS, *bins)

    @property
    def requirements(self) -> Requirements:
        """Return the requirement of the trace, without eigenpairs."""
        return replace(attribute_requirements(TRACE), eigenpairs=False)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """Return histograms (N, S, B, 5, 5) of the samples of N shapes; classes without a pair are 0."""
        mask = features.samples.mask
        axes = [self.separation, *self.others]
        pairs = [axis.pairs(features, self.embedding) for axis in axes]
        weights = _residue_weights(features.attribute(TRACE)[..., 6], mask)
        weights = weights * features.weights_or_ones(weights)
        classes = torch.zeros(*mask.shape, 1, dtype=torch.long, device=mask.device)
        counts = count_pairs(classes, weights.unsqueeze(2), 1, pairs, mask)
        rows = counts[:, 0, _N_NEIGHBOURS:].flatten(2)
        # The sums depend on the weights of the samples, but on no other input that may have gradients.
        sums = rows.sum(dim=2, keepdim=True).detach()
        tiny = torch.finfo(sums.dtype).tiny
        n_points = mask.sum(dim=1).view(-1, 1, 1)
        n_pairs = sums * (n_points * (n_points - 1) / 2)
        separations = self.separation.centres()[_N_NEIGHBOURS:, None]
        shares = n_pairs / (n_pairs + _FEW_PAIRS) / (1 + separations / _HALF_SEPARATION)
        shares = shares / shares.sum(dim=1, keepdim=True).clamp_min(tiny)
        cells = rows / sums.clamp_min(tiny) * shares
        return cells.unflatten(2, counts.shape[3:])


def _separations(rows: Sequence[Tensor], columns: Sequence[Tensor]) -> Tensor:
    """Return the separations (N, 1, I, J) of places (N, I) and (N, J)."""
    return (rows[0].unsqueeze(2) - columns[0].unsqueeze(1)).abs().unsqueeze(1)


def _cosines(rows: Sequence[Tensor], columns: Sequence[Tensor]) -> Tensor:
    """Return the inner products (N, 1, I, J) of directions (N, I, 3) and (N, J, 3)."""
    return (rows[0] @ columns[0].mT).unsqueeze(1)


def _residue_weights(places: Tensor, mask: Tensor) -> Tensor:
    """Return weights (N, P) of samples, by their places (N, P), that add up to 1 for each residue."""
    is_same = (places.unsqueeze(2) == places.unsqueeze(1)) & mask.unsqueeze(1)
    return 1 / is_same.sum(dim=2).clamp_min(1).to(places.dtype)


def fold() -> HistogramDescriptor:
    """Histograms of distances, angles and twists between residues, one for each class of separation along the chain.

    The layout was chosen on bent, deformed, changed and permuted chains that were made for that; see the documentation.

    Source: Rustamov 2010, section 4, for attributes as further dimensions.
    """
    return HistogramDescriptor(FoldHistogram(), name="fold", source="Rustamov 2010, section 4")

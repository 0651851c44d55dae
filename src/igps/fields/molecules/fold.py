"""The descriptor `fold`: how residues lie to each other, by how far apart they stand along the chain.

Nothing in it depends on the kinds of the residues, so two proteins of one fold are near each other, whatever their
sequences are.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from igps._tensors import above_zero
from igps.data.requirements import Requirements
from igps.nn._kernels.pairs import count_pairs
from igps.nn._kernels.pairs_by_torch import PairValues, euclidean_distances, pair_twists
from igps.nn.axes import OrderedCentres
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
_HALF_SEPARATION = 20.0
# The number of pairs at which a class counts half as much as one of many pairs: few pairs tell little.
_FEW_PAIRS = 2000.0
_DISTANCES = (4.0, 12.0, 20.0, 28.0, 36.0)  # Å
# Centres of the classes of the angle and of the twist between two directions of the chain.
_TURNS = (-0.75, -0.25, 0.25, 0.75)
# Å of the chain for each residue, of a helix and of a strand; residues between them are shared.
_RISES = (1.75, 3.0)
_N_SAMPLES = 2000


class FoldHistogram(SampleHistogram):
    """Distances, angles and twists of pairs of residues, a histogram for each class of separation along the chain.

    Pairs are told apart by how much the chain rises with each residue, at the earlier and at the later one: helices
    from strands. The weight of a class of separation falls to a half at 20 residues, as far residues move with domains,
    and is a half with 2000 pairs, as fewer pairs scatter more. The weights of all classes sum to 1. Every residue that
    is the nearest of a sample counts once, however many samples are near it.

    Args:
        n_samples, n_training_samples: see `SampleHistogram`.
        learnable: whether the centres of rises, distances, angles and twists are parameters.
    """

    degree = 2
    label = "fold"

    def __init__(
        self,
        n_samples: int | None = _N_SAMPLES,
        n_training_samples: int | None = None,
        *,
        learnable: bool = False,
    ) -> None:
        super().__init__("interior", n_samples, n_training_samples)
        self.separations = OrderedCentres(_SEPARATIONS)
        self.rises = OrderedCentres(_RISES, learnable)
        self.distances = OrderedCentres(_DISTANCES, learnable)
        self.turns = OrderedCentres(_TURNS, learnable)
        self.embedding = SpectralEmbedding(n_eigenpairs=1)  # none is used

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of classes of separation, of both rises, of distance, of the cosine and of the twist."""
        bins = [len(c) for c in (_RISES, _RISES, _DISTANCES, _TURNS, _TURNS)]
        return (len(_SEPARATIONS) - _N_NEIGHBOURS, *bins)

    @property
    def requirements(self) -> Requirements:
        """Return the requirement of the trace, without eigenpairs."""
        return replace(attribute_requirements(TRACE), eigenpairs=False)

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """Return histograms (N, S, 2, 2, B, 4, 4) of the samples of N shapes; classes without a pair are 0."""
        trace = features.attribute(TRACE)
        positions = trace[..., :3]
        directions = trace[..., 3:6]
        places = trace[..., 7]
        pairs = [
            PairValues((places,), (self.separations(),), _separations),
            PairValues((trace[..., 6:],), (self.rises(), self.rises()), _rises),
            euclidean_distances(positions, self.distances()),
            PairValues((directions,), (self.turns(),), _cosines),
            pair_twists(positions, directions, self.turns()),
        ]
        samples = features.weights_or_ones(places)
        weights, mask = _residues(places, samples, features.samples.mask)
        classes = torch.zeros(*mask.shape, 1, dtype=torch.long, device=mask.device)
        counts = count_pairs(classes, weights.unsqueeze(2), 1, pairs, mask)
        counts = counts[:, 0, _N_NEIGHBOURS:]
        n_residues = mask.sum(dim=1).view(-1, 1, 1)
        rows = counts.flatten(2).masked_fill(n_residues < 2, 0.0)  # without a pair
        # The sums depend on the weights of the samples, but on no other input that may have gradients.
        sums = rows.sum(dim=2, keepdim=True).detach()
        shares = self._shares(sums, n_residues)
        shares = shares / above_zero(shares.sum(dim=1, keepdim=True))
        cells = rows / above_zero(sums) * shares
        return cells.unflatten(2, counts.shape[2:])

    def _shares(self, sums: Tensor, n_residues: Tensor) -> Tensor:
        """Return the weights (N, S, 1) of the classes of separation, by their parts of all pairs of N shapes."""
        n_pairs = sums * (n_residues * (n_residues - 1) / 2)
        separations = self.separations()[_N_NEIGHBOURS:, None]
        return n_pairs / (n_pairs + _FEW_PAIRS) / (1 + separations / _HALF_SEPARATION)


def _separations(rows: Sequence[Tensor], columns: Sequence[Tensor]) -> Tensor:
    """Return the separations (N, 1, I, J) of places (N, I) and (N, J)."""
    (one,) = rows
    (other,) = columns
    return (one.unsqueeze(2) - other.unsqueeze(1)).abs().unsqueeze(1)


def _rises(rows: Sequence[Tensor], columns: Sequence[Tensor]) -> Tensor:
    """Return the rises (N, 2, I, J) at the earlier and the later residue, of rises and places (N, I, 2), (N, J, 2)."""
    (one,) = rows
    (other,) = columns
    rise, place = one.unsqueeze(2).unbind(dim=-1)
    other_rise, other_place = other.unsqueeze(1).unbind(dim=-1)
    is_earlier = place < other_place
    earlier = torch.where(is_earlier, rise, other_rise)
    later = torch.where(is_earlier, other_rise, rise)
    return torch.stack([earlier, later], dim=1)


def _cosines(rows: Sequence[Tensor], columns: Sequence[Tensor]) -> Tensor:
    """Return the inner products (N, 1, I, J) of directions (N, I, 3) and (N, J, 3)."""
    (one,) = rows
    (other,) = columns
    return (one @ other.mT).unsqueeze(1)


def _residues(places: Tensor, weights: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean weight (N, P) of the samples of the same residue, and whether a sample is the first of its own.

    Args:
        places: (N, P) of the residues of samples; those of two residues differ.
        weights: (N, P) of the samples.
        mask: (N, P) true where a sample is real.
    """
    is_equal = places.unsqueeze(2) == places.unsqueeze(1)
    is_same = is_equal & mask.unsqueeze(1)
    first = is_same.view(torch.uint8).argmax(dim=2)
    is_real = mask.to(places.dtype)
    none = torch.zeros_like(is_real)
    sums = none.scatter_add(1, first, weights.to(places.dtype) * is_real)
    n_samples = none.scatter_add(1, first, is_real)
    order = torch.arange(places.shape[1], device=places.device)
    is_first = mask & (first == order)
    return sums / n_samples.clamp_min(1), is_first


def fold() -> HistogramDescriptor:
    """Histograms of distances, angles and twists between residues, one for each class of separation along the chain.

    The layout was chosen on bent, deformed, changed and permuted chains that were made for that; see the documentation.

    Source: Rustamov 2010, section 4, for attributes as further dimensions.
    """
    return HistogramDescriptor(FoldHistogram(), name="fold", source="Rustamov 2010, section 4")

"""Interior distances of a molecule, joined with what its residues are like."""

import torch
from torch import Tensor, nn

from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements
from igps.nn.axes import Attribute, InteriorDistance, PointAxis
from igps.nn.axes.points import attribute_requirements, largest_members
from igps.nn.batch_features import SampleFeatures
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square
from igps.signature.residue_attributes import RESIDUE_KINDS

# Centres of classes: elementary charges, kT/e, and units of the scale of Kyte and Doolittle.
_CENTRES = {
    "charge": (-0.2, -0.05, 0.05, 0.2),
    "screened_potential": (-1.5, -0.5, 0.5, 1.5),
    "hydropathy": (-2.0, -1.0, 0.0, 1.0),
}
# Conformations change distances, so that wide bins tell proteins better than narrow ones.
_N_BINS = 4
_N_SAMPLES = 2000
# A difference in size of this much, in logarithms, halves what it leaves of a distance.
_SIZE = 0.3


class Shares(PointAxis):
    """Classes of points by a named attribute that is their shares in C classes, (P, C) with rows of sum 1."""

    def __init__(self, name: str, n_classes: int) -> None:
        nn.Module.__init__(self)
        self.name, self._n_classes = name, n_classes

    @property
    def n_classes(self) -> int:
        return self._n_classes

    def requirements(self, embedding: nn.Module) -> Requirements:
        """The attribute, if it is one of residues."""
        return attribute_requirements(self.name)

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """(N, P, C) of the samples; a ValueError if they have no such attribute of so many classes."""
        values = features.attribute(self.name)
        if values.ndim != 3 or values.shape[2] != self.n_classes:
            raise ValueError(
                f"attributes: expected {self.n_classes} shares of each sample as {self.name!r}, got an attribute of "
                f"shape {tuple(values.shape[2:])}."
            )
        return values

    def memberships(self, values: Tensor) -> Tensor:
        """(P, C) shares as they are; a ValueError if they are not finite."""
        if not torch.isfinite(values).all():
            raise ValueError(f"{self.name}: expected finite shares, got NaN or infinity.")
        return values

    def members(self, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The classes that samples have a share in, and the shares, see `PointAxis`."""
        self.memberships(values[mask])
        return largest_members(values, mask)


class SizedHistograms(HistogramDescriptor):
    """Histograms and the size of a body: χ² distances d become d·s / (0.3 + s) by the difference s in size.

    s is |Δ log area| + |Δ log volume|. The last two numbers of a description are these logarithms.
    """

    searched_by = None

    @property
    def n_features(self) -> int:
        """Cells of all parts, and the two logarithms."""
        return super().n_features + 2

    def without_size(self) -> HistogramDescriptor:
        """The same histograms alone."""
        invariant_to = (*self.invariant_to, "scale")
        return HistogramDescriptor(self.parts, name=self.name, source=self.source, invariant_to=invariant_to)

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, cells + 2)."""
        size = torch.stack([batch.area, batch.volume], dim=1).log()
        return torch.cat([super().describe(batch), size.float()], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G)."""
        size = torch.cdist(queries[:, -2:], gallery[:, -2:], p=1)
        return chi_square(queries[:, :-2], gallery[:, :-2]) * size / (_SIZE + size)

    def coordinates(self, descriptions: Tensor, *, of_one_kind: bool = False) -> Tensor:
        """(N, cells) roots of the histograms; beside them the logarithms would be all that counts."""
        return descriptions[:, :-2].sqrt()


def molecular(*, size: bool = True) -> HistogramDescriptor:
    """Interior distances of pairs of samples by the kinds of the residues around them, their charges and hydropathy.

    Two parts of equal share: distances by the pairs of 25 kinds of residues; and distances by the classes of charge, of
    screened potential, and of hydropathy. The layout was chosen on halves of 39 proteins; see the documentation.

    Source: Rustamov 2010, section 4, for what is known inside as a further dimension; Kyte and Doolittle 1982.

    Args:
        size: whether the distance of two descriptions is less between bodies of one size.
    """
    embedding = SpectralEmbedding(n_eigenpairs=50)

    def histogram(axis: PointAxis) -> PairHistogram:
        return PairHistogram([axis, InteriorDistance(_N_BINS)], embedding, n_samples=_N_SAMPLES)

    kinds = histogram(Shares("residue_shares", len(RESIDUE_KINDS)))
    others = [histogram(Attribute(name, centres, soft=True)) for name, centres in _CENTRES.items()]
    made = SizedHistograms if size else HistogramDescriptor
    return made(
        [kinds, others], name="molecular", source="Rustamov 2010; Kyte and Doolittle 1982", invariant_to=("motion",)
    )

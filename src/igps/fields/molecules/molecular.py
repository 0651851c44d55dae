"""Form, fold, composition and charges of a molecule, each a part of its own."""

import torch
from torch import Tensor, nn

from igps.data.requirements import Requirements
from igps.fields.molecules.fold import FoldHistogram
from igps.fields.molecules.residue_attributes import RESIDUE_KINDS
from igps.nn.axes import Attribute, InteriorDistance, PairAxis, PointAxis, Potential
from igps.nn.axes.points import attribute_requirements, largest_members
from igps.nn.batch_features import SampleFeatures
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.histograms.points import PointHistogram

# Centres of the classes: in elementary charges, in kT/e, and on the scale of Kyte and Doolittle.
_CENTRES = {
    "charge": (-0.2, -0.05, 0.05, 0.2),
    "screened_potential": (-1.5, -0.5, 0.5, 1.5),
    "hydropathy": (-2.0, -1.0, 0.0, 1.0),
}
# Distances change with the conformation, so the bins are wide.
_N_BINS = 4
_N_SAMPLES = 2000


class Shares(PointAxis):
    """Classes of points by an attribute that holds their shares in C classes: (P, C), rows of sum 1."""

    label = "kinds of residues"

    def __init__(self, name: str, n_classes: int) -> None:
        nn.Module.__init__(self)
        self.name = name
        self._n_classes = n_classes

    @property
    def n_classes(self) -> int:
        return self._n_classes

    def requirements(self, embedding: nn.Module) -> Requirements:
        """The attribute, if the library computes it."""
        return attribute_requirements(self.name)

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """(N, P, C) shares of the samples; a ValueError if there is no such attribute with C classes."""
        values = features.attribute(self.name)
        if values.ndim != 3 or values.shape[2] != self.n_classes:
            raise ValueError(
                f"attributes: expected {self.name!r} with {self.n_classes} shares for each sample, got an attribute of "
                f"shape {tuple(values.shape[2:])}."
            )
        return values

    def memberships(self, values: Tensor) -> Tensor:
        """Return the shares (P, C) unchanged; a ValueError if they are not finite."""
        if not torch.isfinite(values).all():
            raise ValueError(f"{self.name}: expected finite shares, got NaN or infinity.")
        return values

    def members(self, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The classes in which the samples have shares, and the shares, see `PointAxis`."""
        self.memberships(values[mask])
        return largest_members(values, mask)


class Form(PairHistogram):
    """The part `form`: interior distances, by potential."""

    label = "form"


class Composition(PointHistogram):
    """The part `composition`: shares of the kinds of residues, without any geometry."""

    label = "composition"


class Charges(PairHistogram):
    """The part `charges`: interior distances, by charge, potential or hydropathy."""

    label = "charges"


# Of form, fold, composition and charges: by Fisher's linear discriminant of distances, taken as independent, with the
# difference of their means between unrelated chains and relatives over their mean variance. Seen on 26 chains and three
# relatives of each, which were made; see the documentation.
_PART_SHARES = (0.025, 0.487, 0.402, 0.086)


def molecular() -> HistogramDescriptor:
    """Form, fold, composition and charges of a molecule, in four parts with shares of their own.

    - Form: interior distances by barycentroid potential, as `interior`.
    - Fold: residues by their separation along the chain, see `fold`.
    - Composition: the shares of 25 kinds of residues.
    - Charges: interior distances for each pair of classes of charge, of screened potential and of hydropathy.

    Source: Rustamov 2010, section 4, for attributes as further dimensions; Kyte and Doolittle 1982.
    """
    embedding = SpectralEmbedding(n_eigenpairs=50)

    def charges(name: str) -> PairHistogram:
        classes = Attribute(name, _CENTRES[name], soft=True)
        axes: list[PointAxis | PairAxis] = [classes, InteriorDistance(_N_BINS)]
        return Charges(axes, embedding, n_samples=_N_SAMPLES)

    return HistogramDescriptor(
        [
            Form([Potential(4), InteriorDistance(32)], embedding, n_samples=_N_SAMPLES),
            FoldHistogram(),
            Composition([Shares("residue_shares", len(RESIDUE_KINDS))], embedding, "interior"),
            [charges(name) for name in _CENTRES],
        ],
        name="molecular",
        source="Rustamov 2010; Kyte and Doolittle 1982",
        invariant_to=("motion",),
        shares=_PART_SHARES,
    )

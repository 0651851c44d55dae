"""The descriptor `composition`: which residues a molecule has, and nothing of its form."""

from dataclasses import replace

from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements
from igps.fields.molecules.residue_attributes import RESIDUE_KINDS
from igps.nn.axes.points import attribute_requirements
from igps.nn.descriptor import Descriptor

COMPOSITION = "composition"
"""The attribute of samples that holds the shares, see `residue_attributes.composition`."""


class Composition(Descriptor):
    """Shares of the 25 kinds of residues, compared by χ².

    It tells proteins apart that have different sequences, whatever their form: the row that a claim about form needs
    beside it.
    """

    name = "composition"
    source = "Nakashima, Nishikawa and Ooi 1986"
    invariant_to = ("motion", "scale", "pose")
    search_distance = "chi_square"

    @property
    def requirements(self) -> Requirements:  # type: ignore[override]
        """Return the requirement of the attribute, without eigenpairs."""
        return replace(attribute_requirements(COMPOSITION), eigenpairs=False)

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, 25) shares of sum 1."""
        return batch.interior.attributes[COMPOSITION][:, 0, : len(RESIDUE_KINDS)]

    def column_names(self, width: int) -> list[str]:
        """Return the kinds of residues, after `share`."""
        return [f"share.{kind}" for kind in RESIDUE_KINDS]

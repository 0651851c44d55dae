"""Molecules: structures, their surfaces, what their residues know, and the descriptor `molecular`."""

from igps.data.attribute_sources import SourceKind
from igps.fields.molecules import residue_attributes, structures

FORMATS = (structures.FORMAT,)
ATTRIBUTES = (
    SourceKind(
        lambda name, root: residue_attributes.ResidueAttribute(name),
        names=tuple(residue_attributes.RESIDUE_ATTRIBUTES),
    ),
)

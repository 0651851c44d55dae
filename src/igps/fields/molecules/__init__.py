"""Molecules: structures, their surfaces, what their residues know, and the descriptor `molecular`."""

from igps.data.attribute_sources import SourceKind
from igps.fields.molecules import bodies, maps, residue_attributes, residue_correspondence

FORMATS = (bodies.FORMAT, maps.FORMAT)
ATTRIBUTES = (
    SourceKind(
        lambda name, root: residue_attributes.ResidueAttribute(name),
        names=tuple(residue_attributes.RESIDUE_ATTRIBUTES),
    ),
)
CORRESPONDENCE = residue_correspondence.residue_correspondence

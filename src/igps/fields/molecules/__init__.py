"""Molecules: structures, their surfaces, and what their residues know."""

from igps.fields.molecules import structures

FORMATS = (structures.FORMAT,)

"""Solids of CAD files."""

from igps.fields.cad import step

FORMATS = (step.FORMAT,)

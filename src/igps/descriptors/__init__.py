"""The library's descriptors, one file each, and their registry by name."""

from igps.descriptors.from_file import load
from igps.descriptors.registry import NAMES, descriptor

__all__ = ["NAMES", "descriptor", "load"]

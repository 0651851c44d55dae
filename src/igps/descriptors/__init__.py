"""The library's descriptors, one file each, and their registry by name."""

from igps.descriptors.registry import NAMES, descriptor, load

__all__ = ["NAMES", "descriptor", "load"]

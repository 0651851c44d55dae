"""Every descriptor by its name, one file each."""

from igps.descriptors.registry import NAMES, descriptor, load

__all__ = ["NAMES", "descriptor", "load"]

"""The descriptor `pretrained`: histograms under a head that was fitted to generated shapes."""

from igps.descriptors.pretrained.descriptor import pretrained

__all__ = ["pretrained"]

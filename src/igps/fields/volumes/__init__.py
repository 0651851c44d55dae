"""Volumes: labels, whose surfaces are bodies, and images, whose values are attributes."""

from igps.data.attribute_sources import SourceKind
from igps.fields.volumes import image_attribute, images, label_volume

FORMATS = (label_volume.FORMAT,)
ATTRIBUTES = (SourceKind(image_attribute.ImageAttribute, suffixes=images.SUFFIXES),)

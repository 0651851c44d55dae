"""Volumes: labels, whose surfaces are bodies, and images, whose values are attributes."""

from igps.fields.volumes import label_volume

FORMATS = (label_volume.FORMAT,)

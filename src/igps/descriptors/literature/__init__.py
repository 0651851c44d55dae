"""Descriptors of other authors, one file each, as they are compared with those of this library."""

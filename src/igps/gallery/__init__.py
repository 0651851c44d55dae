"""Databases of described bodies: storage and search."""

"""Databases of described bodies: storage, search, and detection of duplicates."""

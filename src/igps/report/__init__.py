"""Figures, tables and the page of results."""

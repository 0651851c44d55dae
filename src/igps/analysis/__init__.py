"""Answers about a collection, as functions that return data."""

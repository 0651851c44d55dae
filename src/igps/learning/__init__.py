"""Metrics and classifiers that are fitted to labelled bodies."""

from igps.learning.fitting import Classification, classify, fit

__all__ = ["Classification", "classify", "fit"]

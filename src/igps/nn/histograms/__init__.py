"""Joint histograms of the samples of a body, or of their pairs, along one or several axes."""

from igps.nn.histograms.base import DescriptionPart, SampleHistogram
from igps.nn.histograms.pairs import PairHistogram, joint_histogram, pair_histogram
from igps.nn.histograms.points import PointHistogram

__all__ = [
    "DescriptionPart",
    "PairHistogram",
    "PointHistogram",
    "SampleHistogram",
    "joint_histogram",
    "pair_histogram",
]

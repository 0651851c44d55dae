"""A descriptor of very low cost, for runs that are killed many times."""

from igps import HistogramDescriptor, PairHistogram, SpectralEmbedding
from igps.nn.axes import InteriorDistance, Potential

N_EIGENPAIRS = 6


def cheap():
    """The histogram of `interior` with few eigenpairs and few bins."""
    embedding = SpectralEmbedding(n_eigenpairs=N_EIGENPAIRS)
    return HistogramDescriptor(
        PairHistogram([Potential(2), InteriorDistance(16)], embedding), name="cheap"
    )

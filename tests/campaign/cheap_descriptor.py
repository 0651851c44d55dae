"""A descriptor that costs next to nothing, for runs that are killed again and again."""

from __future__ import annotations

from igps import HistogramDescriptor, PairHistogram, SpectralEmbedding
from igps.nn.axes import InteriorDistance, Potential

N_EIGENPAIRS = 6


def cheap() -> HistogramDescriptor:
    """The paper's histogram of few eigenpairs in few bins."""
    embedding = SpectralEmbedding(n_eigenpairs=N_EIGENPAIRS)
    return HistogramDescriptor(PairHistogram([Potential(2), InteriorDistance(16)], embedding), name="cheap")

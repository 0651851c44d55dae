"""The Global Point Signature of the surface (Rustamov 2007): the histograms of `interior` over surface samples."""

from igps.nn.axes import InteriorDistance, Potential
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram


def gps(n_eigenpairs: int = 250) -> HistogramDescriptor:
    """Histograms of the commute-time distances between surface samples, one for each pair of potential classes.

    Source: Rustamov 2007, with 4 classes, 64 bins and χ² as in the comparison of Rustamov 2010.
    """
    embedding = SpectralEmbedding(n_eigenpairs=n_eigenpairs)
    histogram = PairHistogram([Potential(4), InteriorDistance(64)], embedding, samples="surface")
    return HistogramDescriptor(
        histogram, name="gps", source="Rustamov 2007", invariant_to=("motion", "scale", "pose")
    )

"""The Global Point Signature of the surface: the paper's histograms without the volume (Rustamov 2007)."""

from igps.nn.axes import InteriorDistance, Potential
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram


def gps(n_eigenpairs: int = 250) -> HistogramDescriptor:
    """Histograms of the commute-time distances between surface samples, by pairs of potential classes.

    Source: Rustamov 2007, with the 4 classes, 64 bins and χ² of the comparison in Rustamov 2010.
    """
    embedding = SpectralEmbedding(n_eigenpairs=n_eigenpairs)
    histogram = PairHistogram([Potential(4), InteriorDistance(64)], embedding, samples="surface")
    return HistogramDescriptor(histogram, name="gps", source="Rustamov 2007", invariant_to=("motion", "scale", "pose"))

"""The descriptor of Rustamov 2010: joint histograms of interior distance and potential."""

from igps.nn.axes import InteriorDistance, Potential
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram


def interior(n_eigenpairs: int = 250) -> HistogramDescriptor:
    """Histograms of the commute-time distances between interior samples, one for each pair of potential classes.

    Source: Rustamov 2010, sections 3 and 4: 4 classes, 64 bins, 250 eigenpairs, χ².
    """
    histogram = PairHistogram(
        [Potential(4), InteriorDistance(64)], SpectralEmbedding(n_eigenpairs=n_eigenpairs)
    )
    invariant_to = ("motion", "scale", "pose")
    return HistogramDescriptor(
        histogram, name="interior", source="Rustamov 2010", invariant_to=invariant_to
    )

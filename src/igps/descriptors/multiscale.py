"""Histograms of interior distances at several scales."""

from igps.nn.axes import EmbeddedPairCosines, InteriorDistance, Potential
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.signature.signature import SampleKind

# Largest numbers of samples. More samples hardly change the histograms, and the time grows with their square.
N_SAMPLES = 1500
N_ORIENTED_SAMPLES = 1000


def multiscale() -> HistogramDescriptor:
    """Histograms of interior distances at several scales, in four parts.

    - Distances by the first 250, 50 and 16 eigenpairs: fine, middle and coarse.
    - The joint histogram of the distances by 50 and by 4 eigenpairs.
    - Distances between interior samples and their directions to the surface, in the embedding of 16 eigenpairs.
    - Distances between surface samples and their directions away from the interior, in the embedding of 8 eigenpairs.
    """
    embeddings = {n: SpectralEmbedding(n_eigenpairs=n) for n in (250, 50, 16, 8, 4)}

    def scale(n_eigenpairs: int, reach: float) -> PairHistogram:
        return PairHistogram(
            [Potential(8), InteriorDistance(64, reach)],
            embeddings[n_eigenpairs],
            n_samples=N_SAMPLES,
        )

    def oriented(n_eigenpairs: int, samples: SampleKind) -> PairHistogram:
        axes = [InteriorDistance(6, 3.0), EmbeddedPairCosines(5)]
        return PairHistogram(axes, embeddings[n_eigenpairs], samples, n_samples=N_ORIENTED_SAMPLES)

    two_scales = [InteriorDistance(24, 3.0), InteriorDistance(24, 2.5, embedding=embeddings[4])]
    return HistogramDescriptor(
        [
            [scale(250, 4.0), scale(50, 4.0), scale(16, 3.0)],
            PairHistogram(two_scales, embeddings[50], n_samples=N_SAMPLES),
            oriented(16, "interior"),
            oriented(8, "surface"),
        ],
        name="multiscale",
        source="Rustamov 2010, on several scales",
        invariant_to=("motion", "scale", "pose"),
    )

"""Interior distances alone, on several scales, side by side."""

from igps.nn.axes import EmbeddedPairCosines, InteriorDistance, Potential
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.signature.signature import SampleKind

# Of the bodies with the most samples so many tell the histograms well enough, and the time grows with their square.
N_SAMPLES = 1500
N_ORIENTED_SAMPLES = 1000


def multiscale() -> HistogramDescriptor:
    """Interior distances alone, in four parts.

    The histograms of the first 250, 50 and 16 eigenpairs (fine, middle and coarse); the joint histogram of the
    distances of 50 and of 4; how the interior samples lie to the surface in the embedding of 16, and how the surface
    samples lie to the interior ones in that of 8.
    """
    embeddings = {n: SpectralEmbedding(n_eigenpairs=n) for n in (250, 50, 16, 8, 4)}

    def scale(n_eigenpairs: int, reach: float) -> PairHistogram:
        return PairHistogram([Potential(8), InteriorDistance(64, reach)], embeddings[n_eigenpairs], n_samples=N_SAMPLES)

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

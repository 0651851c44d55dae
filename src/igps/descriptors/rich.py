"""Interior distances joined with Euclidean distances, directions and attributes of the samples."""

from igps.descriptors.multiscale import N_ORIENTED_SAMPLES, N_SAMPLES
from igps.nn.axes import (
    Attribute,
    EuclideanDistance,
    InteriorDistance,
    PairAxis,
    PairCosines,
    PointAxis,
    Potential,
)
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram

# Centres of the classes. The classes of the depth have their boundaries at 0.015, 0.03 and 0.06 of √area.
_DEPTH = (0.0075, 0.0225, 0.0375, 0.0825)
_SURFACE_POTENTIAL = (2.4, 2.8, 3.2, 3.6)


def rich() -> HistogramDescriptor:
    """Interior distances joined with Euclidean distances, directions and attributes of the samples, in three parts.

    - Interior distances, some jointly with Euclidean distances, depth and surface potential of the samples. The surface
      potential tells how much surface is near; it is of the form alone, not of the charges of a molecule.
    - Interior distances of interior samples, jointly with the angles of their directions to the surface.
    - Euclidean distances of surface samples, jointly with the angles of their directions.
    """
    embeddings = {n: SpectralEmbedding(n_eigenpairs=n) for n in (50, 16)}

    def histogram(
        n_eigenpairs: int, *axes: PointAxis | PairAxis, n_samples: int = N_SAMPLES
    ) -> PairHistogram:
        return PairHistogram(axes, embeddings[n_eigenpairs], n_samples=n_samples)

    surface_potential = Attribute("electrostatic_potential", _SURFACE_POTENTIAL)
    n = N_ORIENTED_SAMPLES
    return HistogramDescriptor(
        [
            [
                histogram(50, Potential(8), InteriorDistance(64)),
                histogram(16, Potential(8), InteriorDistance(64, 3.0)),
                histogram(50, Potential(4), InteriorDistance(32), EuclideanDistance(16)),
                histogram(
                    50,
                    Potential(3),
                    Attribute("depth", _DEPTH),
                    InteriorDistance(12),
                    EuclideanDistance(8),
                ),
                histogram(50, Potential(4), Attribute("depth", _DEPTH), InteriorDistance(32)),
                histogram(50, Potential(4), surface_potential, InteriorDistance(32)),
            ],
            histogram(50, InteriorDistance(6, 3.0), PairCosines(5), n_samples=n),
            PairHistogram(
                [EuclideanDistance(6, 1.0), PairCosines(5)],
                embeddings[50],
                "surface",
                n_samples=n,
            ),
        ],
        name="rich",
        source="Rustamov 2010; Wahl, Hillenbrand and Hirzinger 2003",
        invariant_to=("motion", "scale"),
    )

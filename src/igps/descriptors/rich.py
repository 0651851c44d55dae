"""Interior distances joined with Euclidean distances, directions and attributes of the samples."""

from functools import partial

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
_N_KNOTS = 12


def rich(*, learnable: bool = False, n_training_samples: int | None = None) -> HistogramDescriptor:
    """Interior distances joined with Euclidean distances, directions and attributes of the samples, in three parts.

    - Interior distances, some jointly with Euclidean distances, depth and surface potential of the samples. The surface
      potential is that of a uniform charge on the surface, see `electrostatic_potential`.
    - Interior distances of interior samples, jointly with the angles of their directions to the surface.
    - Euclidean distances of surface samples, jointly with the angles of their directions.

    Args:
        learnable: whether the centres of bins and classes, and a spectral filter for each histogram, are parameters.
            Classes are soft in this case.
        n_training_samples: of each histogram, see `PairHistogram`.
    """
    # Histograms share fixed embeddings, which are computed once. Each histogram has a learned filter of its own.
    fixed = {n: SpectralEmbedding(n_eigenpairs=n) for n in (50, 16)}

    def histogram(
        n_eigenpairs: int, *axes: PointAxis | PairAxis, n_samples: int = N_SAMPLES
    ) -> PairHistogram:
        learned = (
            SpectralEmbedding(n_eigenpairs=n_eigenpairs, n_knots=_N_KNOTS) if learnable else None
        )
        embedding = learned or fixed[n_eigenpairs]
        return PairHistogram(
            axes, embedding, n_samples=n_samples, n_training_samples=n_training_samples
        )

    potential = partial(Potential, learnable=learnable)
    distance = partial(InteriorDistance, learnable=learnable)
    euclidean = partial(EuclideanDistance, learnable=learnable)
    cosines = partial(PairCosines, 5, learnable=learnable)
    depth = partial(Attribute, "depth", _DEPTH, learnable=learnable)
    surface_potential = Attribute(
        "electrostatic_potential", _SURFACE_POTENTIAL, learnable=learnable
    )
    n = N_ORIENTED_SAMPLES
    return HistogramDescriptor(
        [
            [
                histogram(50, potential(8), distance(64)),
                histogram(16, potential(8), distance(64, 3.0)),
                histogram(50, potential(4), distance(32), euclidean(16)),
                histogram(50, potential(3), depth(), distance(12), euclidean(8)),
                histogram(50, potential(4), depth(), distance(32)),
                histogram(50, potential(4), surface_potential, distance(32)),
            ],
            histogram(50, distance(6, 3.0), cosines(), n_samples=n),
            PairHistogram(
                [euclidean(6, 1.0), cosines()],
                fixed[50],
                "surface",
                n_samples=n,
                n_training_samples=n_training_samples,
            ),
        ],
        name="rich",
        source="Rustamov 2010; Wahl, Hillenbrand and Hirzinger 2003",
        invariant_to=("motion", "scale"),
    )

"""Axes of pairs: bins for the pairs of samples of a body.

Pairs are sorted by interior distance, Euclidean distance, the cosines between two directions and the line that
connects the samples, or their twist. Only the twist distinguishes left from right.
"""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.data.requirements import SURFACE_DIRECTION, Requirements, embedding_requirements
from igps.nn._kernels.pairs_by_torch import (
    PairValues,
    euclidean_distances,
    oriented_pairs,
    pair_twists,
)
from igps.nn.axes.centres import OrderedCentres, interval_centres
from igps.nn.batch_features import SampleFeatures
from igps.nn.specification import Specified


class PairAxis(Specified, ABC):
    """Base class of axes of pairs: a pair is shared linearly between the two bins whose centres surround its value.

    An axis of your own defines `shape` and `pairs`, and `requirements` if it needs more than the samples. `pairs`
    returns features of the samples and a function that computes values from them, as `euclidean_distances` does.

    Example:
        The difference in depth between two samples.

        >>> import torch
        >>> from igps.nn.axes import OrderedCentres, PairValues
        >>> class DepthDifference(PairAxis):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.centres = OrderedCentres([0.0, 0.02, 0.05, 0.1], learnable=True)
        ...
        ...     @property
        ...     def shape(self):
        ...         return (4,)
        ...
        ...     def requirements(self, embedding):
        ...         return Requirements(attributes=("depth",))
        ...
        ...     def pairs(self, features, embedding):
        ...         def between(rows, columns):  # depths (N, I) and (N, J) to values (N, 1, I, J)
        ...             return (rows[0][:, None, :, None] - columns[0][:, None, None, :]).abs()
        ...
        ...         return PairValues((features.attribute("depth"),), (self.centres(),), between)
        >>> from igps.nn.histograms import PairHistogram
        >>> PairHistogram([DepthDifference()]).shape
        (1, 4)
    """

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """The number of bins along each dimension that this axis adds to the histogram."""

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirements for a body, given the embedding of the histogram."""
        return Requirements()

    @abstractmethod
    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Return the values of the pairs of N shapes, and the centres of their bins."""


def _bin_centres(n_bins: int, reach: float) -> Tensor:
    check_at_least(2, n_bins=n_bins)
    return interval_centres(n_bins, reach, "n_bins")


class DistanceAxis(PairAxis):
    """Bins of a distance: `n_bins` equal intervals of [0, `reach`] at the start, whose centres may be learned.

    Larger distances count in the last bin.
    """

    def __init__(self, n_bins: int = 16, reach: float = 1.0, *, learnable: bool = False) -> None:
        super().__init__()
        self.reach = reach
        self.centres = OrderedCentres(_bin_centres(n_bins, reach), learnable)

    @property
    def shape(self) -> tuple[int, ...]:
        """(B,)."""
        return (len(self.centres.start),)


class InteriorDistance(DistanceAxis):
    """Bins of the interior distance, the Euclidean distance of embeddings (Rustamov 2010, equation 5).

    Args:
        embedding: replaces the embedding of the histogram, for example to add a second scale.
        n_bins, reach, learnable: see `DistanceAxis`.
    """

    def __init__(
        self,
        n_bins: int = 64,
        reach: float = 4.0,
        *,
        embedding: nn.Module | None = None,
        learnable: bool = False,
    ) -> None:
        super().__init__(n_bins, reach, learnable=learnable)
        self.embedding = embedding

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirements of the axis's own embedding, or of the histogram's."""
        return embedding_requirements(self.embedding or embedding)

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Return the distances of the embedded samples."""
        return euclidean_distances(features.embedded(self.embedding or embedding), self.centres())


class EuclideanDistance(DistanceAxis):
    """Bins of the distance in space, over √area; see `DistanceAxis`."""

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Return the distances of the positions over √area."""
        return euclidean_distances(features.positions(), self.centres())


class _CosineAxes(PairAxis):
    def __init__(self, n_bins: int = 5, *, learnable: bool = False) -> None:
        super().__init__()
        cosines = _bin_centres(n_bins, 2.0) - 1
        self.towards_centres = OrderedCentres(cosines, learnable)
        self.between_centres = OrderedCentres(cosines, learnable)

    @property
    def shape(self) -> tuple[int, ...]:
        """(A, A, A)."""
        return (len(self.between_centres.start),) * 3

    def _oriented(self, points: Tensor, directions: Tensor) -> PairValues:
        return oriented_pairs(points, directions, self.towards_centres(), self.between_centres())


class PairCosines(_CosineAxes):
    """Bins of the three cosines of point pair features in space (Wahl et al. 2003; Drost et al. 2010).

    The direction at an interior sample points to the nearest point of the surface; the direction at a surface sample is
    the outward normal. The cosines detect corners, hollows and symmetry, which distances hardly show. Each cosine has
    A bins.
    """

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirement of surface directions."""
        return SURFACE_DIRECTION

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Return the cosines of the positions over √area and the surface directions."""
        return self._oriented(features.positions(), features.attribute("surface_direction"))


class EmbeddedPairCosines(_CosineAxes):
    """`PairCosines` of the embedded samples; they depend only on interior distances, and so hardly change with pose.

    The direction at an interior sample points to the nearest embedded surface samples; the direction at a surface
    sample points away from the nearest interior samples. There are no second derivatives.
    """

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirements of the embedding."""
        return embedding_requirements(embedding)

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Return the cosines of the embedded samples and their embedded directions."""
        return self._oriented(features.embedded(embedding), features.embedded_directions(embedding))


class PairTwist(PairAxis):
    """Bins of the signed twist of a pair, the only axis that distinguishes a body from its mirror image.

    With the directions m and n of `PairCosines` at samples p and q, the twist is (m × n)·(q − p)/|q − p|: the rotation
    of one direction against the other about the line between the samples. A reflection changes its sign. As the bins
    are symmetric, the histogram of a mirror image is the histogram of the body with the bins in reverse order.

    Args:
        n_bins: B.
        reach: the outer bins end at ±`reach`, and also count larger twists.
        learnable: whether the centres are parameters.
    """

    def __init__(self, n_bins: int = 6, reach: float = 0.75, *, learnable: bool = False) -> None:
        super().__init__()
        self.centres = OrderedCentres(_bin_centres(n_bins, 2 * reach) - reach, learnable)

    @property
    def shape(self) -> tuple[int, ...]:
        """(B,)."""
        return (len(self.centres.start),)

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirement of surface directions."""
        return SURFACE_DIRECTION

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Return the twists of the positions over √area and the surface directions."""
        return pair_twists(
            features.positions(), features.attribute("surface_direction"), self.centres()
        )

"""Axes of pairs: the bins that the pairs of samples of a body are sorted into.

By interior distance, by Euclidean distance, by the cosines that tell how two samples lie to each other and to the
surface next to them, or by the twist between them, which alone tells left from right.
"""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.data.requirements import Requirements, embedding_requirements
from igps.nn._kernels.pair_values import PairValues, euclidean_distances, oriented_pairs, pair_twists
from igps.nn.axes.centres import OrderedCentres, middles
from igps.nn.batch_features import SampleFeatures
from igps.nn.specification import Specified


class PairAxis(Specified, ABC):
    """Bins of pairs, shared out linearly: a pair counts in the two bins whose centres surround its value.

    An axis of your own defines `shape`, `pairs`, and where the samples alone do not suffice `requirements`. `pairs`
    says from what of the samples the values of pairs follow, and how; `euclidean_distances` does it for points.

    Example:
        How much deeper inside the body one sample lies than the other.

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
        ...         def between(rows, columns):  # (N, I) and (N, J) depths to (N, 1, I, J)
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
        """Bins, along each dimension that this axis adds to the histogram."""

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Of a body, with this embedding for the histogram."""
        return Requirements()

    @abstractmethod
    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """The values of the pairs of N shapes, and the centres of their bins."""


def _bin_middles(n_bins: int, reach: float) -> Tensor:
    check_at_least(2, n_bins=n_bins)
    return middles(n_bins, reach, "bins")


class DistanceAxis(PairAxis):
    """Bins of a distance: `n_bins` equal intervals of [0, `reach`] at the start, whose centres may be parameters.

    What lies beyond counts in the last.
    """

    def __init__(self, n_bins: int = 16, reach: float = 1.0, *, learnable: bool = False) -> None:
        super().__init__()
        self.reach = reach
        self.centres = OrderedCentres(_bin_middles(n_bins, reach), learnable)

    @property
    def shape(self) -> tuple[int, ...]:
        """(B,)."""
        return (len(self.centres.start),)


class InteriorDistance(DistanceAxis):
    """Bins of the interior distance, the Euclidean distance of embeddings (Rustamov 2010, equation 5).

    Args:
        embedding: other than the histogram's: for a second scale.
        n_bins, reach, learnable: see `DistanceAxis`.
    """

    def __init__(
        self, n_bins: int = 64, reach: float = 4.0, *, embedding: nn.Module | None = None, learnable: bool = False
    ) -> None:
        super().__init__(n_bins, reach, learnable=learnable)
        self.embedding = embedding

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Those of the embedding, its own or the histogram's."""
        return embedding_requirements(self.embedding or embedding)

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Embedded samples."""
        return euclidean_distances(features.embedded(self.embedding or embedding), self.centres())


class EuclideanDistance(DistanceAxis):
    """Bins of the distance in space, over √area; see `DistanceAxis`."""

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Samples over √area."""
        return euclidean_distances(features.positions(), self.centres())


class _CosineAxes(PairAxis):
    def __init__(self, n_bins: int = 5, *, learnable: bool = False) -> None:
        super().__init__()
        cosines = _bin_middles(n_bins, 2.0) - 1
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

    The direction of a sample is that to the nearest point of the surface, on the surface the outward normal. They see
    corners, hollows and symmetry, which distances alone tell little of. Each cosine has A bins.
    """

    def requirements(self, embedding: nn.Module) -> Requirements:
        """The directions."""
        return Requirements(attributes=("surface_direction",))

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Samples over √area, and the directions to the surface."""
        return self._oriented(features.positions(), features.attribute("surface_direction"))


class EmbeddedPairCosines(_CosineAxes):
    """`PairCosines` between the embedded samples: made of interior distances alone, they hardly change with pose.

    The direction of an interior sample is to the embedded surface samples nearest to it, that of a surface sample away
    from the interior ones. Second derivatives they have by `torch.func` alone.
    """

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Those of the embedding."""
        return embedding_requirements(embedding)

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Embedded samples, and the directions between them and the embedded samples of the other kind."""
        return self._oriented(features.embedded(embedding), features.embedded_directions(embedding))


class PairTwist(PairAxis):
    """Bins of the signed twist of a pair, the only axis that tells a body from its mirror image.

    With the directions m and n of `PairCosines` at samples p and q it is (m × n)·(q − p)/|q − p|: how one direction is
    turned against the other about the line between the samples. A reflection turns its sign, and the bins are
    symmetric, so that the histogram of a mirror image is that of the body with the bins in the other order.

    Args:
        n_bins: B.
        reach: ends of the outer bins are at ±`reach`; what lies beyond counts in these.
        learnable: whether the centres are parameters.
    """

    def __init__(self, n_bins: int = 6, reach: float = 0.75, *, learnable: bool = False) -> None:
        super().__init__()
        self.centres = OrderedCentres(_bin_middles(n_bins, 2 * reach) - reach, learnable)

    @property
    def shape(self) -> tuple[int, ...]:
        """(B,)."""
        return (len(self.centres.start),)

    def requirements(self, embedding: nn.Module) -> Requirements:
        """The directions."""
        return Requirements(attributes=("surface_direction",))

    def pairs(self, features: SampleFeatures, embedding: nn.Module) -> PairValues:
        """Samples over √area, and the directions to the surface."""
        return pair_twists(features.positions(), features.attribute("surface_direction"), self.centres())

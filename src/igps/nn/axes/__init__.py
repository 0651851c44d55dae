"""The axes of histograms: of points, such as `Potential`, and of pairs of points, such as `InteriorDistance`.

An axis of your own is a subclass of `PointAxis` or `PairAxis`. To add an axis to the library, define its class in this
folder, export it here, and enter it in `AXES` if it can be constructed without arguments.
"""

from igps.nn._kernels.pairs_by_torch import (
    PairValues,
    euclidean_distances,
    oriented_pairs,
    pair_twists,
)
from igps.nn.axes.centres import OrderedCentres
from igps.nn.axes.pairs import (
    EmbeddedPairCosines,
    EuclideanDistance,
    InteriorDistance,
    PairAxis,
    PairCosines,
    PairTwist,
)
from igps.nn.axes.points import Attribute, BallRadius, PointAxis, Potential

__all__ = [
    "AXES",
    "Attribute",
    "BallRadius",
    "EmbeddedPairCosines",
    "EuclideanDistance",
    "InteriorDistance",
    "OrderedCentres",
    "PairAxis",
    "PairCosines",
    "PairTwist",
    "PairValues",
    "PointAxis",
    "Potential",
    "axis_of",
    "euclidean_distances",
    "oriented_pairs",
    "pair_twists",
]

AXES: dict[str, type[PointAxis | PairAxis]] = {
    "potential": Potential,
    "interior_distance": InteriorDistance,
    "euclidean_distance": EuclideanDistance,
    "pair_cosines": PairCosines,
    "embedded_pair_cosines": EmbeddedPairCosines,
    "pair_twist": PairTwist,
    "ball_radius": BallRadius,
}
"""The axes that can be constructed without arguments, by name."""


def axis_of(name: str) -> PointAxis | PairAxis:
    """Return the axis of a name with its default layout; raise a ValueError for an unknown name."""
    if name not in AXES:
        raise ValueError(f"axes: expected one of {', '.join(AXES)}, or an axis, got {name!r}.")
    return AXES[name]()  # type: ignore[call-arg]

"""The axes of histograms: of points, such as `Potential`, and of pairs of points, such as `InteriorDistance`.

An axis of your own is a subclass of `PointAxis` or `PairAxis`. One that belongs to the library is a class in this
folder, exported here, and entered in `AXES` by its name if it has a default layout.
"""

from igps.nn._kernels.pair_values import (
    PairValues,
    euclidean_distances,
    oriented_pairs,
    pair_twists,
    point_pair_features,
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
    "point_pair_features",
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
"""The axes that have a layout of their own, by name."""


def axis_of(name: str) -> PointAxis | PairAxis:
    """The axis of a name, as it is by default; a ValueError where no axis has this name."""
    if name not in AXES:
        raise ValueError(f"axes: expected one of {', '.join(AXES)}, or an axis, got {name!r}.")
    return AXES[name]()  # type: ignore[call-arg]

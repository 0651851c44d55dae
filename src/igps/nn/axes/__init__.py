"""The axes of pair histograms, of points and of pairs, and those that have a layout of their own by name."""

from __future__ import annotations

from igps.nn.axes.pairs import EmbeddedPairCosines, EuclideanDistance, InteriorDistance, PairAxis, PairCosines
from igps.nn.axes.points import Attribute, BallRadius, PointAxis, Potential

__all__ = [
    "AXES",
    "Attribute",
    "BallRadius",
    "EmbeddedPairCosines",
    "EuclideanDistance",
    "InteriorDistance",
    "PairAxis",
    "PairCosines",
    "PointAxis",
    "Potential",
    "axis_of",
]

AXES: dict[str, type[PointAxis | PairAxis]] = {
    "potential": Potential,
    "interior_distance": InteriorDistance,
    "euclidean_distance": EuclideanDistance,
    "pair_cosines": PairCosines,
    "embedded_pair_cosines": EmbeddedPairCosines,
    "ball_radius": BallRadius,
}
"""The axes that have a layout of their own, by name."""


def axis_of(name: str) -> PointAxis | PairAxis:
    """The axis of a name, as it is by default.

    Raises:
        ValueError: no axis has this name.
    """
    if name not in AXES:
        raise ValueError(f"axes: expected one of {', '.join(AXES)}, or an axis, got {name!r}.")
    return AXES[name]()  # type: ignore[call-arg]

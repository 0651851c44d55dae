"""Quantiles of distances, and thresholds between pairs that are the same and others."""

import math

import numpy as np
from numpy.typing import ArrayLike

from igps.gallery.calibration import LEVELS, Threshold


def quantiles(distances: ArrayLike) -> list[float]:
    """Those of distances at `LEVELS`."""
    return [float(f"{value:.5g}") for value in np.quantile(np.asarray(distances, dtype=np.float64), LEVELS)]


def threshold_between(same: ArrayLike, other: ArrayLike, rate: float) -> Threshold:
    """The threshold between distances of pairs that are the same and of others.

    Where the two do not overlap, the geometric mean of the largest of the ones and the smallest of the others; else as
    large as the rate of false pairs allows.

    Args:
        same: distances of pairs that are the same.
        other: of pairs that are not.
        rate: of false pairs, at most.
    """
    largest, refused = float(np.max(same)), _first_refused(other, rate)
    return _counted(math.sqrt(largest * refused) if largest < refused else math.nextafter(refused, 0), same, other)


def threshold_at(same: ArrayLike, other: ArrayLike, rate: float) -> Threshold:
    """As large a threshold as the rate of false pairs allows; arguments as for `threshold_between`."""
    return _counted(math.nextafter(_first_refused(other, rate), 0), same, other)


def _first_refused(other: ArrayLike, rate: float) -> float:
    other = np.sort(np.asarray(other, dtype=np.float64))
    return float(other[int(rate * len(other))])


def _counted(distance: float, same: ArrayLike, other: ArrayLike) -> Threshold:
    same, other = np.asarray(same), np.asarray(other)
    return Threshold(distance, len(other), int((other <= distance).sum()), len(same), int((same <= distance).sum()))

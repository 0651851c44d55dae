"""Quantiles of distances, and thresholds between pairs of the same body and other pairs."""

import math

import numpy as np
from numpy.typing import ArrayLike

from igps.duplicates.calibration import LEVELS, Threshold


def quantiles(distances: ArrayLike) -> list[float]:
    """Return the quantiles of distances at `LEVELS`, with five digits."""
    return [
        float(f"{value:.5g}")
        for value in np.quantile(np.asarray(distances, dtype=np.float64), LEVELS)
    ]


def threshold_between(same: ArrayLike, other: ArrayLike, rate: float) -> Threshold:
    """Return the threshold between distances of same pairs and of other pairs.

    If the distances do not overlap, the threshold is the geometric mean of the largest distance of same pairs and the
    smallest of other pairs. Otherwise it is as large as the rate of false pairs allows.

    Args:
        same: distances of same pairs.
        other: distances of other pairs.
        rate: largest rate of false pairs.
    """
    largest, rejected = float(np.max(same)), _smallest_rejected(other, rate)
    threshold = math.sqrt(largest * rejected) if largest < rejected else math.nextafter(rejected, 0)
    return _with_counts(threshold, same, other)


def threshold_at(same: ArrayLike, other: ArrayLike, rate: float) -> Threshold:
    """Return the largest threshold that the rate of false pairs allows; arguments are those of `threshold_between`."""
    return _with_counts(math.nextafter(_smallest_rejected(other, rate), 0), same, other)


def _smallest_rejected(other: ArrayLike, rate: float) -> float:
    other = np.sort(np.asarray(other, dtype=np.float64))
    return float(other[int(rate * len(other))])


def _with_counts(distance: float, same: ArrayLike, other: ArrayLike) -> Threshold:
    same, other = np.asarray(same), np.asarray(other)
    return Threshold(
        distance,
        len(other),
        int((other <= distance).sum()),
        len(same),
        int((same <= distance).sum()),
    )

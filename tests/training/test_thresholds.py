"""Thresholds between pairs that are the same and others, against counting."""

import numpy as np
import pytest
from training.calibrate import threshold_at, threshold_between

from igps.duplicates.calibration import Threshold


def test_a_threshold_lies_between_what_does_not_overlap():
    found = threshold_between(
        [0.001, 0.004],
        [0.016, 0.5, np.inf],
        0.001,
    )
    assert found == Threshold(0.008, 3, 0, 2, 2)


def test_where_they_overlap_the_rate_decides():
    generator = np.random.default_rng(1)
    same = generator.normal(1, 0.3, 400)
    other = generator.normal(2, 0.3, 3000)
    found = threshold_between(same, other, 0.01)
    assert found.n_false == sum(one <= found.distance for one in other) == 30
    assert found.n_found == sum(one <= found.distance for one in same)
    assert found.n_other == 3000
    # No larger one is allowed.
    assert sum(one <= np.nextafter(sorted(other)[30], 9) for one in other) == 31


def test_a_threshold_may_be_as_large_as_the_rate_allows():
    """Of ten others one in ten is allowed: all up to the second nearest, and not that one."""
    found = threshold_at(
        [1.0, 2.0, 7.5],
        np.arange(5.0, 15.0),
        0.1,
    )
    assert found.distance == pytest.approx(6.0)
    assert found.distance < 6.0
    assert found.n_false == 1
    assert found.n_other == 10
    assert found.n_found == 2
    assert found.n_same == 3

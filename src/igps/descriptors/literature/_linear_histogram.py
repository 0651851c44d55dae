"""Histograms with a linear kernel: a value between the centres of two bins is shared between both bins."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from igps._arrays import Floats


def linear_histogram(values: Sequence[Floats], n_bins: Sequence[int]) -> Floats:
    """Joint histogram of variables (P,) in [0, 1], of shape `n_bins` and sum 1.

    A value at the centre of a bin counts for this bin alone. A value between two centres counts for both bins, with
    weights that fall linearly with the distance from the centre. Values above 1 count for the last bin.
    """
    positions = [np.clip(x * n - 0.5, 0, n - 1) for x, n in zip(values, n_bins, strict=True)]
    lower = [
        np.minimum(position.astype(int), n - 2)
        for position, n in zip(positions, n_bins, strict=True)
    ]
    shares = [position - bins for position, bins in zip(positions, lower, strict=True)]
    histogram = np.zeros(int(np.prod(n_bins)))
    for corner in product((0, 1), repeat=len(values)):
        cells = np.ravel_multi_index(
            [bins + step for bins, step in zip(lower, corner, strict=True)], tuple(n_bins)
        )
        weights = np.prod(
            [x if step else 1 - x for x, step in zip(shares, corner, strict=True)], axis=0
        )
        histogram += np.bincount(cells, weights, len(histogram))
    return (histogram / len(positions[0])).reshape(tuple(n_bins))

"""Histograms with a linear kernel: a value between the centres of two bins counts for both."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from igps._arrays import Floats


def linear_histogram(values: Sequence[Floats], n_bins: Sequence[int]) -> Floats:
    """Joint histogram, of shape `n_bins` and sum 1, of variables (P,) in [0, 1], larger values in the last bin.

    A value at the centre of a bin counts there alone, one between two centres for both, by its distance from each.
    """
    positions = [np.clip(one * n - 0.5, 0, n - 1) for one, n in zip(values, n_bins, strict=True)]
    low = [np.minimum(one.astype(int), n - 2) for one, n in zip(positions, n_bins, strict=True)]
    parts = [position - bins for position, bins in zip(positions, low, strict=True)]
    histogram = np.zeros(int(np.prod(n_bins)))
    for corner in product((0, 1), repeat=len(values)):
        cells = np.ravel_multi_index([bins + step for bins, step in zip(low, corner, strict=True)], tuple(n_bins))
        weights = np.prod([part if step else 1 - part for part, step in zip(parts, corner, strict=True)], axis=0)
        histogram += np.bincount(cells, weights, len(histogram))
    return (histogram / len(positions[0])).reshape(tuple(n_bins))

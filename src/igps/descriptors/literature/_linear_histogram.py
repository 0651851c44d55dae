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
    lower_bins = []
    upper_shares = []
    for variable, n in zip(values, n_bins, strict=True):
        position = np.clip(variable * n - 0.5, 0, n - 1)
        lower = np.minimum(position.astype(int), n - 2)
        lower_bins.append(lower)
        upper_shares.append(position - lower)
    histogram = np.zeros(int(np.prod(n_bins)))
    # A corner says for each variable whether the lower bin (0) or the upper bin (1) is filled.
    for corner in product((0, 1), repeat=len(values)):
        bins = []
        weights = []
        for lower, share, step in zip(lower_bins, upper_shares, corner, strict=True):
            bins.append(lower + step)
            weights.append(share if step else 1 - share)
        cells = np.ravel_multi_index(bins, tuple(n_bins))
        histogram += np.bincount(cells, np.prod(weights, axis=0), len(histogram))
    return (histogram / len(values[0])).reshape(tuple(n_bins))

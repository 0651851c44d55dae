"""Labels in their grid: which share voxels."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Place:
    """The voxels of a label: the folder and the grid in which they lie, and a box of it in bits."""

    grid: tuple[object, ...]
    low: NDArray[np.int64]
    shape: tuple[int, ...]
    n_voxels: int
    bits: NDArray[np.uint8]

    def mask(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.uint8]:
        """From one corner of the grid to another."""
        whole = np.unpackbits(self.bits, count=int(np.prod(self.shape))).reshape(self.shape)
        return whole[tuple(map(slice, low - self.low, high - self.low))]


def overlaps(places: Sequence[Place | None], labels: Sequence[str] | None = None) -> Values:
    """(N, N) shares of the voxels of each that lie in each other one; 0 of one class, which may be many subjects."""
    found = np.zeros((len(places), len(places)))
    grids = defaultdict[tuple[object, ...], list[tuple[int, Place]]](list)
    for i, place in enumerate(places):
        if place is not None:
            grids[place.grid].append((i, place))
    for own in grids.values():
        for (i, one), (j, other) in combinations(own, 2):
            low, high = np.maximum(one.low, other.low), np.minimum(one.low + one.shape, other.low + other.shape)
            if (low < high).all() and (labels is None or labels[i] != labels[j]):
                shared = np.count_nonzero(one.mask(low, high) & other.mask(low, high))
                found[i, j], found[j, i] = shared / one.n_voxels, shared / other.n_voxels
    return found

"""Labels in their grid: whether their ends were cut off, and which share voxels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]


def end_of(mask: Mask, at_border: Mask) -> float:
    """How flat an end of a body is along an axis of the grid, as if slices were cut off; 0 if all are at the border.

    Voxels of its last slice beyond two fifths of those of the two slices before it, as ends that are round have, over
    the root of their mean number.

    Args:
        mask: (X, Y, Z), no larger than the body.
        at_border: (3, 2) which ends the border of the volume cuts.
    """
    flattest = 0.0
    for axis, end in np.argwhere(~at_border):
        counts = np.moveaxis(mask, axis, 0)[:: -1 if end else 1][:3].sum(axis=(1, 2))
        if len(counts) == 3:
            flattest = max(flattest, (counts[0] - 0.4 * counts[1:].mean()) / np.sqrt(counts.mean()))
    return flattest


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

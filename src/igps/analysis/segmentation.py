"""What goes wrong in masks of voxels: pieces apart, cavities, holes, gaps, slices that were cut off, and overlaps.

What is a share of the voxels comes as its square root, whose scatter is about the same for small shares and large ones
(Bartlett 1936), so that a speck in one body of many weighs little and a piece in a body of one much.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers

# Of the depth of a body, the radius of the ball that closes it: what is narrower than the body is thick is a gap
_CLOSING = 0.8
# Larger boxes are closed on a grid twice as coarse, which shows gaps of that width all the same
_MOST_VOXELS = 1 << 20


def stray_root(mask: Booleans) -> float:
    """The root of the share of the voxels that are connected to the largest piece by no face, edge or corner."""
    pieces, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    return float(np.sqrt(1 - np.bincount(pieces[mask]).max() / np.count_nonzero(mask)))


def cavity_root(mask: Booleans) -> float:
    """The root of the voxels that the body surrounds, over its own."""
    filled = ndimage.binary_fill_holes(np.pad(mask, 1))
    return float(np.sqrt(np.count_nonzero(filled) / np.count_nonzero(mask) - 1))


def hole_root(mask: Booleans) -> float:
    """The root of the voxels that the body surrounds in a slice across any axis of the grid, over its own."""
    padded, holes = np.pad(mask, 1), np.zeros_like(mask)
    for axis in range(3):
        neighbours = ndimage.generate_binary_structure(3, 1)
        np.moveaxis(neighbours, axis, 0)[[0, 2]] = False
        pieces, n_pieces = ndimage.label(~padded, neighbours)
        surrounded = np.arange(n_pieces + 1) > 0
        surrounded[np.take(pieces, 0, axis=axis - 1)] = False  # the padding, which goes all around a slice
        holes |= surrounded[pieces][1:-1, 1:-1, 1:-1]
    return float(np.sqrt(np.count_nonzero(holes) / np.count_nonzero(mask)))


def gap_root(mask: Booleans, sides: Floats) -> float:
    """The root of the voxels that closing adds, over those of the body: its tunnels, notches and clefts.

    Closing (Matheron 1975) keeps outside what a ball outside of the body reaches. Its radius is four fifths of that of
    the largest ball inside. A voxel has sides (3,), length.
    """
    while mask.size > _MOST_VOXELS:
        mask = np.pad(mask, [(0, n % 2) for n in mask.shape])
        halves = mask.reshape(*(m for n in mask.shape for m in (n // 2, 2))).mean(axis=(1, 3, 5))
        mask, sides = halves >= 0.5, 2 * sides
    depth = ndimage.distance_transform_edt(np.pad(mask, 1), sides).max()
    radius = max(_CLOSING * depth, 1.01 * sides.min())
    padded = np.pad(mask, [2 * (int(radius / side) + 2,) for side in sides])
    reached = ndimage.distance_transform_edt(ndimage.distance_transform_edt(~padded, sides) <= radius, sides) <= radius
    return float(np.sqrt(np.count_nonzero(~reached & ~padded) / np.count_nonzero(mask)))


def cut_end(mask: Booleans, at_border: Booleans) -> float:
    """How flat an end of a body is along an axis of the grid, as if slices were cut off; 0 if all are at the border.

    The root of the voxels of its last slice beyond that of two fifths of those of the two slices before it, which is
    what ends that are round have. The mask is no larger than the body; (3, 2) ends are at the border of the volume.
    """
    flattest = 0.0
    for axis, end in np.argwhere(~at_border):
        counts = np.moveaxis(mask, axis, 0)[:: -1 if end else 1][:3].sum(axis=(1, 2))
        if len(counts) == 3:
            flattest = max(flattest, np.sqrt(counts[0]) - np.sqrt(0.4 * counts[1:].mean()))
    return flattest


@dataclass(frozen=True, eq=False)
class Place:
    """The voxels of a label: the folder and the grid in which they lie, and a box of it in bits."""

    grid: tuple[object, ...]
    low: Integers
    shape: tuple[int, ...]
    n_voxels: int
    bits: NDArray[np.uint8]

    def mask(self, low: Integers, high: Integers) -> NDArray[np.uint8]:
        """From one corner of the grid to another."""
        whole = np.unpackbits(self.bits, count=int(np.prod(self.shape))).reshape(self.shape)
        return whole[tuple(map(slice, low - self.low, high - self.low))]


def overlaps(places: Sequence[Place | None], labels: Sequence[str] | None = None) -> Floats:
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

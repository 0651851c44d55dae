"""Defects of voxel masks: detached pieces, cavities, holes, gaps, cut ends, and overlaps.

Shares of voxels are returned as their square roots, whose scatter hardly depends on the size of the share (Bartlett
1936), so that large and small shares can be compared by their standard deviations.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers

# Radius of the ball that closes a body, over that of its largest inscribed ball: gaps are narrower than the body
_CLOSING_RADIUS = 0.8
# Larger boxes are closed on a grid twice as coarse, which still resolves gaps of that width
_MAX_VOXELS = 1 << 20


def stray_root(mask: Booleans) -> float:
    """Return the root of the share of voxels that no face, edge or corner connects to the largest piece."""
    pieces, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    sizes = np.bincount(pieces[mask])
    share = sizes.max() / np.count_nonzero(mask)
    return float(np.sqrt(1 - share))


def cavity_root(mask: Booleans) -> float:
    """Return the root of the number of voxels in enclosed cavities, over that of the body."""
    filled = ndimage.binary_fill_holes(np.pad(mask, 1))
    ratio = np.count_nonzero(filled) / np.count_nonzero(mask)
    return float(np.sqrt(ratio - 1))


def hole_root(mask: Booleans) -> float:
    """Return the root of the number of voxels in holes of slices across any axis of the grid, over that of the body."""
    padded = np.pad(mask, 1)
    holes = np.zeros_like(mask)
    for axis in range(3):
        neighbours = ndimage.generate_binary_structure(3, 1)
        by_slice = np.moveaxis(neighbours, axis, 0)
        by_slice[[0, 2]] = False  # voxels of other slices are no neighbours
        pieces, n_pieces = ndimage.label(~padded, neighbours)
        is_hole = np.arange(n_pieces + 1) > 0
        # The outside contains the padding of the slice.
        outside = np.take(pieces, 0, axis=axis - 1)
        is_hole[outside] = False
        holes |= is_hole[pieces][1:-1, 1:-1, 1:-1]
    return _root_of_share(holes, mask)


def _root_of_share(defect: Booleans, mask: Booleans) -> float:
    """Return the root of the number of voxels of a defect, over that of the body."""
    n_voxels = np.count_nonzero(mask)
    return float(np.sqrt(np.count_nonzero(defect) / n_voxels))


def gap_root(mask: Booleans, sides: Floats) -> float:
    """Return the root of the number of voxels in gaps (tunnels, notches and clefts), over that of the body.

    Gaps are the voxels that morphological closing (Matheron 1975) adds: no ball outside the body reaches them. The
    radius of the ball is 0.8 times that of the largest ball inside the body. Voxels have side lengths `sides` (3,).
    """
    while mask.size > _MAX_VOXELS:
        mask = _halved(mask)
        sides = 2 * sides
    depths = ndimage.distance_transform_edt(np.pad(mask, 1), sides)
    radius = max(_CLOSING_RADIUS * depths.max(), 1.01 * sides.min())
    margins = [int(radius / side) + 2 for side in sides]
    padded = np.pad(mask, [(margin, margin) for margin in margins])
    away = ndimage.distance_transform_edt(~padded, sides)
    dilated = away <= radius
    back = ndimage.distance_transform_edt(dilated, sides)
    outside = back <= radius
    return _root_of_share(~outside & ~padded, mask)


def _halved(mask: Booleans) -> Booleans:
    """Return a mask on a grid twice as coarse: voxels of which at least half was filled."""
    even = np.pad(mask, [(0, n % 2) for n in mask.shape])
    x, y, z = even.shape
    blocks = even.reshape(x // 2, 2, y // 2, 2, z // 2, 2)
    return blocks.mean(axis=(1, 3, 5)) >= 0.5


def cut_end(mask: Booleans, at_border: Booleans) -> float:
    """Return how flat the flattest end of a body is along an axis of the grid, as if slices were cut off.

    The flatness of an end is the root of the number of voxels in its last slice, minus the root of two fifths of the
    mean number in the two slices before it, which is typical of a round end; at least 0.

    Args:
        mask: voxels of the body, in its bounding box.
        at_border: (3, 2) whether each end lies at the border of the volume; such ends do not count.
    """
    flattest = 0.0
    for axis, end in np.argwhere(~at_border):
        slices = np.moveaxis(mask, axis, 0)
        if end:
            slices = slices[::-1]
        counts = slices[:3].sum(axis=(1, 2))
        if len(counts) == 3:
            round_end = 0.4 * counts[1:].mean()
            flattest = max(flattest, np.sqrt(counts[0]) - np.sqrt(round_end))
    return flattest


@dataclass(frozen=True, eq=False)
class Place:
    """The voxels of a label in its grid."""

    grid: tuple[object, ...]  # key of the grid: only labels with the same key can overlap
    low: Integers  # (3,) first corner of the bounding box
    shape: tuple[int, ...]  # of the bounding box
    n_voxels: int
    bits: NDArray[np.uint8]  # voxels of the bounding box, packed

    def mask(self, low: Integers, high: Integers) -> NDArray[np.uint8]:
        """Return the voxels between two corners of the grid."""
        voxels = np.unpackbits(self.bits, count=int(np.prod(self.shape)))
        box = voxels.reshape(self.shape)
        return box[tuple(map(slice, low - self.low, high - self.low))]


def overlaps(places: Sequence[Place | None], labels: Sequence[str] | None = None) -> Floats:
    """Return the shares (N, N) of the voxels of each label (row) that lie in each other label (column).

    The share is 0 between labels of one class, which may belong to different subjects.
    """
    shares = np.zeros((len(places), len(places)))
    grids = defaultdict[tuple[object, ...], list[tuple[int, Place]]](list)
    for i, place in enumerate(places):
        if place is not None:
            grids[place.grid].append((i, place))
    for same_grid in grids.values():
        for (i, a), (j, b) in combinations(same_grid, 2):
            if labels is not None and labels[i] == labels[j]:
                continue
            low = np.maximum(a.low, b.low)
            high = np.minimum(a.low + a.shape, b.low + b.shape)
            if (low < high).all():
                is_shared = a.mask(low, high) & b.mask(low, high)
                n_shared = np.count_nonzero(is_shared)
                shares[i, j] = n_shared / a.n_voxels
                shares[j, i] = n_shared / b.n_voxels
    return shares

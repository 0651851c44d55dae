"""Boxes of voxels: from a corner of indices to another, which is beyond the box."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans, Integers

TOUCHING = np.ones((3, 3, 3), dtype=bool)
"""Voxels that share a corner are connected."""


def box_of(low: Integers, high: Integers) -> tuple[slice, ...]:
    """Return the slices of a box."""
    return tuple(map(slice, low, high))


def bounds_of(mask: Booleans) -> tuple[Integers, Integers]:
    """Return the corners (3,) of the smallest box that holds a mask, which is not empty."""
    (box,) = ndimage.find_objects(mask.view(np.uint8))
    low = np.array([side.start for side in box])
    high = np.array([side.stop for side in box])
    return low, high


def block_corners(shape: Sequence[int], side: int) -> Iterator[Integers]:
    """Yield the lowest corners (3,) of the blocks of some side that tile a grid."""
    for block in np.ndindex(*(math.ceil(n / side) for n in shape)):
        yield side * np.array(block)

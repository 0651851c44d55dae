"""Slices that were missed between two pieces of a label."""

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans
from igps.mesh._level_set import SPECK_VOLUME

TOUCHING = np.ones((3, 3, 3), dtype=bool)
"""Voxels that share a corner belong together."""

_MISSED = 3  # most slices between two pieces that are taken for missed
_PLANE = 0.8  # share of the lines from one to the other, at least, that cross one plane then


def with_missed_slices(mask: Booleans, notes: list[str]) -> Booleans:
    """With slices filled that part two pieces, of which none is a speck, along one plane.

    Where pieces are near each other but face each other in a slant, as vertebrae do, nothing is filled.
    """
    label, n_pieces = ndimage.label(mask, TOUCHING)
    if n_pieces < 2:
        return mask
    size = np.bincount(label.reshape(-1))
    label[(size < SPECK_VOLUME * np.count_nonzero(mask))[label]] = 0
    filled = mask.copy()
    for axis in range(3):
        slices, of_filled = np.moveaxis(label, axis, 0), np.moveaxis(filled, axis, 0)
        found = []  # the two pieces, the slice below the gap, its width, and the place there
        for width in range(1, min(_MISSED, len(slices) - 2) + 1):
            below, above = slices[: -width - 1], slices[width + 1 :]
            start, row, column = np.nonzero((below > 0) & (above > 0) & (below != above))
            pieces = np.sort([below[start, row, column], above[start, row, column]], axis=0)
            found.append(np.stack([*pieces, start, np.full(len(start), width), row, column], axis=1))
        gaps = np.concatenate(found) if found else np.zeros((0, 6), dtype=np.int64)
        for pair in np.unique(gaps[:, :2], axis=0):
            between = gaps[(gaps[:, :2] == pair).all(axis=1)]
            planes, n_lines = np.unique(between[:, 2:4], axis=0, return_counts=True)
            start, width = planes[n_lines.argmax()]
            across = (between[:, 2] <= start) & (between[:, 2:4].sum(axis=1) >= start + width)
            if np.count_nonzero(across) >= _PLANE * len(between):
                for start, width, row, column in between[across, 2:]:
                    of_filled[start + 1 : start + 1 + width, row, column] = True
    if n_filled := np.count_nonzero(filled) - np.count_nonzero(mask):
        notes.append(f"filled {n_filled} voxels of slices that were missed between pieces")
    return filled

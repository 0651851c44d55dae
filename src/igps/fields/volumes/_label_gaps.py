"""Fill slices that were missed between two pieces of a label."""

import numpy as np
from scipy import ndimage

from igps._arrays import Booleans
from igps._text import counted
from igps.mesh._level_set import SPECK_VOLUME

TOUCHING = np.ones((3, 3, 3), dtype=bool)
"""Structuring element: voxels that share a corner are connected."""

_MAX_MISSED_SLICES = 3  # wider gaps between pieces are not filled
_MIN_PLANE_SHARE = 0.8  # share of the lines across a gap that must cross one plane


def fill_missed_slices(mask: Booleans, notes: list[str]) -> Booleans:
    """Return the mask, with slices filled that separate two pieces along one plane. Specks do not count as pieces.

    Nothing is filled between pieces that are near but face each other at a slant, as vertebrae do.
    """
    label, n_pieces = ndimage.label(mask, TOUCHING)
    if n_pieces < 2:
        return mask
    size = np.bincount(label.reshape(-1))
    label[(size < SPECK_VOLUME * np.count_nonzero(mask))[label]] = 0
    filled = mask.copy()
    for axis in range(3):
        slices = np.moveaxis(label, axis, 0)
        filled_slices = np.moveaxis(filled, axis, 0)
        lines = []  # rows: the two pieces, the slice below the gap, the width of the gap, row and column in the slice
        for width in range(1, min(_MAX_MISSED_SLICES, len(slices) - 2) + 1):
            below = slices[: -width - 1]
            above = slices[width + 1 :]
            start, row, column = np.nonzero((below > 0) & (above > 0) & (below != above))
            pieces = np.sort([below[start, row, column], above[start, row, column]], axis=0)
            lines.append(
                np.stack([*pieces, start, np.full(len(start), width), row, column], axis=1)
            )
        gaps = np.concatenate(lines) if lines else np.zeros((0, 6), dtype=np.int64)
        for pair in np.unique(gaps[:, :2], axis=0):
            between = gaps[(gaps[:, :2] == pair).all(axis=1)]
            planes, n_lines = np.unique(between[:, 2:4], axis=0, return_counts=True)
            start, width = planes[n_lines.argmax()]
            across = (between[:, 2] <= start) & (between[:, 2:4].sum(axis=1) >= start + width)
            if np.count_nonzero(across) >= _MIN_PLANE_SHARE * len(between):
                for start, width, row, column in between[across, 2:]:
                    filled_slices[start + 1 : start + 1 + width, row, column] = True
    if n_filled := np.count_nonzero(filled) - np.count_nonzero(mask):
        notes.append(
            f"filled {counted(int(n_filled), 'voxel')} of slices that were missed between pieces"
        )
    return filled

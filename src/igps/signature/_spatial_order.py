"""Orders of points in which neighbours in the list are neighbours in space."""

from __future__ import annotations

import math

import numpy as np

from igps._arrays import Floats, Integers


def spatial_order(points: Floats, size: int) -> Integers:
    """An order (n,) of points (n, 3) in which all runs of size·2ᵏ, counted from the start, are compact in space.

    The median cut: halves along the longest side of their bounding box, again and again.
    """
    n_points = len(points)
    n_cuts = max(0, math.ceil(math.log2(max(1, n_points) / size)))
    order = np.minimum(np.arange(size << n_cuts), n_points)
    # What is missing to 2ᵏ full runs is in the middle for the boxes, and behind all points for the cuts.
    padded = np.ascontiguousarray(np.vstack([points, points.mean(axis=0) if n_points else np.zeros(3)]).T)
    for cut in range(n_cuts):
        boxes = padded.take(order, axis=1).reshape(3, 1 << cut, -1)
        along = boxes[np.ptp(boxes, axis=2).argmax(axis=0), np.arange(1 << cut)]
        along[order.reshape(along.shape) == n_points] = np.inf
        halves = np.argpartition(along, along.shape[1] // 2 - 1, axis=1)
        order = np.take_along_axis(order.reshape(along.shape), halves, axis=1).ravel()
    return order[order < n_points]


def principal_axes(points: Floats) -> Floats:
    """The principal axes of points (n, 3), as columns (3, 3), towards the longer tails: cuts turn with the points."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred).eigenvectors
    skewness = ((centred @ axes) ** 3).sum(axis=0)
    return np.where(skewness < 0, -axes, axes)

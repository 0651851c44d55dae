"""Whether a surface crosses itself."""

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Booleans, Floats, Integers


def crossing_faces(vertices: Floats, faces: Integers) -> Integers:
    """Pairs of faces (N,2) without a common vertex of which an edge of one passes through the other.

    Pairs are tried whose bounding boxes overlap, found by their circumscribed balls. Faces that merely touch, or lie in
    one plane, are not reported.
    """
    corners = vertices[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    i, j = _near(corners).T
    # One axis after another, and the common vertices last: each step leaves fewer pairs.
    for axis in range(3):
        boxes = (low[i, axis] <= high[j, axis]) & (low[j, axis] <= high[i, axis])
        i, j = i[boxes], j[boxes]
    apart = ~(faces[i][:, :, None] == faces[j][:, None]).any(axis=(1, 2))
    i, j = i[apart], j[apart]
    a, b = corners[i], corners[j]
    crossed = np.zeros(len(i), dtype=bool)
    for one, other in ((a, b), (b, a)):
        for k in range(3):
            crossed |= _passes(one[:, k], one[:, (k + 1) % 3], other)
    return np.stack([i[crossed], j[crossed]], axis=1)


def _near(corners: Floats) -> Integers:
    """Pairs (N,2), the smaller number first, of faces whose balls around their centres may overlap."""
    centres = corners.mean(axis=1)
    reach = np.sqrt(((corners - centres[:, None]) ** 2).sum(axis=2).max(axis=1))
    usual = float(np.quantile(reach, 0.9))
    small, large = np.nonzero(reach <= usual)[0], np.nonzero(reach > usual)[0]
    found = [small[cKDTree(centres[small]).query_pairs(2.0 * usual, output_type="ndarray")]]
    if len(large):
        # Large faces are few, and each looks as far as it needs to.
        around = cKDTree(centres).query_ball_point(centres[large], reach[large] + reach.max())
        others = np.concatenate([np.asarray(one, dtype=np.int64) for one in around])
        pairs = np.stack([np.repeat(large, [len(one) for one in around]), others], axis=1)
        both = reach[pairs[:, 1]] > usual
        found.append(pairs[~both | (pairs[:, 0] < pairs[:, 1])])
    return np.sort(np.concatenate(found), axis=1)


def _passes(start: Floats, end: Floats, triangle: Floats) -> Booleans:
    """Whether segments (N,3) to (N,3) pass through triangles (N,3,3), by the signs of five tetrahedra."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    normal = np.cross(b - a, c - a)
    above = ((start - a) * normal).sum(axis=1)
    below = ((end - a) * normal).sum(axis=1)
    way = end - start

    def side(p: Floats, q: Floats) -> Floats:
        return (np.cross(p - start, q - start) * way).sum(axis=1)

    u, v, w = side(a, b), side(b, c), side(c, a)
    inside = ((u > 0.0) & (v > 0.0) & (w > 0.0)) | ((u < 0.0) & (v < 0.0) & (w < 0.0))
    return (above * below < 0.0) & inside

"""Detection of self-intersections of a surface."""

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Booleans, Floats, Integers


def crossing_faces(vertices: Floats, faces: Integers) -> Integers:
    """Find the pairs (N,2) of faces without a common vertex where an edge of one face passes through the other.

    Candidates are pairs of overlapping bounding boxes, found by balls around the faces. Faces that merely touch, or
    that lie in one plane, are not reported.
    """
    corners = vertices[faces]
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    i, j = _candidates(corners).T
    # Each test leaves fewer pairs for the next, more expensive one.
    for axis in range(3):
        boxes = (low[i, axis] <= high[j, axis]) & (low[j, axis] <= high[i, axis])
        i = i[boxes]
        j = j[boxes]
    apart = ~(faces[i][:, :, None] == faces[j][:, None]).any(axis=(1, 2))
    i = i[apart]
    j = j[apart]
    a = corners[i]
    b = corners[j]
    crossed = np.zeros(len(i), dtype=bool)
    for first, second in ((a, b), (b, a)):
        for k in range(3):
            crossed |= _passes(first[:, k], first[:, (k + 1) % 3], second)
    return np.stack([i[crossed], j[crossed]], axis=1)


def _candidates(corners: Floats) -> Integers:
    """Pairs (N,2), the smaller index first, of faces whose balls around their centres may overlap."""
    centres = corners.mean(axis=1)
    radii = np.sqrt(((corners - centres[:, None]) ** 2).sum(axis=2).max(axis=1))
    max_small = float(np.quantile(radii, 0.9))
    small = np.nonzero(radii <= max_small)[0]
    large = np.nonzero(radii > max_small)[0]
    candidates = [
        small[cKDTree(centres[small]).query_pairs(2.0 * max_small, output_type="ndarray")]
    ]
    if len(large):
        # The few large faces are searched one by one, so that they do not enlarge the search radius of all faces.
        neighbours = cKDTree(centres).query_ball_point(centres[large], radii[large] + radii.max())
        others = np.concatenate([np.asarray(row, dtype=np.int64) for row in neighbours])
        pairs = np.stack([np.repeat(large, [len(row) for row in neighbours]), others], axis=1)
        both_large = radii[pairs[:, 1]] > max_small
        candidates.append(pairs[~both_large | (pairs[:, 0] < pairs[:, 1])])
    return np.sort(np.concatenate(candidates), axis=1)


def _passes(start: Floats, end: Floats, triangle: Floats) -> Booleans:
    """Whether segments (N,3) to (N,3) pass through triangles (N,3,3), by the signed volumes of five tetrahedra."""
    a = triangle[:, 0]
    b = triangle[:, 1]
    c = triangle[:, 2]
    normal = np.cross(b - a, c - a)
    above = ((start - a) * normal).sum(axis=1)
    below = ((end - a) * normal).sum(axis=1)
    direction = end - start

    def side(p: Floats, q: Floats) -> Floats:
        return (np.cross(p - start, q - start) * direction).sum(axis=1)

    u = side(a, b)
    v = side(b, c)
    w = side(c, a)
    inside = ((u > 0.0) & (v > 0.0) & (w > 0.0)) | ((u < 0.0) & (v < 0.0) & (w < 0.0))
    return (above * below < 0.0) & inside

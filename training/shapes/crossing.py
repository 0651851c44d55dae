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
        starts_before = low[i, axis] <= high[j, axis]
        ends_behind = low[j, axis] <= high[i, axis]
        overlaps = starts_before & ends_behind
        i = i[overlaps]
        j = j[overlaps]
    is_common = faces[i][:, :, None] == faces[j][:, None]
    apart = ~is_common.any(axis=(1, 2))
    i = i[apart]
    j = j[apart]
    a = corners[i]
    b = corners[j]
    crossed = np.zeros(len(i), dtype=bool)
    for first, second in ((a, b), (b, a)):
        for k in range(3):
            start = first[:, k]
            end = first[:, (k + 1) % 3]
            crossed |= _passes(start, end, second)
    return np.stack([i[crossed], j[crossed]], axis=1)


def _candidates(corners: Floats) -> Integers:
    """Pairs (N,2), the smaller index first, of faces whose balls around their centres may overlap."""
    centres = corners.mean(axis=1)
    offsets = corners - centres[:, None]
    squares = (offsets**2).sum(axis=2)
    radii = np.sqrt(squares.max(axis=1))
    max_small = float(np.quantile(radii, 0.9))
    small = np.nonzero(radii <= max_small)[0]
    large = np.nonzero(radii > max_small)[0]
    tree = cKDTree(centres[small])
    near = tree.query_pairs(2.0 * max_small, output_type="ndarray")
    candidates = [small[near]]
    if len(large):
        # The few large faces are searched one by one, so that they do not enlarge the search radius of all faces.
        reach = radii[large] + radii.max()
        neighbours = cKDTree(centres).query_ball_point(centres[large], reach)
        others = np.concatenate([np.asarray(row, dtype=np.int64) for row in neighbours])
        own = np.repeat(large, [len(row) for row in neighbours])
        is_small = radii[others] <= max_small
        is_first = own < others
        pairs = np.stack([own, others], axis=1)
        candidates.append(pairs[is_small | is_first])
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
    all_positive = (u > 0.0) & (v > 0.0) & (w > 0.0)
    all_negative = (u < 0.0) & (v < 0.0) & (w < 0.0)
    is_cut = above * below < 0.0
    return is_cut & (all_positive | all_negative)

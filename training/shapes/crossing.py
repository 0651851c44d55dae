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
    pairs = _candidates(corners)
    # Each test leaves fewer pairs for the next, more expensive one.
    for axis in range(3):
        low = corners[:, :, axis].min(axis=1)[pairs]
        high = corners[:, :, axis].max(axis=1)[pairs]
        overlaps = low.max(axis=1) <= high.min(axis=1)
        pairs = pairs[overlaps]
    is_common = faces[pairs[:, 0], :, None] == faces[pairs[:, 1], None]
    pairs = pairs[~is_common.any(axis=(1, 2))]
    one = corners[pairs[:, 0]]
    other = corners[pairs[:, 1]]
    is_crossed = np.zeros(len(pairs), dtype=bool)
    for triangle, crossing in ((one, other), (other, one)):
        for k in range(3):
            start = crossing[:, k]
            end = crossing[:, (k + 1) % 3]
            is_crossed |= _passes(start, end, triangle)
    return pairs[is_crossed]


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
        for face, others in zip(large, map(np.array, neighbours), strict=True):
            is_small = radii[others] <= max_small
            partners = others[is_small | (others > face)]
            candidates.append(np.stack([np.full_like(partners, face), partners], axis=1))
    return np.sort(np.concatenate(candidates), axis=1)


def _passes(start: Floats, end: Floats, triangle: Floats) -> Booleans:
    """Whether segments (N,3) to (N,3) pass through triangles (N,3,3), by the signed volumes of five tetrahedra."""
    a, b, c = np.moveaxis(triangle, 1, 0)
    normal = np.cross(b - a, c - a)
    above = ((start - a) * normal).sum(axis=1)
    below = ((end - a) * normal).sum(axis=1)
    direction = end - start

    def side(p: Floats, q: Floats) -> Floats:
        return (np.cross(p - start, q - start) * direction).sum(axis=1)

    sides = np.stack([side(a, b), side(b, c), side(c, a)])
    all_positive = (sides > 0.0).all(axis=0)
    all_negative = (sides < 0.0).all(axis=0)
    is_cut = above * below < 0.0
    return is_cut & (all_positive | all_negative)

"""Polygons of a file, cut into triangles."""

import numpy as np

from igps._arrays import Floats, Integers

# Polygons of more corners are not cut ear by ear: the time grows with the square of their number, or faster.
_MOST_CORNERS = 2000


def triangles(corners: Integers, n_corners: Integers) -> Integers:
    """Polygons, with their corners laid end to end, cut into triangles from their first corners, (F, 3).

    Triangles come first, then the first and the second halves of quadrilaterals, then larger polygons.
    """
    starts = np.cumsum(n_corners) - n_corners
    pieces = [corners[starts[n_corners == 3][:, None] + np.arange(3)]]
    quads = corners[starts[n_corners == 4][:, None] + np.arange(4)]
    pieces += [quads[:, [0, 1, 2]], quads[:, [2, 3, 0]]]
    large = np.flatnonzero(n_corners > 4)
    if len(large):
        n = n_corners[large] - 2
        at = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        first = np.repeat(starts[large], n)
        pieces.append(np.stack([corners[first], corners[first + at + 1], corners[first + at + 2]], axis=1))
    return np.concatenate(pieces)


def of_strip(corners: Integers) -> Integers:
    """The triangles (n - 2, 3) of a strip (n,): each has a side of the one before, and is turned like it."""
    if len(corners) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    found = np.lib.stride_tricks.sliding_window_view(corners, 3).copy()
    found[1::2] = found[1::2, ::-1]
    return found


def flat_triangles(corners: Integers, n_corners: Integers, vertices: Floats) -> Integers:
    """The same, but polygons that would fold over themselves are cut ear by ear (Meisters 1975), and come last.

    A polygon that crosses itself may run out of ears; the rest is cut from its first corner. Polygons of fewer than
    three corners have no area, and are left out.
    """
    has_area = n_corners >= 3
    corners, n_corners = corners[np.repeat(has_area, n_corners)], n_corners[has_area]
    if n_corners.max(initial=0) < 4 or corners.min() < 0 or corners.max() >= len(vertices):
        return triangles(corners, n_corners)
    starts = np.cumsum(n_corners) - n_corners
    owner = np.repeat(np.arange(len(n_corners)), n_corners)
    first = np.repeat(corners[starts], n_corners)
    following = np.roll(corners, -1)
    following[starts + n_corners - 1] = corners[starts]
    doubled = np.cross(vertices[corners] - vertices[first], vertices[following] - vertices[first])
    whole = np.stack([np.bincount(owner, doubled[:, axis], len(n_corners)) for axis in range(3)], axis=1)
    with np.errstate(invalid="ignore"):  # what is not finite is refused later
        turned = np.einsum("ij,ij->i", doubled, whole[owner]) < -1e-9 * np.einsum("ij,ij->i", whole, whole)[owner]
    folded = np.zeros(len(n_corners), dtype=bool)
    folded[owner[turned]] = True
    folded &= n_corners <= _MOST_CORNERS
    kept = triangles(corners[~folded[owner]], n_corners[~folded])
    cut = [_without_ears(corners[starts[i] :][: n_corners[i]], vertices, whole[i]) for i in np.flatnonzero(folded)]
    return np.concatenate([kept, *cut])


def _without_ears(polygon: Integers, vertices: Floats, normal: Floats) -> Integers:
    """Triangles (n − 2, 3) of a polygon (n,) that may have corners turned inwards."""
    left, found, at, tried = polygon.tolist(), [], 0, 0
    while tried <= len(left) > 3:
        a, b, c = (left[(at + k) % len(left)] for k in (-1, 0, 1))
        three = vertices[[a, b, c]]
        sides = np.roll(three, -1, axis=0) - three
        others = vertices[[k for k in left if k not in (a, b, c)]]
        # On which side of each side the others lie, (n, 3)
        beside = np.cross(sides, others[:, None] - three) @ normal
        if np.cross(sides[0], sides[1]) @ normal > 0 and not (beside >= 0).all(axis=1).any():
            found.append((a, b, c))
            del left[at]
            at, tried = at % len(left), 0
        else:
            at, tried = (at + 1) % len(left), tried + 1
    rest = [(left[0], left[k], left[k + 1]) for k in range(1, len(left) - 1)]
    return np.array([*found, *rest], dtype=np.int64)

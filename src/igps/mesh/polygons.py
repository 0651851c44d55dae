"""Triangulation of the polygons of a file."""

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.surface import dots, sums


def triangles(corners: Integers, n_corners: Integers) -> Integers:
    """Cut polygons, whose corners are laid end to end, into fans of triangles (F, 3) around their first corners.

    Triangles come first, then the first and the second halves of quadrilaterals, then larger polygons.
    """
    starts = np.cumsum(n_corners) - n_corners

    def of_size(n: int) -> Integers:
        """Return the corners (N, n) of the polygons that have n corners."""
        first = starts[n_corners == n]
        return corners[first[:, None] + np.arange(n)]

    quads = of_size(4)
    first_halves = quads[:, [0, 1, 2]]
    second_halves = quads[:, [2, 3, 0]]
    is_large = n_corners > 4
    n_triangles = n_corners[is_large] - 2
    n_before = np.cumsum(n_triangles) - n_triangles
    first = np.repeat(starts[is_large], n_triangles)
    number = np.arange(len(first)) - np.repeat(n_before, n_triangles)
    second = first + 1 + number
    fans = np.column_stack([first, second, second + 1])
    return np.concatenate([of_size(3), first_halves, second_halves, corners[fans]])


def strip_triangles(corners: Integers) -> Integers:
    """Return the triangles (n − 2, 3) of a strip (n,), all with the orientation of the first."""
    if len(corners) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    faces = np.lib.stride_tricks.sliding_window_view(corners, 3).copy()
    faces[1::2] = faces[1::2, ::-1]
    return faces


def flat_triangles(corners: Integers, n_corners: Integers, vertices: Floats) -> Integers:
    """Triangulate as `triangles` does, except for polygons whose fans would fold over themselves.

    Those polygons are triangulated by manifold3d, and come last. Polygons of fewer than three corners are dropped.
    """
    has_area = n_corners >= 3
    corners = corners[np.repeat(has_area, n_corners)]
    n_corners = n_corners[has_area]
    if n_corners.max(initial=0) < 4:
        return triangles(corners, n_corners)
    if corners.min() < 0 or corners.max() >= len(vertices):
        return triangles(corners, n_corners)
    starts = np.cumsum(n_corners) - n_corners
    owner = np.repeat(np.arange(len(n_corners)), n_corners)
    first = np.repeat(corners[starts], n_corners)
    following = np.roll(corners, -1)
    following[starts + n_corners - 1] = corners[starts]
    # Doubled area vectors of the triangles in the fans, and of whole polygons
    apex = vertices[first]
    in_fan = np.cross(vertices[corners] - apex, vertices[following] - apex)
    total = sums(owner, in_fan, len(n_corners))
    with np.errstate(invalid="ignore"):  # coordinates that are not finite are refused later
        along_total = dots(in_fan, total[owner])
        squared = dots(total, total)
        is_flipped = along_total < -1e-9 * squared[owner]
    is_folded = np.zeros(len(n_corners), dtype=bool)
    is_folded[owner[is_flipped]] = True
    pieces = [triangles(corners[~is_folded[owner]], n_corners[~is_folded])]
    for i in np.flatnonzero(is_folded):
        polygon = corners[starts[i] : starts[i] + n_corners[i]]
        pieces.append(_triangulated(polygon, vertices, total[i]))
    return np.concatenate(pieces)


def _triangulated(polygon: Integers, vertices: Floats, normal: Floats) -> Integers:
    """Triangulate a polygon (n,), which may be concave, into (n − 2, 3) triangles, in the plane across its normal."""
    import manifold3d

    _, _, axes = np.linalg.svd(normal[None])
    across = axes[1:]
    if np.linalg.det([normal, *across]) < 0:
        across = across[::-1]
    corners = vertices[polygon]
    in_plane = (corners - corners[0]) @ across.T
    return np.asarray(polygon[manifold3d.triangulate([in_plane])])


def corners_of_rows(rows: Integers) -> tuple[Integers, Integers]:
    """Return the corners of polygons laid end to end, and their counts, from rows that each begin with the count."""
    starts = []
    at = 0
    while at < len(rows):
        starts.append(at)
        at += max(int(rows[at]), 0) + 1
    if at != len(rows):
        raise ValueError("the numbers of corners do not add up")
    is_corner = np.ones(len(rows), dtype=bool)
    is_corner[starts] = False
    return rows[is_corner], rows[starts]

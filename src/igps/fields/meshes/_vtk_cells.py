"""Surfaces of VTK cells: polygons, and those faces of volume cells that no two cells share."""

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.polygons import flat_triangles, strip_triangles, triangles

# Types of cells by VTK's numbers.
LINE = 3
POLY_LINE = 4
LINES = (LINE, POLY_LINE)
TRIANGLE = 5
STRIP = 6
POLYGON = 7
PIXEL = 8
QUAD = 9
TETRAHEDRON = 10
# Faces of tetrahedra, voxels, hexahedra, wedges and pyramids, outward, as indices of their corners in VTK's order.
_SIDES: dict[int, tuple[tuple[int, ...], ...]] = {
    TETRAHEDRON: ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    11: ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)),
    12: ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    13: ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    14: ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
_WITHOUT_AREA = (0, 1, 2, *LINES)  # empty cells, points and lines
_FLAT = (TRIANGLE, POLYGON, QUAD)
_SUPPORTED = {*_WITHOUT_AREA, *_FLAT, STRIP, PIXEL, *_SIDES}
# Corners of the cells that have a fixed number of them
_N_CORNERS = {PIXEL: 4, TETRAHEDRON: 4, 11: 8, 12: 8, 13: 6, 14: 5}


def surface(corners: Integers, n_corners: Integers, kinds: Integers, vertices: Floats) -> Integers:
    """Return the surface (F, 3) of cells, whose corners are laid end to end; a ValueError for unsupported cells."""
    unknown = set(np.unique(kinds).tolist()) - _SUPPORTED
    if unknown:
        raise ValueError(
            f"cells of type {min(unknown)}; expected flat polygons, or volumes with straight edges"
        )
    for kind, n in _N_CORNERS.items():
        if (n_corners[kinds == kind] != n).any():
            raise ValueError(f"cells of type {kind} with other than {n} corners")
    is_flat = np.isin(kinds, _FLAT)
    of_flat = corners[np.repeat(is_flat, n_corners)]
    faces = [flat_triangles(of_flat, n_corners[is_flat], vertices)]
    starts = np.cumsum(n_corners) - n_corners
    pixels = corners[starts[kinds == PIXEL, None] + np.array([0, 1, 3, 2])]
    faces.append(_triangles_of_rows(pixels))
    for strip in np.flatnonzero(kinds == STRIP):
        start = starts[strip]
        faces.append(strip_triangles(corners[start : start + n_corners[strip]]))
    triangular: list[Integers] = []
    quadrangular: list[Integers] = []
    for kind, sides in _SIDES.items():
        at = starts[kinds == kind, None]
        for side in sides:
            rows = triangular if len(side) == 3 else quadrangular
            rows.append(corners[at + np.array(side)])
    faces.append(_triangles_of_rows(_unshared(np.concatenate(triangular))))
    faces.append(_triangles_of_rows(_unshared(np.concatenate(quadrangular))))
    return np.concatenate(faces)


def _triangles_of_rows(polygons: Integers) -> Integers:
    """Return triangles of polygons (N, C), all of C corners."""
    n_polygons, n_corners = polygons.shape
    return triangles(polygons.ravel(), np.full(n_polygons, n_corners))


def _unshared(sides: Integers) -> Integers:
    """Return the sides that occur once, in any order of their corners."""
    in_order = np.sort(sides, axis=1)
    _, index, count = np.unique(in_order, axis=0, return_inverse=True, return_counts=True)
    return sides[count[index.ravel()] == 1]

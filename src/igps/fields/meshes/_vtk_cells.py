"""Surfaces of VTK cells: polygons, and those faces of volume cells that no two cells share."""

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.polygons import flat_triangles, strip_triangles, triangles

# Types of cells by VTK's numbers.
LINES = LINE, POLY_LINE = 3, 4
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


def surface(corners: Integers, n_corners: Integers, kinds: Integers, vertices: Floats) -> Integers:
    """Return the surface (F, 3) of cells, whose corners are laid end to end; a ValueError for unsupported cells."""
    unknown = set(np.unique(kinds).tolist()) - {
        *_WITHOUT_AREA,
        TRIANGLE,
        STRIP,
        POLYGON,
        PIXEL,
        QUAD,
        *_SIDES,
    }
    if unknown:
        raise ValueError(
            f"cells of type {min(unknown)}; expected flat polygons, or volumes with straight edges"
        )
    flat = np.isin(kinds, (TRIANGLE, POLYGON, QUAD))
    faces = [flat_triangles(corners[np.repeat(flat, n_corners)], n_corners[flat], vertices)]
    starts = np.cumsum(n_corners) - n_corners
    for kind, n in (
        (PIXEL, 4),
        *((kind, max(map(max, sides)) + 1) for kind, sides in _SIDES.items()),
    ):
        if (n_corners[kinds == kind] != n).any():
            raise ValueError(f"cells of type {kind} with other than {n} corners")
    pixels = starts[kinds == PIXEL, None]
    faces.append(
        triangles(corners[pixels + np.array([0, 1, 3, 2])].ravel(), np.full(len(pixels), 4))
    )
    for strip in np.flatnonzero(kinds == STRIP):
        faces.append(strip_triangles(corners[starts[strip] : starts[strip] + n_corners[strip]]))
    sides: dict[int, list[Integers]] = {3: [], 4: []}
    for kind, sides_of_kind in _SIDES.items():
        at = starts[kinds == kind, None]
        for side in sides_of_kind if len(at) else ():
            sides[len(side)].append(corners[at + np.array(side)])
    for n, rows in sides.items():
        if rows:
            free = _unshared(np.concatenate(rows))
            faces.append(triangles(free.ravel(), np.full(len(free), n)))
    return np.concatenate(faces)


def _unshared(sides: Integers) -> Integers:
    """Return the sides that occur once, in any order of their corners."""
    _, index, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return sides[count[index.ravel()] == 1]

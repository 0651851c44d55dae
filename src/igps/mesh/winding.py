"""Winding numbers of a triangle mesh."""

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps.mesh.surface import has_area


def winding_number(vertices: NDArray[np.floating], faces: NDArray[np.integer], points: NDArray[np.floating]) -> Floats:
    """Winding number (P,) of a mesh about points (P, 3): the solid angles of its faces over 4π, exact to rounding.

    1 inside and 0 outside a closed, outward oriented surface; fractions for an open one. On the surface itself the
    value is one of those beside it, or between. By libigl (Jacobson, Kavan and Sorkine-Hornung 2013).

    A ValueError of an invalid shape, index or value.
    """
    import igl

    vertices, faces, points = checked_places(vertices, faces, points)
    if not has_area(vertices[faces]).any():
        raise ValueError("faces: expected at least one face with an area, got flat ones only; check the mesh")
    if not len(points):
        return np.zeros(0)
    return np.asarray(igl.winding_number(vertices, faces, points))


def checked_places(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], points: NDArray[np.floating]
) -> tuple[Floats, Integers, Floats]:
    """The vertices of a mesh, its faces and points, in double precision and 64 bits; a ValueError if one is invalid."""
    at, index, where = np.asarray(vertices, np.float64), np.asarray(faces), np.asarray(points, np.float64)
    for name, array in (("vertices", at), ("faces", index), ("points", where)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: expected shape (n, 3), got {array.shape}")
    for name, array in (("vertices", at), ("points", where)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite coordinates, got NaN or infinity; remove those rows")
    if not np.issubdtype(index.dtype, np.integer):
        raise ValueError(f"faces: expected integer vertex indices, got {index.dtype}")
    if len(index) == 0 or index.min() < 0 or index.max() >= len(at):
        raise ValueError(f"faces: expected at least one face, with indices in [0, {len(at)}), got another")
    return at, np.array(index, np.int64, order="C"), where

"""Winding numbers of a triangle mesh."""

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps.mesh.surface import has_area


def winding_number(vertices: NDArray[np.floating], faces: NDArray[np.integer], points: NDArray[np.floating]) -> Floats:
    """Return the winding numbers (P,) of a mesh about points (P, 3): the solid angle of its faces over 4π.

    The winding number is 1 inside and 0 outside a closed, outward oriented surface, and a fraction for an open one. On
    the surface itself it lies between the values on both sides, inclusive. It is exact up to rounding, and computed by
    libigl (Jacobson, Kavan and Sorkine-Hornung 2013).

    Raises:
        ValueError: an array has an invalid shape or value, or all faces are flat.
    """
    import igl

    vertices, faces, points = checked_places(vertices, faces, points)
    if not has_area(vertices[faces]).any():
        raise ValueError("faces: expected at least one face with an area, got flat faces only; check the mesh")
    if not len(points):
        return np.zeros(0)
    return np.asarray(igl.winding_number(vertices, faces, points))


def checked_places(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], points: NDArray[np.floating]
) -> tuple[Floats, Integers, Floats]:
    """Check the vertices and faces of a mesh, and points; return them as float64, int64 and float64.

    Raises:
        ValueError: an array has an invalid shape or value.
    """
    v, f, p = np.asarray(vertices, np.float64), np.asarray(faces), np.asarray(points, np.float64)
    for name, array in (("vertices", v), ("faces", f), ("points", p)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: expected shape (n, 3), got {array.shape}")
    for name, array in (("vertices", v), ("points", p)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite coordinates, got NaN or infinity; remove those rows")
    if not np.issubdtype(f.dtype, np.integer):
        raise ValueError(f"faces: expected integer vertex indices, got {f.dtype}")
    if len(f) == 0:
        raise ValueError("faces: expected at least one face, got none")
    if f.min() < 0 or f.max() >= len(v):
        raise ValueError(f"faces: expected indices in [0, {len(v)}), got {f.min()} to {f.max()}")
    return v, np.array(f, np.int64, order="C"), p

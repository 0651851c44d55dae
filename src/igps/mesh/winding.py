"""Winding numbers of a triangle mesh."""

import numpy as np
from numpy.typing import ArrayLike

from igps._arrays import Floats, Integers
from igps.mesh.surface import has_area


def winding_number(vertices: ArrayLike, faces: ArrayLike, points: ArrayLike) -> Floats:
    """Return the winding numbers (P,) of a mesh about points (P, 3): the solid angle of its faces over 4π.

    They are 1 inside and 0 outside a closed, outward oriented surface, and fractions for an open one; on the surface
    itself they lie between the values on both sides. They are exact up to rounding, by libigl (Jacobson, Kavan and
    Sorkine-Hornung 2013). A ValueError is raised for invalid arrays, and if all faces are flat.
    """
    import igl

    vertices, faces, points = check_mesh_and_points(vertices, faces, points)
    if not has_area(vertices[faces]).any():
        raise ValueError(
            "faces: expected at least one face with an area, got flat faces only; check the mesh"
        )
    if not len(points):
        return np.zeros(0)
    return np.asarray(igl.winding_number(vertices, faces, points))


def check_mesh_and_points(
    vertices: ArrayLike, faces: ArrayLike, points: ArrayLike
) -> tuple[Floats, Integers, Floats]:
    """Return the vertices and faces of a mesh, and points, as float64 and int64; a ValueError for invalid arrays."""
    v = np.asarray(vertices, np.float64)
    f = np.asarray(faces)
    p = np.asarray(points, np.float64)
    for name, array in (("vertices", v), ("faces", f), ("points", p)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: expected shape (n, 3), got {array.shape}")
    for name, array in (("vertices", v), ("points", p)):
        if not np.isfinite(array).all():
            raise ValueError(
                f"{name}: expected finite coordinates, got NaN or infinity; remove those rows"
            )
    if not np.issubdtype(f.dtype, np.integer):
        raise ValueError(f"faces: expected integer vertex indices, got {f.dtype}")
    if len(f) == 0:
        raise ValueError("faces: expected at least one face, got none")
    if f.min() < 0 or f.max() >= len(v):
        raise ValueError(f"faces: expected indices in [0, {len(v)}), got {f.min()} to {f.max()}")
    return v, np.array(f, np.int64, order="C"), p

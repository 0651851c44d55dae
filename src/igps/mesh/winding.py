"""Winding numbers of a triangle mesh."""

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps.mesh.surface import has_area

_TREE_ERROR = 0.01  # of libigl's fast winding numbers; twice the largest found


def winding_number(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], points: NDArray[np.floating], *,
    accuracy: float | None = None,
) -> Floats:  # fmt: skip
    """Winding number (P,) of a mesh about points (P, 3): the solid angles of its faces over 4π, by libigl.

    1 inside and 0 outside a closed, outward oriented surface; fractions for an open one. On the surface itself the
    value is one of those beside it, or between.

    The tree of Jacobson, Kavan and Sorkine-Hornung 2013 is exact to rounding. Where ``accuracy``, the error allowed, is
    at least 0.01, that of Barill, Dickson, Schmidt, Levin and Jacobson 2018 takes over, which is several times faster.
    Its error is not proved: the largest found was 0.0044, at 12,000 points in and around soups, open and closed
    surfaces.

    Raises:
        ValueError: a shape, an index or a value of an argument is invalid.
    """
    import igl

    if accuracy is not None and not accuracy > 0:
        raise ValueError(f"accuracy: expected None (exact) or a positive error, got {accuracy}")
    vertices, faces, points = checked_places(vertices, faces, points)
    if not has_area(vertices[faces]).any():
        raise ValueError("faces: expected at least one face with an area, got flat ones only; check the mesh")
    if not len(points):
        return np.zeros(0)
    tree = igl.winding_number if accuracy is None or accuracy < _TREE_ERROR else igl.fast_winding_number
    return np.asarray(tree(vertices, faces, points))


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

"""A surface from a cloud of points: a disc around each."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps.mesh.mesh import MeshError
from igps.mesh.surface import longest_side

# Points beyond which they are thinned out first.
_MANY_POINTS = 200_000
# Points that are so much less spread across than along are on a line, whatever single precision did to them.
_LINE = 1e-5


def splats(points: Floats, normals: Floats | None, resolution: int, name: str) -> tuple[Floats, Integers, float]:
    """A disc (a hexagon) around each point of a cloud, and the spacing of the points."""
    if len(points) < 10:
        few = f"{name}: a cloud of {len(points)} points; at least 10 are needed for a surface."
        raise MeshError(f"{few} Check that the file holds faces, or scan more points.")
    side = longest_side(points)
    if side == 0:
        raise MeshError(f"{name}: all points are in one place; a surface was expected. Check the file.")
    from_middle = points - points.mean(axis=0)
    _, across, along = np.linalg.eigvalsh(from_middle.T @ from_middle)
    if across < _LINE**2 * along:
        line = f"{name}: all {len(points)} points are on one line; a surface was expected."
        raise MeshError(f"{line} If the file holds lines, give them thickness.")
    if len(points) > _MANY_POINTS:
        # One point in each quarter of a cell.
        lattice = np.floor((points - points.min(axis=0)) / (side / (4 * resolution))).astype(np.int64)
        _, first = np.unique(lattice, axis=0, return_index=True)
        points, normals = points[first], None if normals is None else normals[first]
    away, neighbours = cKDTree(points).query(points, k=min(13, len(points)))
    # A disc reaches the third ring of neighbours or so in an even cloud; where points are rare, it does not run wild.
    own = away[:, min(6, away.shape[1] - 1)]
    spacing = float(np.median(own))
    radius = np.clip(own, spacing / 2, 2 * spacing)
    if normals is None:
        local = points[neighbours] - points[neighbours].mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", local, local))
        normals = axes[:, :, 0]
    normals = np.asarray(normals, dtype=np.float64)
    if normals.shape != points.shape or not np.isfinite(normals).all():
        raise MeshError(f"{name}: normals: expected finite numbers of shape {points.shape}. Leave them out.")
    # Two directions of the plane: the axis least along the normal gives the first.
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    u = np.cross(normals, axis)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    v = np.cross(normals, u)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
    angle = np.arange(6)[:, None] * np.pi / 3
    rim = points[:, None] + radius[:, None, None] * (np.cos(angle) * u[:, None] + np.sin(angle) * v[:, None])
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    faces = (6 * np.arange(len(points))[:, None, None] + fan).reshape(-1, 3)
    return rim.reshape(-1, 3), faces, spacing / 2

"""From any triangles, or points, to the closed surface of one body: distances, a flood, marching cubes.

What a flood from outside cannot reach is the body; `_outside` says which openings it passes. The grid's points carry
their exact distance to the triangles, negative in the body, so that the surface of a solid lies where it was; only what
has no inside, a sheet or a wire, gets a thickness of about a cell. Marching cubes draw the surface (Lewiner et al.
2003), and quadrics simplify it (Garland and Heckbert 1997).

**Several pieces** become one body: those of less than a five-hundredth of the volume are dropped, the others joined by
straight bars of about a cell's radius, each where the gap is narrowest (a minimum spanning tree of the gaps). Joined
pieces retrieve nearly as the whole body does; the spectra of all pieces side by side tell how a body was cut, and the
largest piece alone is another body: both retrieve far worse.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps._parameters import check_at_least
from igps.mesh._isosurface import level_surface, simplified
from igps.mesh._level_set import Grid, cell_sizes, distances, joined, level_set, rounded
from igps.mesh._outside import OrientedSurface, outside_of
from igps.mesh.mesh import Mesh, MeshError, check_places
from igps.mesh.surface import diagonal, face_areas, largest, longest_side, unit

# Groups of triangles of less than this share of the area are specks, if they are apart in a grid of so many cells.
_SPECK_AREA, _SPECK_CELLS = 2e-3, 64
# Volume over area in cells, half a rod's radius. Cells are made so small that long thin bodies have the first, unless
# that makes too many; bodies with less than the second get a note that they are coarse.
_THICK, _COARSE = 1.5, 0.75
# Faces beyond which vertices are first rounded to a quarter of a cell, so that time and memory stay bounded.
_MANY_FACES = 400_000
# Points of a cloud beyond which they are thinned out first.
_MANY_POINTS = 200_000
# Points that are so much less spread across than along are on a line, whatever single precision did to them.
_LINE = 1e-5


def watertight(
    vertices: Floats, faces: Integers | None = None, *, normals: Floats | None = None, resolution: int = 96,
    max_vertices: int | None = 5000, name: str = "mesh",
) -> Mesh:  # fmt: skip
    """The closed, oriented, edge-manifold surface of one body from triangles in any state, or from points.

    Solids keep their surface, sheets get about a cell, small openings are closed, and what cannot be seen from outside
    is filled.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices in any order and orientation, or None for a cloud of points.
        normals: (V, 3) of a cloud, of any length and either sign; estimated from the neighbours if None.
        resolution: the grid has about as many cells as a cube of this side. Flat and long bodies get up to twice as
            many along their longest side, and closed ones that are thin more, as long as there are no more in all.
        max_vertices: the surface is simplified to so many; None keeps all.
        name: what error messages call the surface.

    Raises:
        MeshError: there is no surface (fewer than ten points, no triangle with an area).
    """
    check_at_least(8, resolution=resolution)
    vertices = np.asarray(vertices, dtype=np.float64)
    check_places(vertices, name)
    notes: list[str] = []
    spacing = 0.0
    if faces is None or len(faces) == 0:
        vertices, faces, spacing = splats(vertices, normals, resolution, name)
        notes.append("points joined by small discs")
    faces = np.asarray(faces, dtype=np.int64)
    faces = faces[face_areas(vertices, faces) > 1e-14 * diagonal(vertices[faces].reshape(-1, 3)) ** 2]
    if not len(faces):
        flat = f"{name}: no triangle has an area; a surface was expected."
        raise MeshError(f"{flat} If the file holds lines, give them thickness.")
    faces = _without_specks(vertices, faces, notes)
    usual, least = cell_sizes(vertices, faces, resolution, spacing)
    grid = Grid.around(vertices, faces, least)
    vertices = grid.to_cells(vertices)
    if len(faces) > _MANY_FACES:
        vertices, faces = rounded(vertices, faces)
    surface = OrientedSurface.of(vertices, faces)
    thickness = surface.thickness * least if surface.is_nearly_closed else np.inf
    cell = float(np.clip(thickness / _THICK, least, usual))
    if thickness < _COARSE * cell:
        notes.append(f"coarse: about {4 * thickness / cell:.1f} cells thick")
    if cell > least:
        finest, grid = grid, Grid.around(grid.from_cells(vertices), faces, cell)
        vertices, of_surface = (grid.to_cells(finest.from_cells(places)) for places in (vertices, surface.vertices))
        surface = replace(surface, vertices=of_surface)
    distance, nearest = distances(vertices, faces, grid.shape)
    outside, closed = outside_of(distance, surface)
    if closed:
        notes.append(f"closed {closed} openings")
    field = joined(level_set(distance, nearest, outside, surface), notes)
    vertices, faces = largest(*level_surface(field, name))
    notes.append(f"made watertight on a grid of {' x '.join(str(n) for n in grid.shape)} cells")
    if max_vertices is not None:
        vertices, faces = simplified(vertices, faces, max_vertices)
    return Mesh(grid.from_cells(vertices), faces, name=name, notes=tuple(notes))


def crosses_itself(vertices: Floats, faces: Integers) -> bool:
    """Whether any two faces have points in common beyond their common vertices and edge, by exact predicates."""
    from igl.predicates import find_self_intersections

    surface = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
    return bool(find_self_intersections(*surface, first_only=True)[0])


def _without_specks(vertices: Floats, faces: Integers, notes: list[str]) -> Integers:
    """The faces without groups that lie apart from everything else and have next to no area."""
    corners = vertices[faces]
    low, side = corners.min(axis=(0, 1)), longest_side(corners.reshape(-1, 3))
    cell = side / _SPECK_CELLS
    points, face = _spread(corners, cell)
    index = np.floor((points - low) / cell).astype(np.int64) + 1
    occupied = np.zeros(index.max(axis=0) + 2, dtype=bool)
    occupied[tuple(index.T)] = True
    label, count = ndimage.label(occupied, structure=np.ones((3, 3, 3)))
    group = np.zeros(len(faces), dtype=np.int64)
    group[face] = label[tuple(index.T)]
    area = face_areas(vertices, faces)
    share = np.bincount(group, weights=area, minlength=count + 1) / area.sum()
    keep = (share >= _SPECK_AREA)[group]
    # Where everything is in pieces that small, none is a speck.
    if keep.all() or area[keep].sum() < 0.98 * area.sum():
        return faces
    notes.append(f"dropped {len(np.unique(group[~keep]))} specks")
    return _without_specks(vertices, faces[keep], notes)


def _spread(corners: Floats, spacing: float) -> tuple[Floats, Integers]:
    """Points on triangles, at most about `spacing` apart, and the triangle of each."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    n = np.clip(np.ceil(edges / spacing), 1, 4 * _SPECK_CELLS).astype(np.int64)
    points, owner = [], []
    for k in np.unique(n):
        i, j = np.nonzero(np.add.outer(np.arange(k + 1), np.arange(k + 1)) <= k)
        weights = np.stack([i, j, k - i - j], axis=1) / k
        of_n = np.nonzero(n == k)[0]
        points.append(np.einsum("pi,fij->fpj", weights, corners[of_n]).reshape(-1, 3))
        owner.append(np.repeat(of_n, len(weights)))
    return np.concatenate(points), np.concatenate(owner)


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
    u = unit(np.cross(normals, axis))
    v = unit(np.cross(normals, u))
    angle = np.arange(6)[:, None] * np.pi / 3
    rim = points[:, None] + radius[:, None, None] * (np.cos(angle) * u[:, None] + np.sin(angle) * v[:, None])
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    faces = (6 * np.arange(len(points))[:, None, None] + fan).reshape(-1, 3)
    return rim.reshape(-1, 3), faces, spacing / 2

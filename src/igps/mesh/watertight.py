"""Make the closed surface of one body from any triangles or points: distances, a flood, marching cubes.

The body is what a flood from outside does not reach; `_outside` decides which openings the flood passes. The grid
points have exact distances to the triangles, negative inside the body, so the surface of a solid stays in place. Only
sheets and wires, which enclose nothing, get a thickness of about a cell. Marching cubes extract the surface (Lewiner et
al. 2003), and quadrics simplify it (Garland and Heckbert 1997).

**Several pieces** become one body: pieces of less than 1/500 of the volume are dropped, and the others are joined by
straight bars of about a cell's radius where the gaps are narrowest (a minimum spanning tree of the gaps). Retrieval
with joined pieces is nearly as good as with the whole body. With the spectra of all pieces side by side, or with the
largest piece alone, it is far worse.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers, Surface
from igps._parameters import check_at_least
from igps._text import counted
from igps.mesh._level_set import (
    Grid,
    cell_sizes,
    distances,
    join_pieces,
    level_set,
)
from igps.mesh._outside import OrientedSurface, find_outside
from igps.mesh._tidying import are_specks, places
from igps.mesh.errors import MeshError
from igps.mesh.isosurface import level_surface, simplify_surface
from igps.mesh.mesh import Mesh, check_coordinates
from igps.mesh.surface import diagonal, face_areas, face_parts, largest, longest_side, unit

# Thickness (volume over area, half a rod's radius) in cells: the grid is refined up to the first as far as its size
# allows, and bodies below the second get a note that they are coarse.
_FINE = 1.5
_COARSE = 0.75
_MAX_POINTS = 200_000  # larger clouds are thinned out first
_LINE = 1e-5  # points on a line in single precision have a smaller ratio of spread across to spread along


def watertight(
    vertices: Floats,
    faces: Integers | None = None,
    *,
    normals: Floats | None = None,
    resolution: int = 96,
    max_vertices: int | None = 5000,
    name: str = "mesh",
) -> Mesh:
    """Make the closed, oriented, edge-manifold surface of one body from triangles in any state, or from points.

    Solids keep their surface, sheets get about a cell of thickness, small openings are closed, and everything that is
    not visible from outside is filled.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices in any order and orientation, or None for a point cloud.
        normals: (V, 3) normals of a point cloud, of any length and either sign; estimated from the neighbours if None.
        resolution: the grid has about as many cells as a cube of this side. Flat and long bodies get up to
            2 * `resolution` cells along their longest side; thin closed bodies get more, with no more cells in all.
        max_vertices: approximate maximal number of vertices after simplification; None keeps all.
        name: name of the surface in error messages.

    Raises:
        MeshError: there is no surface (fewer than ten points, or no triangle with an area).
    """
    check_at_least(8, resolution=resolution)
    vertices = np.asarray(vertices, dtype=np.float64)
    check_coordinates(vertices, name)
    notes: list[str] = []
    spacing = 0.0
    if faces is None or len(faces) == 0:
        vertices, faces, spacing = splats(vertices, normals, resolution, name)
        notes.append("points joined by small discs")
    faces = np.asarray(faces, dtype=np.int64)
    size = diagonal(vertices[faces].reshape(-1, 3))
    faces = faces[face_areas(vertices, faces) > 1e-14 * size**2]
    if not len(faces):
        raise MeshError(
            f"{name}: expected a surface, but no triangle has an area. Give lines some thickness."
        )
    welded = places(vertices)[faces]
    part, areas = face_parts(vertices, welded)
    is_speck = are_specks(areas)
    if is_speck.any():
        notes.append(f"dropped {counted(int(is_speck.sum()), 'speck')}")
        faces = faces[~is_speck[part]]
    default_size, min_size = cell_sizes(vertices, faces, resolution, spacing)
    grid = Grid.around(vertices, faces, min_size)
    vertices = grid.to_cells(vertices)
    surface = OrientedSurface.of(vertices, faces)
    thickness = math.inf
    if surface.is_nearly_closed:
        thickness = surface.thickness * min_size
    cell = float(np.clip(thickness / _FINE, min_size, default_size))
    if thickness < _COARSE * cell:
        notes.append(f"coarse: about {4 * thickness / cell:.1f} cells thick")
    if cell > min_size:
        finest = grid
        grid = Grid.around(grid.from_cells(vertices), faces, cell)
        vertices = grid.to_cells(finest.from_cells(vertices))
        oriented = grid.to_cells(finest.from_cells(surface.vertices))
        surface = replace(surface, vertices=oriented)
    distance, nearest = distances(vertices, faces, grid.shape)
    outside, n_closed = find_outside(distance, surface)
    if n_closed:
        notes.append(f"closed {counted(n_closed, 'opening')}")
    field = level_set(distance, nearest, outside, surface)
    field = join_pieces(field, notes)
    vertices, faces = largest(*level_surface(field, name))
    sides = " x ".join(str(n) for n in grid.shape)
    notes.append(f"made watertight on a grid of {sides} cells")
    if max_vertices is not None:
        vertices, faces = simplify_surface(vertices, faces, max_vertices)
    vertices = grid.from_cells(vertices)
    return Mesh(vertices, faces, name=name, notes=tuple(notes))


def crosses_itself(vertices: Floats, faces: Integers) -> bool:
    """Return whether any two faces intersect outside their common vertices and edges, by exact predicates."""
    from igl.predicates import find_self_intersections

    vertices = np.ascontiguousarray(vertices)
    faces = np.ascontiguousarray(faces)
    crossings, *_ = find_self_intersections(vertices, faces, first_only=True)
    return bool(crossings)


def splats(
    points: Floats, normals: Floats | None, resolution: int, name: str
) -> tuple[Floats, Integers, float]:
    """Return the vertices and faces of hexagonal discs around the points of a cloud, and the spacing of the points."""
    if len(points) < 10:
        raise MeshError(
            f"{name}: expected at least 10 points for a surface, got {len(points)}. Export or scan more."
        )
    side = longest_side(points)
    if side == 0:
        raise MeshError(f"{name}: expected a surface, but all points coincide. Check the file.")
    centred = points - points.mean(axis=0)
    _, across, along = np.linalg.eigvalsh(centred.T @ centred)
    if across < _LINE**2 * along:
        raise MeshError(
            f"{name}: expected a surface, but all {len(points)} points lie on one line. Check the file."
        )
    if len(points) > _MAX_POINTS:
        # Keep one point in each quarter of a cell.
        quarter = side / (4 * resolution)
        lattice = np.floor((points - points.min(axis=0)) / quarter).astype(np.int64)
        _, first = np.unique(lattice, axis=0, return_index=True)
        points = points[first]
        normals = None if normals is None else normals[first]
    n_neighbours = min(13, len(points))
    distance, neighbours = cKDTree(points).query(points, k=n_neighbours)
    # In an even cloud, a disc reaches about the third ring of neighbours; its radius is bounded where points are rare.
    reach = distance[:, min(6, distance.shape[1] - 1)]
    spacing = float(np.median(reach))
    radius = np.clip(reach, spacing / 2, 2 * spacing)
    if normals is None:
        around = points[neighbours]
        local = around - around.mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", local, local))
        normals = axes[:, :, 0]
    normals = np.asarray(normals, dtype=np.float64)
    if normals.shape != points.shape or not np.isfinite(normals).all():
        raise MeshError(
            f"{name}: normals: expected finite numbers of shape {points.shape}. Leave out the normals."
        )
    vertices, faces = _discs(points, normals, radius)
    return vertices, faces, spacing / 2


def _discs(points: Floats, normals: Floats, radius: Floats) -> Surface:
    """Return hexagonal discs of these radii (P,) around points (P, 3), across the normals (P, 3)."""
    # Two directions in the plane, computed from the axis that is least parallel to the normal.
    smallest = np.argmin(np.abs(normals), axis=1)
    axis = np.eye(3)[smallest]
    u = unit(np.cross(normals, axis))
    v = unit(np.cross(normals, u))
    vertices = np.empty((len(points), 6, 3))
    for corner in range(6):
        angle = corner * np.pi / 3
        arm = np.cos(angle) * u + np.sin(angle) * v
        vertices[:, corner] = points + radius[:, None] * arm
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    first = 6 * np.arange(len(points))
    faces = first[:, None, None] + fan
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)

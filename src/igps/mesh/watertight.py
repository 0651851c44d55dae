"""Make the closed surface of one body from any triangles: distances, a flood, marching cubes.

The body is what a flood from outside does not reach; `_outside` decides which openings the flood passes. The grid
points have exact distances to the triangles, negative inside the body, so the surface of a solid stays in place. Only
sheets and wires, which enclose nothing, get a thickness of about a cell. Marching cubes extract the surface (Lewiner et
al. 2003), and quadrics simplify it (Garland and Heckbert 1997).

**Several pieces** become one body: pieces of less than 1/500 of the volume are dropped, and the others are joined by
straight bars of about a cell's radius where the gaps are narrowest (a minimum spanning tree of the gaps). Retrieval
with joined pieces is nearly as good as with the whole body. With the spectra of all pieces side by side, or with the
largest piece alone, it is far worse.
"""

from dataclasses import replace

import numpy as np

from igps._arrays import Floats, Integers
from igps._parameters import check_at_least
from igps._text import counted
from igps.mesh._level_set import (
    Grid,
    cell_sizes,
    distances,
    join_pieces,
    level_set,
    merge_near_vertices,
)
from igps.mesh._outside import OrientedSurface, find_outside
from igps.mesh._tidying import are_specks, places
from igps.mesh.errors import MeshError
from igps.mesh.isosurface import level_surface, simplify_surface
from igps.mesh.mesh import Mesh, check_coordinates
from igps.mesh.surface import diagonal, face_areas, face_parts, largest

# Thickness (volume over area, half a rod's radius) in cells: the grid is refined up to the first as far as its size
# allows, and bodies below the second get a note that they are coarse.
_FINE = 1.5
_COARSE = 0.75
_MAX_FACES = 400_000  # in larger meshes, vertices are first merged within quarters of a cell, to bound time and memory


def watertight(
    vertices: Floats,
    faces: Integers,
    *,
    resolution: int = 96,
    max_vertices: int | None = 5000,
    name: str = "mesh",
) -> Mesh:
    """Make the closed, oriented, edge-manifold surface of one body from triangles in any state.

    Solids keep their surface, sheets get about a cell of thickness, small openings are closed, and everything that is
    not visible from outside is filled.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices in any order and orientation.
        resolution: the grid has about as many cells as a cube of this side. Flat and long bodies get up to
            2 * `resolution` cells along their longest side; thin closed bodies get more, with no more cells in all.
        max_vertices: approximate maximal number of vertices after simplification; None keeps all.
        name: name of the surface in error messages.

    Raises:
        MeshError: there is no surface: no triangle with an area.
    """
    check_at_least(8, resolution=resolution)
    vertices = np.asarray(vertices, dtype=np.float64)
    check_coordinates(vertices, name)
    notes: list[str] = []
    faces = np.asarray(faces, dtype=np.int64)
    size = diagonal(vertices[faces].reshape(-1, 3))
    faces = faces[face_areas(vertices, faces) > 1e-14 * size**2]
    if not len(faces):
        raise MeshError(
            f"{name}: expected a surface, but no triangle has an area. Give lines some thickness."
        )
    part, areas = face_parts(vertices, places(vertices)[faces])
    is_speck = are_specks(areas)
    if is_speck.any():
        notes.append(f"dropped {counted(int(is_speck.sum()), 'speck')}")
        faces = faces[~is_speck[part]]
    default_size, min_size = cell_sizes(vertices, faces, resolution)
    grid = Grid.around(vertices, faces, min_size)
    vertices = grid.to_cells(vertices)
    if len(faces) > _MAX_FACES:
        vertices, faces = merge_near_vertices(vertices, faces)
    surface = OrientedSurface.of(vertices, faces)
    thickness = surface.thickness * min_size if surface.is_nearly_closed else np.inf
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
    field = join_pieces(level_set(distance, nearest, outside, surface), notes)
    vertices, faces = largest(*level_surface(field, name))
    sides = " x ".join(str(n) for n in grid.shape)
    notes.append(f"made watertight on a grid of {sides} cells")
    if max_vertices is not None:
        vertices, faces = simplify_surface(vertices, faces, max_vertices)
    return Mesh(grid.from_cells(vertices), faces, name=name, notes=tuple(notes))


def crosses_itself(vertices: Floats, faces: Integers) -> bool:
    """Return whether any two faces intersect outside their common vertices and edges, by exact predicates."""
    from igl.predicates import find_self_intersections

    surface = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
    return bool(find_self_intersections(*surface, first_only=True)[0])

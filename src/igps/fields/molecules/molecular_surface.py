"""Compute the surface of a molecule: of its balls, or of the space that a rolling probe cannot enter.

The solvent-excluded surface (Lee and Richards 1971; Connolly 1983) lies at the probe's radius from the region where the
centre of a probe can be. That region is bounded by spheres, by the arcs in which two spheres intersect, and by the ends
of arcs, so the distance to it is exact at every grid point. The mesh is its level set at the probe's radius.
"""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers, Singles, Surface
from igps._parameters import check_one_of, check_positive
from igps._text import counted
from igps._threads import one_thread
from igps.fields.molecules._molecular_loops import (
    Balls,
    cubic_values,
    depths,
    distances_outside,
    exposed_arcs,
    exposed_areas,
    means_at_vertices,
)
from igps.fields.molecules.molecule import Molecule
from igps.mesh._level_set import MIN_ABS_VALUE, SPECK_VOLUME, fill_bubbles
from igps.mesh.errors import MeshError
from igps.mesh.isosurface import level_surface, simplify_surface
from igps.mesh.mesh import Mesh
from igps.mesh.surface import (
    connected,
    dots,
    face_areas,
    lengths,
    signed_volume,
    stacked,
    vertex_normals,
)

SurfaceKind = Literal["excluded", "accessible", "van_der_waals"]

# Cells around the balls, and on both sides of the surface, in which distances are computed
_MARGIN = 2.5
_MAX_CELLS = 2**28
# Distances between grid points, Å: up to so many balls, and at most
_FINE = 0.8
_N_FINE = 1000
_COARSE = 1.0
_MAX_STEP = 0.3  # maximal step of vertices towards the surface, in cells
_MAX_THREADS = 0.003  # maximal share of the area that threads between pieces add
_MAX_THREAD_WIDTH = 0.5  # maximal width of a thread's end over its triangle's
_MAX_SPECKS = 0.05  # specks are dropped if they have at most this share of the volume together
_N_DIRECTIONS = 256  # points of each sphere that tell how much of it is exposed
_N_ROUNDS = 2  # rounds in which vertices are spread evenly along the surface


@one_thread()
def molecular_surface(
    molecule: Molecule,
    kind: SurfaceKind = "excluded",
    *,
    probe: float = 1.4,
    spacing: float | None = None,
    max_vertices: int | None = 3000,
) -> Mesh:
    """Compute the closed surface of a molecule, in ångström.

    Hollows inside are filled, specks are dropped, and the remaining pieces are joined by threads where the gaps are
    narrowest. Balls that meet in a cusp are separate pieces, and so are parts joined by a neck of a radius below about
    half the spacing.

    The area is not that of the triangles (`Mesh.fine_area`). Of an excluded surface it is the area before simplifying.
    The others have creases that triangles cut off, so it is summed over points of the spheres (Shrake and Rupley 1973),
    with the walls of hollows, as is usual. The volume is that of the triangles, which simplifying keeps. At a spacing
    of 0.5 Å the area and the volume of the excluded surface are within 1 % of closed forms.

    Example:
        >>> at, none = np.zeros((1, 3)), np.zeros(1)
        >>> ball = Molecule("ball", at, np.array([2.0]), none, np.zeros(1, dtype=np.int64), ("X",), at, none)
        >>> round(molecular_surface(ball, spacing=0.5).volume / (4 / 3 * np.pi * 2**3), 2)
        1.0

    Args:
        kind: "excluded": the space that no probe enters. "accessible": the space that no centre of a probe enters.
            "van_der_waals": the balls themselves.
        probe: radius of the probe, Å; 1.4 for water.
        spacing: distance between grid points, Å; None for 0.8 up to 1000 balls, growing to 1.0 from 1560 on, as
            large molecules keep fewer vertices than the grid gives.
        max_vertices: larger surfaces are simplified to this number of vertices; None keeps all.

    Raises:
        ValueError: a parameter is out of range.
        MeshError: the balls lie too far apart for a grid, or have no closed surface.
    """
    check_one_of(get_args(SurfaceKind), kind=kind)
    if spacing is not None:
        check_positive(spacing=spacing)
    if not 0 <= probe < math.inf:
        raise ValueError(f"probe: expected a radius of at least 0 Å, got {probe}.")
    reach = 0.0 if kind == "van_der_waals" else probe
    centres, radii = _outermost(molecule.positions, molecule.radii + reach)
    if spacing is None:
        spacing = float(np.clip(_FINE * math.sqrt(len(radii) / _N_FINE), _FINE, _COARSE))
    margin = _MARGIN * spacing
    low = (centres - radii[:, None]).min(axis=0) - margin
    high = (centres + radii[:, None]).max(axis=0) + margin
    sides = np.ceil((high - low) / spacing) + 1
    n_cells = sides.prod()
    if n_cells > _MAX_CELLS:
        limit = f"{molecule.name}: expected a grid of at most {_MAX_CELLS:.3g} cells of {spacing} Å"
        raise MeshError(f"{limit}, got {n_cells:.3g}. Raise the spacing, or remove stray atoms.")
    nx, ny, nz = (int(side) for side in sides)
    rolling = probe if kind == "excluded" else 0.0
    exact = _field(centres - low, radii, (nx, ny, nz), spacing, rolling)
    notes = [f"{kind.replace('_', ' ')} surface, probe {probe:g} Å, grid of {spacing:g} Å"]
    away_from_zero = np.where(exact < 0, -MIN_ABS_VALUE, MIN_ABS_VALUE)
    bounded = np.where(np.abs(exact) < MIN_ABS_VALUE, away_from_zero, exact).astype(np.float32)
    field = bounded.copy()
    _, n_outside = ndimage.label(field > 0)
    if n_outside > 1:
        field = fill_bubbles(field)
        notes.append(f"{counted(n_outside - 1, 'hollow')} inside: filled")
    vertices, faces = level_surface(field.copy(), molecule.name)
    vertices = _fit_to_field(np.where(field == bounded, exact, field), vertices, faces)
    if kind == "excluded":
        fine_area = float(face_areas(vertices, faces).sum()) * spacing**2
    else:
        fine_area = _exposed_area(centres, radii)
    vertices, faces = _one_piece(vertices, faces, max_vertices, notes)
    return Mesh(
        vertices * spacing + low,
        faces,
        name=molecule.name,
        notes=(*molecule.notes, *notes),
        unit="Å",
        fine_area=fine_area,
    )


def _outermost(centres: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """Return the balls of positive radius that lie in no other ball, largest first; of equal balls, the first one."""
    order = np.argsort(-radii, kind="stable")
    order = order[radii[order] > 0]
    centres = centres[order]
    radii = radii[order]
    reach = radii[0] - radii[-1] + 1e-6
    pairs = cKDTree(centres).query_pairs(reach, output_type="ndarray")
    large, small = np.sort(pairs, axis=1).T
    distance = lengths(centres[large] - centres[small])
    is_inside = distance + radii[small] <= radii[large] + 1e-9
    is_outermost = np.ones(len(radii), dtype=bool)
    is_outermost[small[is_inside]] = False
    return centres[is_outermost], radii[is_outermost]


def _field(
    centres: Floats, radii: Floats, shape: tuple[int, int, int], spacing: float, probe: float
) -> Singles:
    """Return the signed distances of the grid points to the surface (of the balls, for a probe of 0), in cells."""
    margin = _MARGIN * spacing
    depth, owner = depths(centres, radii, shape, spacing, margin)
    if probe > 0:
        balls = Balls(centres, radii, *_neighbours(centres, radii))
        arcs, exposed = exposed_arcs(balls)
        reach = probe + margin
        depth = distances_outside(depth, owner, balls, exposed, arcs, spacing, reach)
    return ((np.float32(probe) - depth) / np.float32(spacing)).astype(np.float32)


def _exposed_area(centres: Floats, radii: Floats) -> float:
    """Return the area, Å², of the spheres outside all balls, see `exposed_areas`."""
    number = np.arange(_N_DIRECTIONS) + 0.5
    height = 1 - 2 * number / _N_DIRECTIONS
    angle = math.pi * (1 + math.sqrt(5)) * number
    across = np.sqrt(1 - height**2)
    directions = np.column_stack([across * np.cos(angle), across * np.sin(angle), height])
    balls = Balls(centres, radii, *_neighbours(centres, radii))
    return float(exposed_areas(balls, directions).sum())


def _neighbours(centres: Floats, radii: Floats) -> tuple[Integers, Integers]:
    """Return the neighbours of ball i, which intersect it, as `neighbours[first[i]:first[i + 1]]`, nearest first."""
    one, other = cKDTree(centres).query_pairs(2 * radii.max(), output_type="ndarray").T
    distance = lengths(centres[one] - centres[other])
    meets = distance < radii[one] + radii[other]
    ball = np.concatenate([one[meets], other[meets]])
    neighbour = np.concatenate([other[meets], one[meets]])
    both = np.tile(distance[meets], 2)
    order = np.lexsort((both, ball))
    n_neighbours = np.bincount(ball, minlength=len(radii))
    first = np.concatenate([[0], np.cumsum(n_neighbours)])
    return first, neighbour[order].astype(np.int64)


def _one_piece(
    vertices: Floats, faces: Integers, max_vertices: int | None, notes: list[str]
) -> Surface:
    """Drop specks, simplify, and join the pieces."""
    parts = connected(vertices, faces)
    volumes = np.array([abs(signed_volume(*part)) for part in parts])
    is_speck = volumes < SPECK_VOLUME * volumes.sum()
    if volumes[is_speck].sum() > _MAX_SPECKS * volumes.sum():
        is_speck[:] = False  # as of a membrane, which consists of small molecules
    elif is_speck.any():
        notes.append(f"left out {counted(int(is_speck.sum()), 'speck')}")
    kept = [parts[i] for i in np.flatnonzero(~is_speck)]
    return simplified_and_joined(kept, max_vertices, notes)


def simplified_and_joined(
    parts: Sequence[Surface], max_vertices: int | None, notes: list[str]
) -> Surface:
    """Simplify each closed piece to its share of the vertices, and join them by threads to one surface."""
    simple = []
    n_all = sum(len(vertices) for vertices, _ in parts)
    for vertices, faces in parts:
        if max_vertices is not None:
            n_own = round(max_vertices * len(vertices) / n_all)
            vertices, faces = simplify_surface(vertices, faces, max(n_own, 12))
        simple.append((vertices, faces))
    if len(simple) > 1:
        notes.append(f"joined {len(simple)} pieces by threads")
    return _join(simple)


def _fit_to_field(field: Singles, vertices: Floats, faces: Integers) -> Floats:
    """Move the vertices to the zero level of the field, spread evenly, and correct for the chords of the triangles.

    Triangles with their corners on a curved surface lie on one side of it. The distance of their centres from the
    surface tells how far to move the corners: the mean error of linear interpolation is 3/4 of that at the centre.
    """
    steps, normals = _steps(field, vertices)
    vertices = vertices - steps
    for _ in range(_N_ROUNDS):
        centres = vertices[faces].mean(axis=1)
        shift = means_at_vertices(centres, vertices, faces) - vertices
        across = dots(shift, normals)
        vertices = vertices + shift - across[:, None] * normals
        steps, normals = _steps(field, vertices)
        vertices = vertices - steps
    centres = vertices[faces].mean(axis=1)
    steps, normals = _steps(field, centres)
    heights = dots(steps, normals)[:, None]
    # Average at the vertices and back, so that neighbours move alike.
    heights = means_at_vertices(heights, vertices, faces)[faces].mean(axis=1)
    heights = means_at_vertices(heights, vertices, faces)
    return vertices - 0.75 * heights * vertex_normals(vertices, faces)


def _steps(field: Singles, points: Floats) -> tuple[Floats, Floats]:
    """Return the vectors (P, 3) from the surface to the points, in cells, and the outward normals (P, 3) there."""
    values = cubic_values(field, points)
    gradients = values[:, 1:]
    # The gradient of a distance has length 1. Where it is much shorter, as midway between two surfaces, it is useless.
    slope = np.maximum(lengths(gradients), 0.5)
    normals = gradients / slope[:, None]
    heights = np.clip(values[:, 0] / slope, -_MAX_STEP, _MAX_STEP)
    return heights[:, None] * normals, normals


def _join(parts: Sequence[Surface]) -> Surface:
    """Join closed, outward oriented parts, none inside another, by threads to one closed surface."""
    vertices, faces = stacked(parts)
    links = _shortest_links([points for points, _ in parts])
    length = sum(float(np.linalg.norm(vertices[a] - vertices[b])) for a, b in links)
    area = float(face_areas(vertices, faces).sum())
    girth = _MAX_THREADS * area / max(length, 1e-300)
    for a, b in links:
        vertices, faces = _add_thread(vertices, faces, a, b, girth)
    return vertices, faces


def _shortest_links(parts: Sequence[Floats]) -> list[tuple[int, int]]:
    """Return the minimum spanning tree of the parts (Prim) as pairs of vertices, numbered through all parts."""
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    links = []
    # Of each part that is not yet in the tree: its distance, and the shortest link to it
    distances = dict.fromkeys(range(1, len(parts)), math.inf)
    best: dict[int, tuple[int, int]] = {}
    new = 0
    while distances:
        tree = cKDTree(parts[new])
        for other in distances:
            distance, vertex = tree.query(parts[other])
            nearest = int(distance.argmin())
            if distance[nearest] < distances[other]:
                distances[other] = float(distance[nearest])
                best[other] = (starts[new] + int(vertex[nearest]), starts[other] + nearest)
        new = min(distances, key=distances.__getitem__)
        links.append(best[new])
        del distances[new]
    return links


def _add_thread(vertices: Floats, faces: Integers, a: int, b: int, girth: float) -> Surface:
    """Add a thread, a tube of triangular section, between the largest triangles at two vertices."""
    areas = face_areas(vertices, faces)
    ends = []
    rims = []
    new = []
    for vertex in (a, b):
        around = np.flatnonzero((faces == vertex).any(axis=1))
        end = int(around[areas[around].argmax()])
        corners = vertices[faces[end]]
        centre = corners.mean(axis=0)
        sides = corners - np.roll(corners, 1, axis=0)
        perimeter = lengths(sides).sum()
        width = min(girth / perimeter, _MAX_THREAD_WIDTH)
        rim = len(vertices) + np.arange(3)
        vertices = np.concatenate([vertices, centre + width * (corners - centre)])
        new += _band(faces[end], rim)
        ends.append(end)
        rims.append(rim)
    one, other = rims

    def length(rim: Integers) -> float:
        return float(lengths(vertices[one] - vertices[rim]).sum())

    # The rims face each other, so they run in opposite directions.
    rotations = [np.roll(other[::-1], k) for k in range(3)]
    new += _band(one, min(rotations, key=length))
    kept = np.delete(faces, ends, axis=0)
    return vertices, np.concatenate([kept, np.array(new, dtype=np.int64)])


def _band(one: Integers, other: Integers) -> list[tuple[int, int, int]]:
    """Return the six triangles between two triangles of vertices that run in the same direction."""
    band = []
    for i, k in ((0, 1), (1, 2), (2, 0)):
        band += [(one[i], one[k], other[k]), (one[i], other[k], other[i])]
    return band

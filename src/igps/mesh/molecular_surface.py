"""The surface of a molecule: of its balls, or of what a rolling probe leaves of the space around them.

The excluded surface (Lee and Richards 1971; Connolly 1983) lies at the probe's radius from all places where the centre
of a probe may be. These are bounded by spheres, by the arcs in which two of them meet, and by the ends of arcs, so that
the distance to them is known exactly at every point of a grid. The triangles are where it equals the radius.
"""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers, Singles, Surface
from igps._parameters import check_one_of, check_positive
from igps._threads import one_thread
from igps.mesh._isosurface import level_surface, simplified
from igps.mesh._level_set import LEAST, SPECK_VOLUME, without_bubbles
from igps.mesh._molecular_loops import cubic_values, depths, distances_outside, exposed_arcs
from igps.mesh.formats.molecules import Molecule
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import connected, face_areas, signed_volume, stacked, sums, vertex_normals

SurfaceKind = Literal["excluded", "accessible", "van_der_waals"]

# Cells around the balls, and on both sides of the surface, in which distances are computed.
_MARGIN = 2.5
_MOST_CELLS = 2**28
# A step of vertices towards the surface is shorter, in cells.
_STEP = 0.3
# Share of the area that threads between pieces may add, and of a triangle's sides the most that one takes.
_THREADS, _MOST_TAKEN = 0.003, 0.5
# Share of the volume that specks have at most.
_MOST_SPECKS = 0.05
# Rounds in which vertices are moved apart along the surface.
_N_ROUNDS = 2


@one_thread()
def molecular_surface(
    molecule: Molecule, kind: SurfaceKind = "excluded", *, probe: float = 1.4, spacing: float = 0.8,
    max_vertices: int | None = 3000,
) -> Mesh:  # fmt: skip
    """The closed surface of a molecule, in ångström; hollows inside that it does not open to are filled.

    Pieces are joined by threads where the gaps are narrowest, and specks left out.

    At a spacing of 0.5 the area and volume of the excluded surface are within 1 % of closed forms, before vertices are
    taken away; afterwards the volume still is. Threads between pieces, such as two balls that each end in a cusp, add
    0.3 % of the area at most; a neck of radius less than about half the spacing is a thread, too.

    Example:
        >>> at, none = np.zeros((1, 3)), np.zeros(1)
        >>> ball = Molecule("ball", at, np.array([2.0]), none, np.zeros(1, dtype=np.int64), ("X",), at, none)
        >>> round(molecular_surface(ball, spacing=0.5).volume / (4 / 3 * np.pi * 2**3), 2)
        1.0

    Args:
        kind: "excluded": what no probe enters; "accessible": where no centre of a probe can be; "van_der_waals": the
            balls themselves.
        probe: radius, Å; that of water is 1.4.
        spacing: of the grid, Å.
        max_vertices: larger surfaces are simplified to so many; None keeps all.

    Raises:
        ValueError: a parameter out of range.
        MeshError: the balls lie too far apart for a grid, or give no closed surface.
    """
    check_one_of(get_args(SurfaceKind), kind=kind)
    check_positive(spacing=spacing)
    if not 0 <= probe < math.inf:
        raise ValueError(f"probe: expected a radius of at least 0 Å, got {probe}.")
    centres, radii = _outermost(molecule.positions, molecule.radii + (0.0 if kind == "van_der_waals" else probe))
    margin = _MARGIN * spacing
    low = (centres - radii[:, None]).min(axis=0) - margin
    sides = np.ceil(((centres + radii[:, None]).max(axis=0) + margin - low) / spacing) + 1
    if sides.prod() > _MOST_CELLS:
        needed = f"{molecule.name}: a grid of {sides.prod():.3g} cells of {spacing} Å would be needed, at most"
        raise MeshError(f"{needed} {_MOST_CELLS:.3g} are made. Raise the spacing, or remove stray atoms.")
    shape = (int(sides[0]), int(sides[1]), int(sides[2]))
    exact = _field(centres - low, radii, shape, spacing, probe if kind == "excluded" else 0.0)
    notes = [f"{kind.replace('_', ' ')} surface, probe {probe:g} Å, grid of {spacing:g} Å"]
    clear = np.where(np.abs(exact) < LEAST, np.where(exact < 0, -LEAST, LEAST), exact).astype(np.float32)
    field = clear.copy()
    if n_hollows := ndimage.label(field > 0)[1] - 1:
        field = without_bubbles(field)
        notes.append(f"{n_hollows} hollows inside were filled")
    vertices, faces = level_surface(field.copy(), molecule.name)
    vertices = _settled(np.where(field == clear, exact, field), vertices, faces)
    vertices, faces = _one_piece(vertices, faces, max_vertices, notes)
    return Mesh(vertices * spacing + low, faces, name=molecule.name, notes=(*molecule.notes, *notes), unit="Å")


def _outermost(centres: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """The balls that lie in no other, largest first; of equal ones the first. What has no radius is left out."""
    order = np.argsort(-radii, kind="stable")
    order = order[radii[order] > 0]
    centres, radii = centres[order], radii[order]
    pairs = cKDTree(centres).query_pairs(radii[0] - radii[-1] + 1e-6, output_type="ndarray")
    small = pairs.max(axis=1)
    apart = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    inside = apart + radii[small] <= radii[pairs.min(axis=1)] + 1e-9
    kept = np.ones(len(radii), dtype=bool)
    kept[small[inside]] = False
    return centres[kept], radii[kept]


def _field(centres: Floats, radii: Floats, shape: tuple[int, int, int], spacing: float, probe: float) -> Singles:
    """How far each grid point is from the surface, in cells, negative inside; with `probe` of 0 that of the balls."""
    margin = _MARGIN * spacing
    depth, owner = depths(centres, radii, shape, spacing, margin)
    if probe > 0:
        first, neighbours = _neighbours(centres, radii)
        arcs, exposed = exposed_arcs(centres, radii, first, neighbours)
        reach = probe + margin
        depth = distances_outside(depth, owner, centres, radii, first, neighbours, exposed, arcs, spacing, reach)
    return ((np.float32(probe) - depth) / np.float32(spacing)).astype(np.float32)


def _neighbours(centres: Floats, radii: Floats) -> tuple[Integers, Integers]:
    """Those balls that meet ball i are `neighbours[first[i]:first[i + 1]]`, nearest first."""
    pairs = cKDTree(centres).query_pairs(2 * radii.max(), output_type="ndarray")
    apart = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    meet = apart < radii[pairs].sum(axis=1)
    one, other, apart = np.r_[pairs[meet, 0], pairs[meet, 1]], np.r_[pairs[meet, 1], pairs[meet, 0]], apart[meet]
    first = np.zeros(len(radii) + 1, dtype=np.int64)
    np.cumsum(np.bincount(one, minlength=len(radii)), out=first[1:])
    return first, other[np.lexsort((np.r_[apart, apart], one))].astype(np.int64)


def _one_piece(vertices: Floats, faces: Integers, max_vertices: int | None, notes: list[str]) -> Surface:
    """The surface of all pieces but specks, joined; each with its share of the vertices."""
    parts = connected(vertices, faces)
    sizes = np.array([abs(signed_volume(*part)) for part in parts])
    small = sizes < SPECK_VOLUME * sizes.sum()
    if sizes[small].sum() > _MOST_SPECKS * sizes.sum():  # as of a membrane, which is all small molecules
        small[:] = False
    elif small.any():
        notes.append(f"left out {small.sum()} specks")
    parts = [part for part, is_small in zip(parts, small, strict=True) if not is_small]
    if max_vertices is not None:
        n_vertices = sum(len(points) for points, _ in parts)
        parts = [simplified(*part, max(round(max_vertices * len(part[0]) / n_vertices), 12)) for part in parts]
    if len(parts) > 1:
        notes.append(f"joined {len(parts)} pieces by threads")
    return _joined(parts)


def _settled(field: Singles, vertices: Floats, faces: Integers) -> Floats:
    """The vertices moved to where the field is zero, and evenly apart along it; faces neither cut corners nor bulge.

    Triangles with their corners on a curved surface lie on one side of it. How far, at their centres, tells by how much
    to move the corners: the mean error of a linear interpolation is three quarters of that at the centre.
    """
    steps, normals = _steps(field, vertices)
    vertices = vertices - steps
    for _ in range(_N_ROUNDS):
        shift = _at_vertices(vertices[faces].mean(axis=1), vertices, faces) - vertices
        vertices = vertices + shift - np.einsum("ij,ij->i", shift, normals)[:, None] * normals
        steps, normals = _steps(field, vertices)
        vertices = vertices - steps
    steps, normals = _steps(field, vertices[faces].mean(axis=1))
    heights = np.einsum("ij,ij->i", steps, normals)[:, None]
    # Once to the vertices and back, so that neighbours move alike.
    heights = _at_vertices(heights, vertices, faces)[faces].mean(axis=1)
    return vertices - 0.75 * _at_vertices(heights, vertices, faces) * vertex_normals(vertices, faces)


def _steps(field: Singles, points: Floats) -> tuple[Floats, Floats]:
    """How far points lie off the surface, as vectors (P, 3) in cells, and their directions; both point outwards."""
    found = cubic_values(field, points)
    # The slope of a distance is 1; where it is not, as in the middle between two surfaces, it leads nowhere.
    slope = np.maximum(np.linalg.norm(found[:, 1:], axis=1), 0.5)
    normals = found[:, 1:] / slope[:, None]
    return np.clip(found[:, 0] / slope, -_STEP, _STEP)[:, None] * normals, normals


def _at_vertices(values: Floats, vertices: Floats, faces: Integers) -> Floats:
    """(V, D) means of the values (F, D) of the faces around each vertex, by their areas."""
    areas = face_areas(vertices, faces)[:, None]
    rows = np.repeat(np.concatenate([areas, areas * values], axis=1), 3, axis=0)
    totals = sums(faces.ravel(), rows, len(vertices))
    return totals[:, 1:] / np.maximum(totals[:, :1], np.finfo(float).tiny)


def _joined(parts: Sequence[Surface]) -> Surface:
    """The parts, closed and outward and none within another, as one closed surface; nearest ones are joined.

    A thread is a tube of triangular section between two triangles, the largest at the nearest vertices.
    """
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    vertices, faces = stacked(parts)
    links = [(starts[i] + a, starts[j] + b) for i, j, a, b in _nearest([points for points, _ in parts])]
    length = sum(float(np.linalg.norm(vertices[a] - vertices[b])) for a, b in links)
    girth = _THREADS * float(face_areas(vertices, faces).sum()) / max(length, 1e-300)
    for a, b in links:
        vertices, faces = _with_thread(vertices, faces, int(a), int(b), girth)
    return vertices, faces


def _nearest(parts: Sequence[Floats]) -> list[tuple[int, int, int, int]]:
    """Two parts and a vertex of each, for every link of the shortest tree that joins them all."""
    trees, links = [cKDTree(points) for points in parts], []
    best = dict.fromkeys(range(1, len(parts)), (np.inf, 0, 0, 0))
    new = 0
    while best:
        for j in best:
            away, at = trees[new].query(parts[j])
            if away.min() < best[j][0]:
                best[j] = (float(away.min()), new, int(at[away.argmin()]), int(away.argmin()))
        new = min(best, key=lambda j: best[j][0])
        _, old, a, b = best.pop(new)
        links.append((old, new, a, b))
    return links


def _with_thread(vertices: Floats, faces: Integers, a: int, b: int, girth: float) -> Surface:
    """With a tube of this girth between the largest triangles at two vertices."""
    areas = face_areas(vertices, faces)
    ends = [int(at[areas[at].argmax()]) for at in (np.flatnonzero((faces == v).any(axis=1)) for v in (a, b))]
    rims, new = [], []
    for number, face in enumerate(ends):
        corners = vertices[faces[face]]
        centre, around = corners.mean(axis=0), np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
        vertices = np.concatenate([vertices, centre + min(girth / around, _MOST_TAKEN) * (corners - centre)])
        rims.append(len(vertices) - 3 + np.arange(3))
        for i, k in ((0, 1), (1, 2), (2, 0)):
            c, d, e, f = faces[face][i], faces[face][k], rims[number][k], rims[number][i]
            new += [(c, d, e), (c, e, f)]
    # The rims run in opposite directions, as they face each other.
    turned = [np.roll(rims[1][::-1], k) for k in range(3)]
    other = min(turned, key=lambda rim: float(np.linalg.norm(vertices[rims[0]] - vertices[rim], axis=1).sum()))
    for i, k in ((0, 1), (1, 2), (2, 0)):
        new += [(rims[0][i], rims[0][k], other[k]), (rims[0][i], other[k], other[i])]
    return vertices, np.concatenate([np.delete(faces, ends, axis=0), np.array(new, dtype=np.int64)])

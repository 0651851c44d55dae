"""Tidy the triangles of a surface: weld, orient, drop fins, specks and hidden parts, fill small holes; take notes."""

from collections import defaultdict

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay, cKDTree

from igps._arrays import Booleans, Floats, Integers, Surface
from igps._text import counted
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import (
    TINY,
    both_ways,
    compact,
    diagonal,
    directed_edges,
    face_areas,
    face_parts,
    faces_at_sides,
    has_twins,
    lengths,
    linked,
    signed_volume,
    undirected_edges,
)
from igps.mesh.winding import winding_number

_WELD = 1e-8  # vertices closer than this share of the bounding box's diagonal are welded
# Width of a crack, in diagonals: in single precision the corners on its two sides differ in the last digits.
_CRACK = 1e-6
# With more neighbours this near per vertex on average, the surface is tiny in its bounding box, and cracks stay open.
_MAX_CRACK_NEIGHBOURS = 50
# Parts of less than this share of the area are specks, unless all of them together have ten times as much.
SPECK = 2e-3
_MAX_FINS = 0.05  # fins are dropped if all of them together have at most this share of the area
# A hole is small if a circle as long as its rim has at most this share of the area of its part of the surface.
_MAX_OPENINGS = 32  # a net or a crumbled scan has more
_SMALL_HOLE = 0.03


def weld(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Merge coincident vertices, drop degenerate and duplicate faces and unused vertices, and orient neighbours alike.

    The remaining vertices and faces keep their order.
    """
    n_before = len(vertices)
    # The tolerance must not depend on unused vertices far away.
    vertices, faces = compact(vertices, faces)
    n_unused = n_before - len(vertices)
    place = places(vertices)
    without_cracks = _close_cracks(vertices, place[faces])
    place = without_cracks[place]
    n_places = len(np.unique(place))
    n_coincident = len(vertices) - n_places
    if n_coincident:
        notes.append(f"welded {counted(n_coincident, 'coincident vertex')}")
        faces = place[faces]
    is_degenerate = has_twins(faces)
    if is_degenerate.any():
        notes.append(f"dropped {counted(int(is_degenerate.sum()), 'degenerate face')}")
        faces = faces[~is_degenerate]
    sorted_corners = np.sort(faces, axis=1)
    _, first = np.unique(sorted_corners, axis=0, return_index=True)
    n_duplicate = len(faces) - len(first)
    if n_duplicate:
        notes.append(f"dropped {counted(n_duplicate, 'duplicate face')}")
        faces = faces[np.sort(first)]
    n_unused += n_places - len(np.unique(faces))
    if n_unused:
        notes.append(f"dropped {counted(n_unused, 'unreferenced vertex')}")
    vertices, faces = compact(vertices, faces)
    return vertices, orient(faces, notes)


def places(vertices: Floats) -> Integers:
    """Return, for each vertex (V,), the index of the first vertex at the same place, up to a tolerance."""
    tolerance = _WELD * max(diagonal(vertices), TINY)
    centred = vertices - vertices.mean(axis=0)
    lattice = np.round(centred / tolerance).astype(np.int64)
    _, first, index = np.unique(lattice, axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[index.ravel()])


def _close_cracks(vertices: Floats, faces: Integers) -> Integers:
    """Return, for each vertex (V,), the vertex into which it is merged to close cracks between boundaries."""
    start, end = directed_edges(faces)
    is_boundary = faces_at_sides(faces).ravel() == 1
    boundary = np.union1d(start[is_boundary], end[is_boundary])
    index = np.arange(len(vertices))
    tree = cKDTree(vertices[boundary])
    width = _CRACK * diagonal(vertices)
    if tree.count_neighbors(tree, width) > _MAX_CRACK_NEIGHBOURS * len(boundary):
        return index
    start, end = tree.query_pairs(width, output_type="ndarray").T
    _, group = linked(start, end, len(boundary))
    _, first = np.unique(group, return_index=True)
    index[boundary] = boundary[first[group]]
    return index


def are_specks(areas: Floats) -> Booleans:
    """Return which parts are specks, given their areas; none are if all of them together have much area."""
    limit = SPECK * areas.sum()
    is_speck = areas < limit
    return is_speck & (areas[is_speck].sum() < 10 * limit)


def orient(faces: Integers, notes: list[str]) -> Integers:
    """Orient neighbouring faces alike, as far as the surface is orientable, by reversing as few faces as possible."""
    if not len(faces):
        return faces
    import igl

    aligned, part = igl.bfs_orient(faces)
    is_reversed = (aligned != faces).any(axis=1)
    n_reversed = np.bincount(part, weights=is_reversed)
    # Where most faces of a part would be reversed, the others are reversed instead.
    is_mostly_reversed = n_reversed > np.bincount(part) / 2
    is_reversed ^= is_mostly_reversed[part]
    if is_reversed.any():
        notes.append(f"turned {counted(int(is_reversed.sum()), 'face')} to orient the surface")
        faces = faces.copy()
        faces[is_reversed] = faces[is_reversed, ::-1]
    return faces


def tidy(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Drop fins and specks, then orient neighbours alike, which fins may have prevented."""
    without_fins = _drop_fins(vertices, faces)
    if len(without_fins) < len(faces):
        notes.append(f"dropped {counted(len(faces) - len(without_fins), 'face')} of fins")
        faces = without_fins
    part, areas = face_parts(vertices, faces)
    is_speck = are_specks(areas)
    if is_speck.any():
        notes.append(f"dropped {counted(int(is_speck.sum()), 'speck')}")
        faces = faces[~is_speck[part]]
    vertices, faces = compact(vertices, faces)
    return vertices, orient(faces, notes)


def _drop_fins(vertices: Floats, faces: Integers) -> Integers:
    """Drop fins: faces with a boundary edge and an edge that two other faces share. Keep all if fins have much area."""
    remaining = faces
    while len(remaining):
        n_faces = faces_at_sides(remaining)
        is_free = (n_faces == 1).any(axis=1)
        is_crowded = (n_faces > 2).any(axis=1)
        is_fin = is_free & is_crowded
        if not is_fin.any():
            break
        remaining = remaining[~is_fin]
    area = face_areas(vertices, remaining).sum()
    area_before = face_areas(vertices, faces).sum()
    return remaining if area >= (1 - _MAX_FINS) * area_before else faces


def drop_hidden_parts(
    vertices: Floats, faces: Integers, notes: list[str], *, cavities: bool = False
) -> Surface:
    """Drop the parts that lie inside the largest one, if that is closed.

    With `cavities`, closed parts inside that lie in no other cavity are kept and oriented inward, to bound hollows.
    """
    part, areas = face_parts(vertices, faces)
    if len(areas) < 2:
        return vertices, faces
    largest = int(np.argmax(areas))
    try:
        body = Mesh(*compact(vertices, faces[part == largest]))
    except MeshError:
        return vertices, faces
    others = np.unique(faces[part != largest])
    is_inside = np.zeros(len(vertices), dtype=bool)
    is_inside[others] = _are_inside(body, vertices[others])
    reaches_out = ~is_inside[faces].all(axis=1)
    is_hidden = np.bincount(part, weights=reaches_out, minlength=len(areas)) == 0
    if not is_hidden.any():
        return vertices, faces
    if cavities:
        # Compare signs, because the largest part may be inside out itself.
        outer_sign = np.sign(signed_volume(vertices, faces[part == largest]))
        faces = faces.copy()
        for k in _cavities_among(vertices, faces, part, np.flatnonzero(is_hidden), areas):
            is_hidden[k] = False
            hollow = faces[part == k]
            if outer_sign * signed_volume(*compact(vertices, hollow)) > 0:
                notes.append("turned the surface of a cavity towards the inside")
                faces[part == k] = hollow[:, ::-1]
    if is_hidden.any():
        notes.append(f"dropped {counted(int(is_hidden.sum()), 'part')} hidden inside")
    return compact(vertices, faces[~is_hidden[part]])


def _cavities_among(
    vertices: Floats, faces: Integers, part: Integers, hidden: Integers, areas: Floats
) -> list[int]:
    """Return those of the hidden parts that are closed and lie in no other, the largest first."""
    hollows: list[Mesh] = []
    found = []
    order = np.argsort(-areas[hidden], kind="stable")
    for k in hidden[order].tolist():
        try:
            hollow = Mesh(*compact(vertices, faces[part == k]))
        except MeshError:
            continue
        if any(_are_inside(other, hollow.vertices).any() for other in hollows):
            continue
        hollows.append(hollow)
        found.append(k)
    return found


def _are_inside(body: Mesh, points: Floats) -> Booleans:
    return winding_number(body.vertices, body.faces, points) > 0.5


def fill_small_holes(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    part, areas = face_parts(vertices, faces)
    part_of_vertex = np.zeros(len(vertices), dtype=np.int64)
    part_of_vertex[faces] = part[:, None]
    n_filled = 0
    for loop in _boundary_loops(faces):
        rim = vertices[loop]
        sides = rim - np.roll(rim, -1, axis=0)
        length = lengths(sides).sum()
        area_of_circle = length**2 / (4 * np.pi)
        area_of_part = areas[part_of_vertex[loop[0]]]
        if area_of_circle <= _SMALL_HOLE * area_of_part:
            vertices, faces = _fill_hole(vertices, faces, loop)
            n_filled += 1
    if n_filled:
        notes.append(f"filled {counted(n_filled, 'small hole')}")
    return vertices, faces


def closed_by_rims(vertices: Floats, faces: Integers) -> tuple[Floats, Integers, float]:
    """Close each opening by the soap film that its rim spans; return also the share of the films in the area."""
    n_faces = len(faces)
    for loop in _boundary_loops(faces)[:_MAX_OPENINGS]:
        vertices, faces = _span(vertices, faces, loop)
    areas = face_areas(vertices, faces)
    total = areas.sum()
    share = float(areas[n_faces:].sum() / total) if total else 0.0
    return vertices, faces, share


def _boundary_loops(faces: Integers) -> list[Integers]:
    """Return the rims of holes, in the direction of the faces that would fill them; no loop meets itself.

    Loops are also found where several rims meet in a vertex or the orientation of faces is inconsistent. Boundary edges
    that form no loop are left out.
    """
    end, start = directed_edges(faces)
    n_faces = faces_at_sides(faces)
    free = np.flatnonzero(n_faces == 1)
    starts = start[free].tolist()
    forward = defaultdict(list)
    backward = defaultdict(list)
    ends = end[free].tolist()
    for edge, (a, b) in enumerate(zip(starts, ends, strict=True)):
        forward[a].append((edge, b))
        backward[b].append((edge, a))
    visited: set[int] = set()
    loops = []
    for first in starts:
        path = [first]
        position = {first: 0}
        while True:
            here = path[-1]
            steps = (step for step in forward[here] + backward[here] if step[0] not in visited)
            edge, vertex = next(steps, (-1, -1))
            if edge < 0:  # back at the start, or a dead end
                break
            visited.add(edge)
            if vertex not in position:
                position[vertex] = len(path)
                path.append(vertex)
                continue
            loop = path[position[vertex] :]
            if len(loop) > 2:
                loops.append(np.array(loop))
            for old in loop[1:]:
                del position[old]
                path.pop()
    return loops


def _fill_hole(vertices: Floats, faces: Integers, loop: Integers) -> Surface:
    """Fill a hole with the triangulation of a disc of rings, spaced like the rim and bent like a thin plate."""
    n_vertices = len(vertices)
    vertices, faces = _span(vertices, faces, loop)
    if len(vertices) == n_vertices:
        return vertices, faces
    return _fair(vertices, faces, n_vertices), faces


def _span(vertices: Floats, faces: Integers, loop: Integers) -> Surface:
    """Close a rim with the triangulation of a disc of rings, spaced like the rim and taut like a soap film."""
    n = len(loop)
    if n == 3:
        return vertices, np.vstack([faces, loop[None]])
    rim = vertices[loop]
    before = np.roll(rim, 1, axis=0)
    along = np.cumsum(lengths(rim - before))
    n_rings = max(round(n / (2 * np.pi)), 1)
    disc = [_circle(along / along[-1], 1.0)]
    for ring in range(1, n_rings):
        radius = 1 - ring / n_rings
        size = max(round(n * radius), 3)
        turns = (np.arange(size) + ring / 2) / size
        disc.append(_circle(turns, radius))
    disc.append(np.zeros((1, 2)))
    plane = np.concatenate(disc)
    patch = Delaunay(plane).simplices.astype(np.int64)  # counter-clockwise, like the loop
    film = _solve_umbrella(rim, patch, len(plane), order=1)
    index = np.append(loop, len(vertices) + np.arange(len(film)))
    vertices = np.vstack([vertices, film])
    faces = np.vstack([faces, index[patch]])
    return vertices, faces


def _circle(turns: Floats, radius: float) -> Floats:
    angles = 2 * np.pi * turns
    circle = [np.cos(angles), np.sin(angles)]
    return radius * np.column_stack(circle)


def _solve_umbrella(fixed: Floats, faces: Integers, n_points: int, order: int) -> Floats:
    """Return the points after the fixed ones, placed so that the umbrella operator to the power `order` is 0."""
    edges, _ = undirected_edges(faces)
    start, end = both_ways(edges)
    ones = np.ones(len(start))
    graph = sparse.csr_array((ones, (start, end)), shape=(n_points, n_points))
    averaging = sparse.diags_array(1 / graph.sum(axis=1)) @ graph
    umbrella = sparse.eye_array(n_points) - averaging
    if order == 2:
        umbrella = umbrella @ umbrella
    n_fixed = len(fixed)
    operator = umbrella.tocsr()[n_fixed:]
    of_free = operator[:, n_fixed:].tocsc()
    of_fixed = operator[:, :n_fixed] @ fixed
    solved = spsolve(of_free, -of_fixed)
    return np.asarray(solved).reshape(-1, 3)


def _fair(vertices: Floats, faces: Integers, n_old: int) -> Floats:
    """Move the vertices from `n_old` on so that the surface continues smoothly across the rim, like a thin plate."""
    is_near = (faces >= n_old).any(axis=1)
    for _ in range(2):
        is_near = np.isin(faces, faces[is_near]).any(axis=1)
    used, patch = np.unique(faces[is_near], return_inverse=True)
    fixed = vertices[used[used < n_old]]
    free = _solve_umbrella(fixed, patch.reshape(-1, 3), len(used), order=2)
    return np.concatenate([vertices[:n_old], free])

"""The triangles of a surface tidied up: welded, turned alike, without fins, specks, small holes, and what is hidden."""

from collections import defaultdict

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay, cKDTree

from igps._arrays import Booleans, Floats, Integers, Surface
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import compact, diagonal, directed_edges, face_areas, face_parts, signed_volume, undirected_edges
from igps.mesh.winding import winding_number

# Vertices closer than this share of the bounding box's diagonal are one.
_WELD = 1e-8
# How near the sides of a crack are: their corners, in single precision, differ in the last digits.
_CRACK = 1e-6
# With more vertices so near to each, on average, the surface is tiny in its bounding box, and they are no cracks.
_MOST_NEAR = 50
# Parts of less than this share of the area are specks, unless all of them together have ten times as much.
SPECK = 2e-3
# Fins may have this share of the area.
_FINS = 0.05
# A hole is small if a circle as long as its rim has at most this share of the area of its part of the surface.
_SMALL_HOLE = 0.03


def welded(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Coincident vertices made one, degenerate and doubled faces and unused vertices dropped, neighbours turned alike.

    Vertices and faces that stay keep their order. What was done is added to `notes`.
    """
    n_given = len(vertices)
    vertices, faces = compact(vertices, faces)  # far from the others an unused one makes coincident all that are near
    unused = n_given - len(vertices)
    place = places(vertices)
    place = _without_cracks(vertices, place[faces])[place]
    n_places = len(np.unique(place))
    if n_places < len(vertices):
        notes.append(f"welded {len(vertices) - n_places} coincident vertices")
        faces = place[faces]
    is_degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if is_degenerate.any():
        notes.append(f"dropped {int(is_degenerate.sum())} degenerate faces")
        faces = faces[~is_degenerate]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(once) < len(faces):
        notes.append(f"dropped {len(faces) - len(once)} duplicate faces")
        faces = faces[np.sort(once)]
    unused += n_places - len(np.unique(faces))
    if unused:
        notes.append(f"dropped {unused} unreferenced vertices")
    vertices, faces = compact(vertices, faces)
    return vertices, oriented(faces, notes)


def places(vertices: Floats) -> Integers:
    """(V,) of each vertex the first that is in the same place, on a lattice in units of the bounding box."""
    lattice = np.round((vertices - vertices.mean(axis=0)) / (_WELD * max(diagonal(vertices), np.finfo(float).tiny)))
    _, first, index = np.unique(lattice.astype(np.int64), axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[index.ravel()])


def joined_at_free_edges(vertices: Floats, faces: Integers) -> Integers:
    """The faces (F, 3), where vertices at free edges are made one if they are in one place."""
    free, index = _at_free_edges(vertices, faces), np.arange(len(vertices))
    if len(free):
        index[free] = free[places(vertices[free])]
    return index[faces]


def _without_cracks(vertices: Floats, faces: Integers) -> Integers:
    """(V,) which vertex each becomes: sides of a crack that are nearer than single precision can tell are made one."""
    free, index = _at_free_edges(vertices, faces), np.arange(len(vertices))
    tree, near = cKDTree(vertices[free]), _CRACK * diagonal(vertices)
    if tree.count_neighbors(tree, near) > _MOST_NEAR * len(free):
        return index
    pairs = tree.query_pairs(near, output_type="ndarray")
    graph = sparse.coo_array((np.ones(len(pairs), dtype=np.int8), tuple(pairs.T)), shape=(len(free), len(free)))
    _, first, group = np.unique(connected_components(graph, directed=False)[1], return_index=True, return_inverse=True)
    index[free] = free[first[group]]
    return index


def _at_free_edges(vertices: Floats, faces: Integers) -> Integers:
    ends, edge_of_side = undirected_edges(faces, len(vertices))
    return np.unique(ends[np.bincount(edge_of_side, minlength=len(ends)) == 1])


def are_specks(areas: Floats) -> Booleans:
    """Which of the parts with these areas are specks; none if all specks together have much area."""
    specks = areas < SPECK * areas.sum()
    return specks & (areas[specks].sum() < 10 * SPECK * areas.sum())


def oriented(faces: Integers, notes: list[str]) -> Integers:
    """The faces turned so that neighbours agree, as far as the surface can be oriented; the smaller side is turned."""
    if not len(faces):
        return faces
    import igl

    agreeing, part = igl.bfs_orient(faces)
    turn = (agreeing != faces).any(axis=1)
    turn ^= (np.bincount(part, weights=turn) > np.bincount(part) / 2)[part]
    if turn.any():
        notes.append(f"turned {int(turn.sum())} faces to orient the surface")
        faces = np.where(turn[:, None], faces[:, ::-1], faces)
    return faces


def tidied(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Without fins and specks, and turned alike once it is plain which faces are neighbours."""
    kept = _without_fins(vertices, faces)
    if len(kept) < len(faces):
        notes.append(f"dropped {len(faces) - len(kept)} faces of fins")
        faces = kept
    part, areas = face_parts(vertices, faces)
    specks = are_specks(areas)
    if specks.any():
        notes.append(f"dropped {int(specks.sum())} specks")
        faces = faces[~specks[part]]
    vertices, faces = compact(vertices, faces)
    return vertices, oriented(faces, notes)


def _without_fins(vertices: Floats, faces: Integers) -> Integers:
    """The faces but for fins, which have a free edge and one that two others share; all, if fins have much area.

    What may be left of a larger fin shares no edge with two other faces, and does no harm.
    """
    kept = faces
    while len(kept):
        _, edge_of_side = undirected_edges(kept, len(vertices))
        count = np.bincount(edge_of_side)[edge_of_side].reshape(-1, 3)
        fin = (count == 1).any(axis=1) & (count > 2).any(axis=1)
        if not fin.any():
            break
        kept = kept[~fin]
    left = face_areas(vertices, kept).sum()
    return kept if left >= (1 - _FINS) * face_areas(vertices, faces).sum() else faces


def without_hidden(vertices: Floats, faces: Integers, notes: list[str], *, cavities: bool = False) -> Surface:
    """Without the parts that lie inside the largest, if that is closed.

    With `cavities` those of them stay that are closed and lie in no other, turned so that they bound hollows.
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
    within = np.zeros(len(vertices), dtype=bool)
    within[others] = winding_number(body.vertices, body.faces, vertices[others]) > 0.5
    hidden = np.bincount(part, weights=~within[faces].all(axis=1), minlength=len(areas)) == 0
    if not hidden.any():
        return vertices, faces
    if cavities:
        faces = faces.copy()
        kept: list[Mesh] = []
        for k in sorted(np.flatnonzero(hidden), key=lambda k: -areas[k]):
            own = part == k
            surface = compact(vertices, faces[own])
            try:
                cavity = Mesh(*surface)
            except MeshError:
                continue
            if any((winding_number(one.vertices, one.faces, cavity.vertices) > 0.5).any() for one in kept):
                continue
            kept.append(cavity)
            hidden[k] = False
            if signed_volume(*surface) * signed_volume(vertices, faces[part == largest]) > 0:  # which may be inside out
                notes.append("turned the surface of a cavity towards the inside")
                faces[own] = faces[own][:, ::-1]
    if hidden.any():
        notes.append(f"dropped {int(hidden.sum())} parts hidden inside")
    return compact(vertices, faces[~hidden[part]])


def with_small_holes_filled(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """With patches in the small holes."""
    part, areas = face_parts(vertices, faces)
    part_of_vertex = np.zeros(len(vertices), dtype=np.int64)
    part_of_vertex[faces] = part[:, None]
    n_filled = 0
    for loop in _loops(faces):
        length = np.linalg.norm(vertices[loop] - np.roll(vertices[loop], -1, axis=0), axis=1).sum()
        if length**2 / (4 * np.pi) <= _SMALL_HOLE * areas[part_of_vertex[loop[0]]]:
            vertices, faces = _with_patch(vertices, faces, loop)
            n_filled += 1
    if n_filled:
        notes.append(f"filled {n_filled} small holes")
    return vertices, faces


def _loops(faces: Integers) -> list[Integers]:
    """The rims of holes, as the faces that would close them run along them; no loop meets itself.

    Where several rims meet in a vertex, or faces do not agree, free edges still make loops; those that make none are
    left out.
    """
    end, start = directed_edges(faces)
    _, edge_of_side = undirected_edges(faces, int(faces.max(initial=-1)) + 1)
    free = np.nonzero(np.bincount(edge_of_side)[edge_of_side] == 1)[0]
    onward, backward = defaultdict(list), defaultdict(list)
    for edge, a, b in zip(free.tolist(), start[free].tolist(), end[free].tolist(), strict=True):
        onward[a].append((edge, b))
        backward[b].append((edge, a))
    walked: set[int] = set()
    loops = []
    for first in start[free].tolist():
        path, place = [first], {first: 0}
        while path:
            here = [*onward[path[-1]], *backward[path[-1]]]
            edge, vertex = next((step for step in here if step[0] not in walked), (-1, -1))
            if edge < 0:  # home again, or at an end that leads nowhere
                break
            walked.add(edge)
            if vertex not in place:
                place[vertex] = len(path)
                path.append(vertex)
                continue
            loop = path[place[vertex] :]
            if len(loop) > 2:
                loops.append(np.array(loop))
            for passed in loop[1:]:
                del place[passed]
            del path[place[vertex] + 1 :]
    return loops


def _with_patch(vertices: Floats, faces: Integers, loop: Integers) -> Surface:
    """A patch on a loop, as a disc of rings with the rim's spacing is triangulated, bent like a thin plate."""
    n = len(loop)
    if n == 3:
        return vertices, np.vstack([faces, loop[None]])
    rim = vertices[loop]
    along = np.cumsum(np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1))
    n_rings = max(round(n / (2 * np.pi)), 1)
    disc = [_circle(along / along[-1], 1.0)]
    for ring in range(1, n_rings):
        radius = 1 - ring / n_rings
        size = max(round(n * radius), 3)
        disc.append(_circle((np.arange(size) + ring / 2) / size, radius))
    disc.append(np.zeros((1, 2)))
    plane = np.concatenate(disc)
    patch = Delaunay(plane).simplices.astype(np.int64)  # counter-clockwise, as the loop runs
    points = np.vstack([rim, np.zeros((len(plane) - n, 3))])
    points[n:] = _relaxed(points, patch, n, order=1)
    index = np.concatenate([loop, len(vertices) + np.arange(len(points) - n)])
    faces = np.vstack([faces, index[patch]])
    return _fair(np.vstack([vertices, points[n:]]), faces, len(vertices)), faces


def _circle(turns: Floats, radius: float) -> Floats:
    return radius * np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)


def _relaxed(points: Floats, faces: Integers, n_fixed: int, order: int) -> Floats:
    """The free points, after the first `n_fixed`, where the `order`-th power of the umbrella operator vanishes."""
    edges, _ = undirected_edges(faces, len(points))
    size, ends = len(points), (edges.T.ravel(), edges[:, ::-1].T.ravel())
    graph = sparse.coo_array((np.ones(2 * len(edges)), ends), shape=(size, size)).tocsr()
    umbrella = sparse.eye_array(size) - sparse.diags_array(1 / graph.sum(axis=1)) @ graph
    operator = (umbrella @ umbrella if order == 2 else umbrella).tocsr()[n_fixed:]
    solved = spsolve(operator[:, n_fixed:].tocsc(), -(operator[:, :n_fixed] @ points[:n_fixed]))
    return np.asarray(solved).reshape(-1, 3)


def _fair(vertices: Floats, faces: Integers, n_old: int) -> Floats:
    """The vertices, those from `n_old` on moved so that the surface goes on smoothly over the rim (a thin plate)."""
    ring = np.unique(faces[(faces >= n_old).any(axis=1)])
    near = faces[np.isin(faces, ring).any(axis=1)]
    near = faces[np.isin(faces, np.unique(near)).any(axis=1)]
    used = np.unique(near)
    fixed = int((used < n_old).sum())
    free = _relaxed(vertices[used], np.searchsorted(used, near), fixed, order=2)
    return np.concatenate([vertices[:n_old], free])

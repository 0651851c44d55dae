"""The least that makes a body of a surface: as it is, welded, filled, smoothed, subdivided, or watertight.

A mesh that is a body already and not noisy is left as it is, bit for bit. Every step says in the mesh's notes what it
did, and `mended_by` tells from the notes which steps were needed.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from igps.geometry.coordinates import winding_number
from igps.geometry.denoising import denoised, is_noisy
from igps.geometry.mesh import Mesh, MeshError, check_arrays
from igps.geometry.surface import area_vectors
from igps.geometry.watertight import watertight

logger = logging.getLogger(__name__)

Mending = Literal["auto", "never", "always"]
Step = Literal["welded", "filled", "smoothed", "subdivided", "watertight"]

# The first words of the notes of each step.
_WORDS: dict[str, Step] = {
    "welded": "welded",
    "dropped": "welded",
    "turned": "welded",
    "filled": "filled",
    "smoothed": "smoothed",
    "subdivided": "subdivided",
    "made watertight": "watertight",
}
# Vertices closer than this share of the bounding box's diagonal are one.
_WELD = 1e-8
# A hole is small if a circle as long as its rim has at most this share of the area of its part of the surface.
_SMALL_HOLE = 0.03
# Parts of less than this share of the area are specks, unless all of them together have ten times as much.
_SPECK = 2e-3
# Fins may have this share of the area.
_FINS = 0.05
# A mesh that is subdivided gets so many vertices for each that is needed: with just enough the last eigenfunctions
# would be those of the triangles.
_PLENTY = 4


def mend(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64] | None,
    *,
    how: Mending = "auto",
    least_vertices: int = 0,
    normals: NDArray[np.float64] | None = None,
    name: str = "mesh",
    notes: tuple[str, ...] = (),
) -> Mesh:
    """A body from a surface in any state, by the least that helps.

    In this order, and no further than needed: the surface as it is; coincident vertices welded, degenerate and doubled
    faces, fins, specks and closed parts inside the body dropped, faces turned; small holes filled; `watertight`. What
    is rough with a scanner's noise all over is smoothed, because noise adds area (see `denoising`). What then has fewer
    than `least_vertices` is subdivided, longest edges first, which leaves the surface where it is.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices; None or empty for a cloud of points, which is made watertight.
        how: "auto" for the above; "never" takes bodies only; "always" makes everything watertight.
        least_vertices: such as the number of eigenpairs plus two; not with "never".
        normals: (V, 3) of a cloud of points, if known.
        name: what error messages call the surface, usually its file.
        notes: what was done to it before.

    Raises:
        MeshError: the surface is not a body (with "never"), or nothing can be made of it; names what is wrong and the
            remedy.
    """
    if how not in ("auto", "never", "always"):
        raise ValueError(f"how: expected 'auto', 'never' or 'always', got {how!r}.")
    if how == "never":
        return Mesh(vertices, np.asarray(faces), name=name, notes=notes)
    if faces is None or np.size(faces) == 0:
        _check_cloud(vertices, name)
        mesh = watertight(vertices, normals=normals, name=name)
    else:
        check_arrays(vertices, faces, name)
        vertices, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        _check_extent(vertices, triangles, name)
        mesh = _remade(vertices, triangles, name) if how == "always" else _mended(vertices, triangles, name)
    if len(mesh.vertices) < least_vertices:
        mesh = subdivided(mesh, _PLENTY * least_vertices)
    for note in mesh.notes:
        logger.info("%s: %s", name, note)
    return replace(mesh, notes=(*notes, *mesh.notes)) if notes else mesh


def mended_by(notes: Iterable[str]) -> tuple[Step, ...]:
    """The steps that the notes of a `Mesh` or `Signature` tell of, in order, each once."""
    steps = (step for note in notes for start, step in _WORDS.items() if note.startswith(start))
    return tuple(dict.fromkeys(steps))


def subdivided(mesh: Mesh, n_vertices: int) -> Mesh:
    """The same surface with at least `n_vertices` vertices: the longest edges are cut in their middles."""
    before = len(mesh.vertices)
    if before >= n_vertices:
        return mesh
    vertices, faces = mesh.vertices, mesh.faces
    while len(vertices) < n_vertices:
        edges, edge_of_side = _edges(faces)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        # Those not much shorter than the longest, so that they are cut in the order of their lengths.
        cut = np.argsort(-length, kind="stable")[: n_vertices - len(vertices)]
        vertices, faces = _cut(vertices, faces, edges, edge_of_side, cut[length[cut] > 0.7 * length.max()])
    note = f"subdivided from {before} to {len(vertices)} vertices"
    return replace(mesh, vertices=vertices, faces=faces, notes=(*mesh.notes, note))


def _mended(vertices: NDArray[np.float64], faces: NDArray[np.int64], name: str) -> Mesh:
    notes: list[str] = []
    for step in (None, welded, _tidied, _filled, _without_hidden):
        if step is not None and len(faces):
            vertices, faces = step(vertices, faces, notes)
        try:
            mesh = Mesh(vertices, faces, name=name, notes=tuple(notes))
        except MeshError:
            continue
        smooth = _smoothed(mesh.vertices, mesh.faces, notes)
        return mesh if smooth is mesh.vertices else Mesh(smooth, mesh.faces, name=name, notes=tuple(notes))
    body = watertight(_smoothed(vertices, faces, notes), faces, name=name)
    return replace(body, notes=(*notes, *body.notes))


def _remade(vertices: NDArray[np.float64], faces: NDArray[np.int64], name: str) -> Mesh:
    notes: list[str] = []
    neat, triangles = welded(vertices, faces, [])
    smooth = _smoothed(neat, triangles, notes)
    body = watertight(smooth, triangles, name=name) if notes else watertight(vertices, faces, name=name)
    return replace(body, notes=(*notes, *body.notes))


def _smoothed(vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]) -> NDArray[np.float64]:
    if not len(faces) or not is_noisy(vertices, faces):
        return vertices
    notes.append("smoothed: the surface was rough with noise")
    return denoised(vertices, faces)


def welded(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Coincident vertices made one, degenerate and doubled faces and unused vertices dropped, neighbours turned alike.

    Vertices and faces that stay keep their order. What was done is added to `notes`.
    """
    # Welding happens on a lattice in units of the bounding box, so that the unit of length does not matter.
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    lattice = np.round((vertices - vertices.mean(axis=0)) / (_WELD * max(diagonal, np.finfo(float).tiny)))
    _, first, index = np.unique(lattice.astype(np.int64), axis=0, return_index=True, return_inverse=True)
    if len(first) < len(vertices):
        notes.append(f"welded {len(vertices) - len(first)} coincident vertices")
        faces = first[index.ravel()][faces]
    sharp = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not sharp.all():
        notes.append(f"dropped {int((~sharp).sum())} degenerate faces")
        faces = faces[sharp]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(once) < len(faces):
        notes.append(f"dropped {len(faces) - len(once)} duplicate faces")
        faces = faces[np.sort(once)]
    unused = len(first) - len(np.unique(faces))
    if unused:
        notes.append(f"dropped {unused} unreferenced vertices")
    vertices, faces = _compact(vertices, faces)
    return vertices, _turned(faces, notes)


def _turned(faces: NDArray[np.int64], notes: list[str]) -> NDArray[np.int64]:
    """The faces turned so that neighbours agree, as far as the surface can be oriented.

    From the first face of each part in the order of a breadth-first search; the smaller side is turned.
    """
    if not len(faces):
        return faces
    n = len(faces)
    edges, edge_of_side = _edges(faces)
    by_edge = np.argsort(edge_of_side.ravel(), kind="stable")
    count = np.bincount(edge_of_side.ravel(), minlength=len(edges))
    at = (np.cumsum(count) - count)[count == 2]
    one, two = by_edge[at], by_edge[at + 1]
    start = faces.ravel()
    differ = start[one] == start[two]  # both run along the edge in the same direction
    one, two = one // 3, two // 3
    # One edge of two is enough where faces share two: of the matrix entries for a pair, 1 agrees and 2 differs.
    pair, where = np.unique(np.minimum(one, two) * n + np.maximum(one, two), return_index=True)
    graph = sparse.csr_array((np.where(differ[where], 2, 1), (pair // n, pair % n)), shape=(n, n))
    graph = (graph + graph.T).tocsr()
    n_parts, part = connected_components(graph, directed=False)
    # One search through all parts: a root is joined to the first face of each.
    _, first = np.unique(part, return_index=True)
    root = sparse.csr_array((np.ones(n_parts, dtype=int), (np.zeros(n_parts, dtype=int), first)), shape=(1, n))
    whole = sparse.vstack([sparse.hstack([graph, sparse.csr_array((n, 1), dtype=int)]), sparse.hstack([root, [[0]]])])
    _, before = breadth_first_order(whole.tocsr(), n, directed=True)
    before[n] = n
    flip = np.zeros(n + 1, dtype=bool)
    child = np.nonzero(before[:n] != n)[0]
    flip[child] = np.asarray(graph[child, before[child]]).ravel() == 2
    # Parity along the way to the root, by doubling.
    while (before != n).any():
        flip ^= flip[before]
        before = before[before]
    turn = flip[:n]
    mostly = np.bincount(part, weights=turn, minlength=n_parts) > np.bincount(part, minlength=n_parts) / 2
    turn ^= mostly[part]
    if turn.any():
        notes.append(f"turned {int(turn.sum())} faces to orient the surface")
        faces = np.where(turn[:, None], faces[:, ::-1], faces)
    return faces


def _tidied(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Without fins and specks."""
    kept = _without_fins(vertices, faces)
    if len(kept) < len(faces):
        notes.append(f"dropped {len(faces) - len(kept)} faces of fins")
        faces = kept
    part, areas = _parts(vertices, faces)
    specks = areas < _SPECK * areas.sum()
    if specks.any() and areas[specks].sum() < 10 * _SPECK * areas.sum():
        notes.append(f"dropped {int(specks.sum())} specks")
        faces = faces[~specks[part]]
    # Only now is it plain which faces are neighbours.
    vertices, faces = _compact(vertices, faces)
    return vertices, _turned(faces, notes)


def _compact(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The vertices that faces use, in their order, and the faces that use them."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def _without_fins(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Without the faces that hang on an edge of two others, peeled from their free edges; all, if they are many."""
    kept = faces
    while len(kept):
        _, edge_of_side = _edges(kept)
        count = np.bincount(edge_of_side.ravel())[edge_of_side]
        fin = (count == 1).any(axis=1) & (count > 2).any(axis=1)
        if not fin.any():
            # A face with a second free edge that was left of a larger fin does no harm: it hangs on nothing crowded.
            break
        kept = kept[~fin]
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1).sum()
    left = np.linalg.norm(area_vectors(vertices, kept), axis=1).sum()
    return kept if left >= (1 - _FINS) * area else faces


def _filled(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """With patches in the small holes."""
    part, areas = _parts(vertices, faces)
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


def _loops(faces: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The rims of holes, as the faces that would close them run along them; no loop meets itself.

    Where several rims meet in a vertex, or faces do not agree, the free edges still make loops, if any that end nowhere
    are left out.
    """
    start, end = np.roll(faces, -1, axis=1).ravel(), faces.ravel()
    _, edge_of_side = _edges(faces)
    free = np.nonzero(np.bincount(edge_of_side.ravel())[edge_of_side.ravel()] == 1)[0]
    onward: dict[int, list[tuple[int, int]]] = {}
    backward: dict[int, list[tuple[int, int]]] = {}
    for edge, a, b in zip(free.tolist(), start[free].tolist(), end[free].tolist(), strict=True):
        onward.setdefault(a, []).append((edge, b))
        backward.setdefault(b, []).append((edge, a))
    walked: set[int] = set()
    loops = []
    for first in start[free].tolist():
        path, place = [first], {first: 0}
        while path:
            here = [*onward.get(path[-1], ()), *backward.get(path[-1], ())]
            step = next(((edge, vertex) for edge, vertex in here if edge not in walked), None)
            if step is None:
                # Home again, or at an end that leads nowhere.
                break
            edge, vertex = step
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


def _with_patch(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], loop: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
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
    return _fair(np.vstack([vertices, points[n:]]), np.vstack([faces, index[patch]]), len(vertices))


def _circle(turns: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    return radius * np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)


def _relaxed(points: NDArray[np.float64], faces: NDArray[np.int64], n_fixed: int, order: int) -> NDArray[np.float64]:
    """The free points, after the first `n_fixed`, where the `order`-th power of the umbrella operator vanishes."""
    edges, _ = _edges(faces)
    size = len(points)
    graph = sparse.coo_array(
        (np.ones(2 * len(edges)), (edges.T.ravel(), edges[:, ::-1].T.ravel())), shape=(size, size)
    ).tocsr()
    umbrella = sparse.eye_array(size) - sparse.diags_array(1 / graph.sum(axis=1)) @ graph
    operator = (umbrella @ umbrella if order == 2 else umbrella).tocsr()[n_fixed:]
    solved = spsolve(operator[:, n_fixed:].tocsc(), -(operator[:, :n_fixed] @ points[:n_fixed]))
    return np.asarray(solved).reshape(-1, 3)


def _fair(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], n_old: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The vertices from `n_old` on moved so that the surface goes on smoothly over the rim (a thin plate)."""
    ring = np.unique(faces[(faces >= n_old).any(axis=1)])
    near = faces[np.isin(faces, ring).any(axis=1)]
    near = faces[np.isin(faces, np.unique(near)).any(axis=1)]
    used = np.unique(near)
    fixed = int((used < n_old).sum())
    vertices = vertices.copy()
    vertices[n_old:] = _relaxed(vertices[used], np.searchsorted(used, near), fixed, order=2)
    return vertices, faces


def _without_hidden(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Without the parts that lie inside the largest, if that is closed."""
    part, areas = _parts(vertices, faces)
    if len(areas) < 2:
        return vertices, faces
    largest = int(np.argmax(areas))
    try:
        body = Mesh(*_compact(vertices, faces[part == largest]))
    except MeshError:
        return vertices, faces
    others = np.unique(faces[part != largest])
    within = np.zeros(len(vertices), dtype=bool)
    within[others] = winding_number(body.vertices, body.faces, vertices[others]) > 0.5
    hidden = np.bincount(part, weights=~within[faces].all(axis=1), minlength=len(areas)) == 0
    if not hidden.any():
        return vertices, faces
    notes.append(f"dropped {int(hidden.sum())} parts hidden inside")
    return _compact(vertices, faces[~hidden[part]])


def _parts(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The connected part of each face, and the areas of the parts."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    graph = sparse.coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(len(vertices),) * 2)
    _, label = connected_components(graph, directed=False)
    _, part = np.unique(label[faces[:, 0]], return_inverse=True)
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    return part.astype(np.int64), np.bincount(part, weights=area).astype(np.float64)


def _edges(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(E, 2) undirected edges, and the edge of each side of each face, the side from corner i to the next: (F, 3)."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    size = int(faces.max()) + 1
    codes, edge_of_side = np.unique(np.minimum(start, end) * size + np.maximum(start, end), return_inverse=True)
    return np.stack([codes // size, codes % size], axis=1), edge_of_side.reshape(-1, 3)


def _cut(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    edges: NDArray[np.int64],
    edge_of_side: NDArray[np.int64],
    cut: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """New vertices in the middles of the edges `cut`, and every face with such edges cut accordingly."""
    middle = np.full(len(edges), -1)
    middle[cut] = len(vertices) + np.arange(len(cut))
    vertices = np.vstack([vertices, vertices[edges[cut]].mean(axis=1)])
    m = middle[edge_of_side]
    n_cut = (m >= 0).sum(axis=1)
    pieces = [faces[n_cut == 0], faces[n_cut == 0][:0]]
    for n, first in ((1, 0), (2, 0), (3, 0)):
        chosen = n_cut == n
        f, k = faces[chosen], m[chosen]
        # Turned so that the cut sides come first.
        turn = np.argmax(k >= 0, axis=1) if n == 1 else (np.argmin(k >= 0, axis=1) + 1 if n == 2 else 0)
        order = (np.arange(3) + np.reshape(turn, (-1, 1)) + first) % 3
        rows = np.arange(len(f))[:, None]
        a, b, c = f[rows, order].T
        p, q, r = k[rows, order].T
        if n == 1:
            corners = [(a, p, c), (p, b, c)]
        elif n == 2:
            # The quadrilateral a p q c by its shorter diagonal.
            corners = [(p, b, q)]
            across = np.linalg.norm(vertices[a] - vertices[q], axis=1) < np.linalg.norm(
                vertices[p] - vertices[c], axis=1
            )
            corners += [
                (a, np.where(across, q, p), np.where(across, c, c)),
                (np.where(across, a, p), np.where(across, p, q), np.where(across, q, c)),
            ]
        else:
            corners = [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]
        pieces.extend(np.stack(corner, axis=1) for corner in corners)
    return vertices, np.vstack(pieces)


def _check_cloud(vertices: NDArray[np.float64], name: str) -> None:
    points = np.asarray(vertices, dtype=np.float64)
    if points.size == 0:
        raise MeshError(f"{name}: the file is empty: no vertices and no faces. Export it again.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"{name}: vertices: expected shape (V, 3), got {points.shape}.")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise MeshError(
            f"{name}: {int((~finite).sum())} points have NaN or infinite coordinates, the first is point "
            f"{int(np.argmin(finite))}. Remove them or export the file again."
        )


def _check_extent(vertices: NDArray[np.float64], faces: NDArray[np.int64], name: str) -> None:
    if len(faces) == 1:
        raise MeshError(f"{name}: a single triangle is no body. Check that the export is complete.")
    singular = np.linalg.svd(np.ptp(vertices[faces], axis=1).max(axis=0)[None], compute_uv=False)
    if singular[0] == 0:
        raise MeshError(f"{name}: all faces are in one point; a surface was expected. Check the file.")

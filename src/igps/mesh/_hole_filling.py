"""Patches for the small holes of a surface, bent so that it goes on smoothly."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from igps._arrays import Floats, Integers, Surface
from igps.mesh.surface import directed_edges, face_parts, undirected_edges

# A hole is small if a circle as long as its rim has at most this share of the area of its part of the surface.
_SMALL_HOLE = 0.03


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

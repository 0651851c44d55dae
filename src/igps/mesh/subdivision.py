"""More vertices on the same surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from igps.mesh._arrays import Floats, Integers, Surface
from igps.mesh.mesh import Mesh
from igps.mesh.surface import undirected_edges


def subdivided(mesh: Mesh, n_vertices: int) -> Mesh:
    """The same surface with at least `n_vertices` vertices: the longest edges are cut in their middles."""
    before = len(mesh.vertices)
    if before >= n_vertices:
        return mesh
    vertices, faces = mesh.vertices, mesh.faces
    while len(vertices) < n_vertices:
        edges, edge_of_side = undirected_edges(faces, len(vertices))
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        # Those not much shorter than the longest, so that they are cut in the order of their lengths.
        cut = np.argsort(-length, kind="stable")[: n_vertices - len(vertices)]
        vertices, faces = _cut(vertices, faces, edges, edge_of_side, cut[length[cut] > 0.7 * length.max()])
    note = f"subdivided from {before} to {len(vertices)} vertices"
    return replace(mesh, vertices=vertices, faces=faces, notes=(*mesh.notes, note))


def _cut(vertices: Floats, faces: Integers, edges: Integers, edge_of_side: Integers, cut: Integers) -> Surface:
    """New vertices in the middles of the edges `cut`, and every face with such edges cut accordingly."""
    middle = np.full(len(edges), -1)
    middle[cut] = len(vertices) + np.arange(len(cut))
    vertices = np.vstack([vertices, vertices[edges[cut]].mean(axis=1)])
    m = middle[edge_of_side].reshape(-1, 3)
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

"""Fewer triangles for the same body, or more vertices on the same surface."""

from dataclasses import replace

import numpy as np

from igps._arrays import Floats, Integers, Surface
from igps._parameters import check_at_least
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import longest_side, undirected_edges


def simplify(mesh: Mesh, max_vertices: int) -> Mesh:
    """The mesh with at most `max_vertices` vertices, by quadric edge collapse (Garland and Heckbert 1997).

    A mesh that is small enough is returned as it is. No collapse changes the topology (libigl's `qslim` checks each),
    so that a closed manifold stays one; the result is checked again like any mesh. A MeshError where `max_vertices`
    cannot be reached, or the simplified surface is not a body any more.
    """
    check_at_least(4, max_vertices=max_vertices)
    surplus = len(mesh.vertices) - max_vertices
    if surplus <= 0:
        return mesh
    import igl

    # In unit scale, because quadrics are sums of squares. A collapse on a closed surface takes a vertex and two faces.
    centre, scale = mesh.vertices.mean(axis=0), longest_side(mesh.vertices)
    points = np.asfortranarray((mesh.vertices - centre) / scale)
    points, faces, *_ = igl.qslim(points, np.asfortranarray(mesh.faces), max(len(mesh.faces) - 2 * surplus, 4))
    if len(points) > max_vertices:
        raise MeshError(
            f"{mesh.name}: could not be simplified to {max_vertices} vertices without changing its topology "
            f"({len(points)} were reached). Raise max_vertices."
        )
    note = f"simplified from {len(mesh.vertices)} to {len(points)} vertices"
    try:
        return replace(mesh, vertices=points * scale + centre, faces=faces, notes=(*mesh.notes, note))
    except MeshError as error:
        raise MeshError(f"{error} This came of simplifying to max_vertices={max_vertices}: raise it.") from error


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
    pieces = [faces[n_cut == 0]]
    for n in (1, 2, 3):
        f, k = faces[n_cut == n], m[n_cut == n]
        # Turned so that the cut sides come first.
        turn = np.argmax(k >= 0, axis=1) if n == 1 else (np.argmin(k >= 0, axis=1) + 1 if n == 2 else 0)
        order = (np.arange(3) + np.reshape(turn, (-1, 1))) % 3
        a, b, c = np.take_along_axis(f, np.broadcast_to(order, f.shape), axis=1).T
        p, q, r = np.take_along_axis(k, np.broadcast_to(order, k.shape), axis=1).T
        if n == 1:
            corners = [(a, p, c), (p, b, c)]
        elif n == 2:
            # The quadrilateral a p q c by its shorter diagonal.
            by_a = np.linalg.norm(vertices[a] - vertices[q], axis=1) < np.linalg.norm(vertices[p] - vertices[c], axis=1)
            corners = [(p, b, q), (a, np.where(by_a, q, p), c)]
            corners.append((np.where(by_a, a, p), np.where(by_a, p, q), np.where(by_a, q, c)))
        else:
            corners = [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]
        pieces.extend(np.stack(corner, axis=1) for corner in corners)
    return vertices, np.vstack(pieces)

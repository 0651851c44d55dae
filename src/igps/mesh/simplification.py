"""Simplify a mesh, or subdivide it."""

from dataclasses import replace

import numpy as np

from igps._arrays import Floats, Integers, Surface
from igps._parameters import check_at_least
from igps.mesh._collapse_loops import collapse_edges
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import edge_lengths, lengths, longest_side, undirected_edges


def simplify(mesh: Mesh, max_vertices: int) -> Mesh:
    """Simplify a mesh to at most `max_vertices` vertices, by quadric edge collapse (Garland and Heckbert 1997).

    A mesh that is small enough is returned unchanged. No collapse changes the topology, so a closed manifold stays
    closed. Open surfaces are simplified by libigl's `qslim`.

    Raises:
        MeshError: `max_vertices` cannot be reached, or the simplified surface bounds no body.
    """
    check_at_least(4, max_vertices=max_vertices)
    surplus = len(mesh.vertices) - max_vertices
    if surplus <= 0:
        return mesh
    if mesh.allow_open:
        vertices, faces = _simplified_open(mesh, surplus)
    else:
        vertices, faces = collapse_edges(mesh.vertices, mesh.faces, max_vertices)
    if len(vertices) > max_vertices:
        fault = f"{mesh.name}: simplification reached only {len(vertices)} vertices, expected {max_vertices}"
        raise MeshError(f"{fault}; fewer would change the topology. Raise max_vertices.")
    note = f"simplified from {len(mesh.vertices)} to {len(vertices)} vertices"
    try:
        return replace(mesh, vertices=vertices, faces=faces, notes=(*mesh.notes, note))
    except MeshError as error:
        raise MeshError(
            f"{error} Simplification caused this: raise max_vertices above {max_vertices}."
        ) from error


def _simplified_open(mesh: Mesh, surplus: int) -> Surface:
    """Collapse edges of a surface that may have a boundary, until `surplus` vertices fewer are left."""
    import igl

    centre = mesh.vertices.mean(axis=0)
    scale = longest_side(mesh.vertices)
    points = np.asfortranarray((mesh.vertices - centre) / scale)
    faces = np.asfortranarray(mesh.faces)
    # A collapse removes a vertex and two faces
    n_faces = max(len(faces) - 2 * surplus, 4)
    points, faces, *_ = igl.qslim(points, faces, n_faces)
    return points * scale + centre, faces


def subdivide(mesh: Mesh, n_vertices: int) -> Mesh:
    """Subdivide a mesh to at least `n_vertices` vertices on the same surface, by cutting the longest edges in half."""
    n_before = len(mesh.vertices)
    if n_before >= n_vertices:
        return mesh
    vertices = mesh.vertices
    faces = mesh.faces
    while len(vertices) < n_vertices:
        edges, edge_of_side = undirected_edges(faces)
        length = edge_lengths(vertices, edges)
        n_missing = n_vertices - len(vertices)
        longest = np.argsort(-length, kind="stable")[:n_missing]
        # A pass cuts only edges about as long as the longest, so that edges are cut in the order of their lengths.
        cut = longest[length[longest] > 0.7 * length.max()]
        middle = np.full(len(edges), -1)
        middle[cut] = len(vertices) + np.arange(len(cut))
        middles = vertices[edges[cut]].mean(axis=1)
        vertices = np.vstack([vertices, middles])
        faces = _cut(vertices, faces, middle[edge_of_side].reshape(-1, 3))
    note = f"subdivided from {n_before} to {len(vertices)} vertices"
    return replace(mesh, vertices=vertices, faces=faces, notes=(*mesh.notes, note))


def _cut(vertices: Floats, faces: Integers, middle: Integers) -> Integers:
    """Divide faces at the vertices in the middle of their sides (F, 3), each from a corner to the next; -1 for none."""
    n_cut = (middle >= 0).sum(axis=1)

    def rotated(n: int) -> tuple[Integers, ...]:
        """Return corners a, b, c and middles of ab, bc, ca of the faces with n cut sides, which come first."""
        chosen = n_cut == n
        is_cut = middle[chosen] >= 0
        first = np.argmin(is_cut, axis=1) + 1 if n == 2 else np.argmax(is_cut, axis=1)
        order = (np.arange(3) + first[:, None]) % 3
        corners = np.take_along_axis(faces[chosen], order, axis=1)
        middles = np.take_along_axis(middle[chosen], order, axis=1)
        return *corners.T, *middles.T

    a, b, c, p, _, _ = rotated(1)
    pieces = [(a, p, c), (p, b, c)]
    a, b, c, p, q, _ = rotated(2)
    # The quadrilateral a p q c is divided along its shorter diagonal.
    from_a = lengths(vertices[a] - vertices[q])
    from_p = lengths(vertices[p] - vertices[c])
    by_a = from_a < from_p
    second = (a, np.where(by_a, q, p), c)
    third = (np.where(by_a, a, p), np.where(by_a, p, q), np.where(by_a, q, c))
    pieces += [(p, b, q), second, third]
    a, b, c, p, q, r = rotated(3)
    pieces += [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]
    divided = [np.column_stack(corners) for corners in pieces]
    return np.vstack([faces[n_cut == 0], *divided])

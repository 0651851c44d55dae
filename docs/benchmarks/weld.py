"""Welds: a tube between two places of a body that face each other across a gap, as touching parts cause in scans."""

import heapq
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps.descriptors.literature.geodesics import edge_graph, farthest_points
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import vertex_normals
from igps.mesh.winding import winding_number

TUBE_FACES = 6
"""Number of faces of the tube, which are the last faces of the welded mesh."""

# Largest widths of gaps that are searched one after the other, as shares of the diagonal of the bounding box.
_GAPS = (1 / 64, 1 / 32, 1 / 16)
# Least path along the surface between places that count as far apart, as a share of the diagonal.
_FAR = 1 / 4
# Least cosine between the normal of a vertex and the direction to the vertex that it faces.
_MIN_COSINE = 0.5
_N_LANDMARKS = 32


def weld(mesh: Mesh, a: int, b: int) -> Mesh:
    """Join two places of a surface by a triangular tube, which adds one to its genus.

    One triangle at each of the two vertices is removed, and the sides of a prism, six triangles, join the two rims. The
    two triangles and the rotation of the prism are those that make the edges of the tube shortest.

    Args:
        mesh: the body.
        a, b: vertex indices.

    Returns:
        The mesh with the tube as its last `TUBE_FACES` faces; the vertices are the same.

    Raises:
        ValueError: a vertex does not exist, or no triangles at the two vertices are at least two edges apart.
    """
    for name, vertex in (("a", a), ("b", b)):
        if not 0 <= vertex < len(mesh.vertices):
            raise ValueError(
                f"{name}: expected a vertex index from 0 to {len(mesh.vertices) - 1}, got {vertex}."
            )
    neighbours = edge_graph(mesh)
    best: tuple[float, int, int, Integers] | None = None
    faces_b = np.nonzero((mesh.faces == b).any(axis=1))[0]
    for i in np.nonzero((mesh.faces == a).any(axis=1))[0]:
        rim = mesh.faces[i]
        beside = np.union1d(rim, neighbours[rim].indices)
        for j in faces_b:
            if np.isin(mesh.faces[j], beside).any():
                continue  # the tube would join an edge that already has two faces
            for turn in range(3):
                # Reversed, as the rims face each other
                other = mesh.faces[j][[turn, turn - 1, turn - 2]]
                length = float(
                    np.linalg.norm(mesh.vertices[rim] - mesh.vertices[other], axis=1).sum()
                )
                if best is None or length < best[0]:
                    best = length, int(i), int(j), other
    if best is None:
        raise ValueError(
            f"a, b: expected vertices of {mesh.name} that are more than three edges apart, got {a} and {b}. "
            "Take others, or subdivide the mesh."
        )
    length, first, second, q = best
    p = mesh.faces[first]
    tube = [[p[0], p[1], q[1]], [p[0], q[1], q[0]], [p[1], p[2], q[2]], [p[1], q[2], q[1]]]
    tube += [[p[2], p[0], q[0]], [p[2], q[0], q[2]]]
    gap = float(np.linalg.norm(mesh.vertices[a] - mesh.vertices[b]))
    note = (
        f"welded at vertices {a} and {b}, {gap:.3g} apart: triangles {first} and {second} replaced by the {TUBE_FACES} "
        f"faces of a triangular tube, mean length {length / 3:.3g}"
    )
    faces = np.vstack([np.delete(mesh.faces, [first, second], axis=0), tube])
    return replace(mesh, faces=faces, notes=(*mesh.notes, note))


def facing_vertices(mesh: Mesh) -> tuple[int, int]:
    """Find two vertices that face each other across a narrow gap outside the body, but are far apart on its surface.

    Among pairs at most 1/64 of the diagonal of the bounding box apart, whose shortest path along edges is at least a
    quarter of the diagonal, the pair with the largest ratio of path to gap is chosen. If there is none, gaps of 1/32
    and 1/16 are tried. If there is still none, the pair with the longest path among those at most 1/16 apart is chosen.

    Raises:
        MeshError: no two vertices face each other across a gap, as on convex bodies.
    """
    search = _GapSearch(mesh)
    for gap in _GAPS:
        for a, b in search.pairs(gap * mesh.diagonal, least_path=_FAR * mesh.diagonal):
            if search.is_clear(a, b):
                return a, b
    for a, b in search.pairs(_GAPS[-1] * mesh.diagonal):
        if search.is_clear(a, b):
            return a, b
    raise MeshError(
        f"{mesh.name}: no two places face each other across a gap of at most {_GAPS[-1]:.2g} of the diagonal. "
        "Name the two vertices to be welded."
    )


def weld_gap(mesh: Mesh) -> Mesh:
    """Weld a mesh at its `facing_vertices`."""
    return weld(mesh, *facing_vertices(mesh))


class _GapSearch:
    """Search for pairs of vertices that face each other, the best first."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._graph = edge_graph(mesh)
        self._tree = cKDTree(mesh.vertices)
        self._normals = vertex_normals(mesh.vertices, mesh.faces)
        self._landmarks = farthest_points(
            mesh, min(_N_LANDMARKS, len(mesh.vertices)), points_per_edge=0
        ).distances

    def pairs(
        self, largest_gap: float, least_path: float | None = None
    ) -> Iterator[tuple[int, int]]:
        """Yield the pairs at most `largest_gap` apart, in descending order of the shortest path along edges.

        With `least_path`, yield only pairs whose path is at least as long, in descending order of path over gap.
        """
        pair, gap = self._facing(largest_gap)
        # A path over a landmark is an upper bound of the shortest path, so that few exact paths are needed
        upper = (self._landmarks[:, pair[:, 0]] + self._landmarks[:, pair[:, 1]]).min(axis=0)
        far = upper >= (least_path or 0)
        pair = pair[far]
        gap = gap[far]
        upper = upper[far]
        unit = np.ones(len(pair)) if least_path is None else gap
        queue = [(-bound, i, False) for i, bound in enumerate((upper / unit).tolist())]
        heapq.heapify(queue)
        of_source: dict[int, list[int]] = {}
        for i, a in enumerate(pair[:, 0].tolist()):
            of_source.setdefault(a, []).append(i)
        while queue:
            _, i, is_exact = heapq.heappop(queue)
            a, b = pair[i].tolist()
            if is_exact:
                yield a, b
            elif (
                a in of_source
            ):  # otherwise the queue holds the pairs of this vertex with their exact paths
                path = dijkstra(self._graph, indices=a)
                for k in of_source.pop(a):
                    length = float(path[pair[k, 1]])
                    if length >= (least_path or 0):
                        heapq.heappush(queue, (-length / float(unit[k]), k, True))

    def is_clear(self, a: int, b: int) -> bool:
        """Return whether the straight line between two vertices lies outside the body."""
        along = np.array([[0.25], [0.5], [0.75]])
        points = (1 - along) * self._mesh.vertices[a] + along * self._mesh.vertices[b]
        return bool((winding_number(self._mesh.vertices, self._mesh.faces, points) < 0.5).all())

    def _facing(self, largest_gap: float) -> tuple[Integers, Floats]:
        pair = (
            self._tree.query_pairs(largest_gap, output_type="ndarray")
            .astype(np.int64)
            .reshape(-1, 2)
        )
        step = self._mesh.vertices[pair[:, 1]] - self._mesh.vertices[pair[:, 0]]
        gap = np.linalg.norm(step, axis=1)
        cosines = [
            np.einsum("ij,ij->i", sign * self._normals[pair[:, k]], step)
            for k, sign in ((0, 1), (1, -1))
        ]
        # A gap of zero width is a defect of the mesh, which no tube can bridge
        is_facing = (np.minimum(*cosines) > _MIN_COSINE * gap) & (gap > 1e-6 * largest_gap)
        return pair[is_facing], gap[is_facing]

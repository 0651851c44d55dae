"""Geodesic distances on a triangle mesh, and farthest-point sampling.

A geodesic distance is the length of the shortest path in a graph of the vertices and of points on the edges (Lanthier,
Maheshwari and Sack 1997; Dijkstra 1959, by SciPy). Paths may cross a triangle from side to side. These lengths are a
metric: symmetric, with the triangle inequality, and never below the exact distance on the polyhedron. Unlike the heat
method and fast marching, they do not need well-shaped triangles.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from igps._arrays import Floats, Integers
from igps._parameters import check_at_least
from igps.mesh.mesh import Mesh
from igps.mesh.simplification import simplify
from igps.mesh.surface import undirected_edges
from igps.signature.ordering import in_canonical_order, spatial_ordering_keys

_TIE_TOLERANCE = 1e-9  # relative; distances that differ by less are equal except for rounding


@dataclass(frozen=True, eq=False)
class FarthestPoints:
    """Sampled vertices (S,) in sampling order, and their geodesic distances (S, V) to all vertices."""

    vertices: Integers
    distances: Floats

    @property
    def mutual(self) -> Floats:
        """(S, S) distances between the samples, exactly symmetric, in units of length."""
        between = self.distances[:, self.vertices]
        return (between + between.T) / 2  # the rounding error depends on the direction of the path


def geodesic_samples(mesh: Mesh, n_samples: int, max_vertices: int) -> FarthestPoints:
    """Return the `farthest_points` of a simplified mesh, independent of the order of its vertices and faces.

    Raises:
        ValueError: the mesh has fewer vertices than `n_samples`.
        MeshError: the mesh cannot be simplified.
    """
    simplified = simplify(in_canonical_order(mesh), max_vertices)
    return farthest_points(simplified, n_samples)


def farthest_points(mesh: Mesh, n_samples: int, points_per_edge: int = 2) -> FarthestPoints:
    """Sample vertices by farthest-point sampling (Eldar, Lindenbaum, Porat and Zeevi 1997).

    Each sample is the vertex that is farthest from all samples before it. The first sample is an end of a long
    geodesic: the search starts at the vertex with the largest of the `spatial_ordering_keys` and moves to the farthest
    vertex, twice. Among equally far vertices, the least sum of distances to the samples decides, then the largest key.
    So the result does not depend on the order of the vertices.

    A ValueError is raised if there are fewer vertices than `n_samples`. For `points_per_edge` see `edge_graph`.
    """
    n_vertices = len(mesh.vertices)
    if not 1 <= n_samples <= n_vertices:
        raise ValueError(
            f"n_samples: expected 1 to {n_vertices}, the number of vertices of {mesh.name}, got {n_samples}. "
            "Lower it, or subdivide the mesh."
        )
    graph = edge_graph(mesh, points_per_edge)

    def from_vertex(vertex: int) -> Floats:
        return dijkstra(graph, indices=vertex)[:n_vertices]

    def farthest(distance: Floats, total: Floats) -> int:
        least = (1 - _TIE_TOLERANCE) * distance.max()
        tied = np.flatnonzero(distance >= least)
        sums = total[tied]
        most = (1 + _TIE_TOLERANCE) * sums.min()
        tied = tied[sums <= most]
        best = np.argmax(keys[tied])
        return int(tied[best])

    keys = spatial_ordering_keys(mesh)
    first = int(np.argmax(keys))
    for _ in range(2):
        distance = from_vertex(first)
        first = farthest(distance, distance)
    samples = [first]
    distances = np.empty((n_samples, n_vertices))
    distances[0] = from_vertex(first)
    nearest = distances[0].copy()
    total = distances[0].copy()
    for i in range(1, n_samples):
        samples.append(farthest(nearest, total))
        distances[i] = from_vertex(samples[i])
        nearest = np.minimum(nearest, distances[i])
        total += distances[i]
    return FarthestPoints(np.array(samples, dtype=np.int64), distances)


def edge_graph(mesh: Mesh, points_per_edge: int = 0) -> sparse.csr_array:
    """Symmetric graph whose nodes are the vertices, then equally spaced points of every edge; its weights are lengths.

    Shortest paths are never shorter than the exact distances on the polyhedron. With two points per edge, they are
    1 to 2 % too long on average, and too long by at most 5 % of the largest distance. With three points, these errors
    are 1.4 % and 4 %; without points, in the graph of the edges, 7 % and 12 %. The errors were measured against exact
    distances (Mitchell, Mount and Papadimitriou 1987) on five SHREC'07 models of 1,000 vertices.
    """
    check_at_least(0, points_per_edge=points_per_edge)
    n = points_per_edge
    n_vertices = len(mesh.vertices)
    n_faces = len(mesh.faces)
    # Side i of a face runs from corner i to corner i + 1.
    edges, edge_of = undirected_edges(mesh.faces)
    shares = np.arange(1, n + 1) / (n + 1)
    share = shares[None, :, None]
    first = mesh.vertices[edges[:, :1]]
    last = mesh.vertices[edges[:, 1:]]
    between = (1 - share) * first + share * last
    positions = np.concatenate([mesh.vertices, between.reshape(-1, 3)])
    on_edge = n_vertices + np.arange(len(edges) * n).reshape(len(edges), n)
    # Along every edge, from vertex to vertex.
    chain = np.concatenate([edges[:, :1], on_edge, edges[:, 1:]], axis=1)
    tails = [chain[:, :-1].ravel()]
    heads = [chain[:, 1:].ravel()]
    # Across every face: from the points of a side to those of the next side, and to the corner opposite.
    on_side = on_edge[edge_of.reshape(n_faces, 3)]
    for i in range(3):
        side = on_side[:, i]
        next_side = on_side[:, (i + 1) % 3]
        opposite = mesh.faces[:, (i + 2) % 3]
        tails.append(np.repeat(side, n, axis=1).ravel())
        heads.append(np.tile(next_side, (1, n)).ravel())
        tails.append(np.repeat(opposite, n))
        heads.append(side.ravel())
    # SciPy's shortest paths accept no 64-bit indices up to version 1.14.
    tail = np.concatenate(tails).astype(np.int32)
    head = np.concatenate(heads).astype(np.int32)
    length = np.linalg.norm(positions[tail] - positions[head], axis=1)
    rows = np.concatenate([tail, head])
    columns = np.concatenate([head, tail])
    lengths = np.concatenate([length, length])
    shape = (len(positions), len(positions))
    return sparse.csr_array(sparse.coo_array((lengths, (rows, columns)), shape=shape))

"""Functions of the arrays of a triangle surface: edges, components, areas, normals. The arrays are not checked."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from igps._arrays import Booleans, Floats, Integers, Surface

TINY = float(np.finfo(float).tiny)  # the smallest divisor that is as precise as others
_FLAT = 2.0**-26  # triangles of at most this height over length are flat up to rounding errors


def area_vectors(vertices: Floats, faces: Integers) -> Floats:
    """Return the unit normal of each face times its area: (F, 3), length²."""
    a = vertices[faces[:, 0]]
    b = vertices[faces[:, 1]]
    c = vertices[faces[:, 2]]
    return np.cross(b - a, c - a) / 2


def face_areas(vertices: Floats, faces: Integers) -> Floats:
    """Return the areas (F,), length²."""
    return lengths(area_vectors(vertices, faces))


def vertex_areas(vertices: Floats, faces: Integers) -> Floats:
    """Return a third of the area of the faces around each vertex: (V,), length²."""
    thirds = face_areas(vertices, faces) / 3
    at_corners = np.repeat(thirds, 3)
    areas = np.bincount(faces.ravel(), at_corners, len(vertices))
    return np.asarray(areas, dtype=np.float64)


def vertex_normals(vertices: Floats, faces: Integers) -> Floats:
    """Return the outward unit normals (V, 3) of the vertices: means of the face normals, weighted by area."""
    at_corners = np.repeat(area_vectors(vertices, faces), 3, axis=0)
    around = sums(faces.ravel(), at_corners, len(vertices))
    return unit(around)


def sums(index: Integers, rows: Floats, n: int) -> Floats:
    """Return the sums (n, D) of the rows (R, D) with each index (R,)."""
    columns = [np.bincount(index, column, n) for column in rows.T]
    return np.column_stack(columns)


def lengths(vectors: NDArray[np.floating]) -> Floats:
    """Return the lengths (N,) of vectors (N, D)."""
    return np.linalg.norm(vectors, axis=1)


def dots(first: Floats, second: Floats) -> Floats:
    """Return the products (N,) of vectors (N, 3) with others."""
    return np.einsum("ij,ij->i", first, second)


def edge_lengths(vertices: Floats, edges: Integers) -> Floats:
    """Return the lengths (E,) of edges (E, 2)."""
    start, end = edges.T
    return lengths(vertices[end] - vertices[start])


def mean_of_neighbours(vertices: Floats, faces: Integers) -> Floats:
    """Return the mean (V, 3) of each vertex's neighbours, weighted by inverse squared distance, length."""
    n = len(vertices)
    edges, _ = undirected_edges(faces)
    squares = np.square(edge_lengths(vertices, edges))
    # Coincident vertices get a large weight, without a division by zero.
    weights = 1 / np.maximum(squares, 1e-12 * squares.mean())
    total = np.zeros(n)
    mean = np.zeros_like(vertices)
    start, end = edges.T
    for here, there in ((start, end), (end, start)):
        weighted = weights[:, None] * vertices[there]
        total += np.bincount(here, weights, n)
        mean += sums(here, weighted, n)
    return mean / total[:, None]


def unit(vectors: Floats) -> Floats:
    """Return the vectors (N, 3) scaled to length 1; zero vectors stay zero."""
    divisors = np.maximum(lengths(vectors), TINY)
    return vectors / divisors[:, None]


def box_sides(points: Floats) -> Floats:
    """Return the sides (3,) of the bounding box of points (N, 3), length."""
    # NumPy takes a thirtieth of the time for contiguous coordinates.
    coordinates = np.ascontiguousarray(points.T)
    return np.asarray(np.ptp(coordinates, axis=1))


def longest_side(points: Floats) -> float:
    """Return the longest side of the bounding box of points (N, 3), length."""
    return float(box_sides(points).max())


def diagonal(vertices: Floats) -> float:
    """Return the diagonal of the bounding box, length."""
    return float(np.linalg.norm(box_sides(vertices)))


def directed_edges(faces: Integers) -> tuple[Integers, Integers]:
    """Return the first and the second vertex of every side of every face: (3F,) each, face by face."""
    following = np.roll(faces, -1, axis=1)
    return faces.ravel(), following.ravel()


def undirected_edges(faces: Integers) -> tuple[Integers, Integers]:
    """Return the edges (E, 2) in ascending order, the smaller vertex first, and the edge (3F,) of every side."""
    n_vertices = int(faces.max(initial=-1)) + 1
    start, end = directed_edges(faces)
    keys = edge_keys(start, end, n_vertices)
    distinct, edge_of = np.unique(keys, return_inverse=True)
    edges = np.column_stack(np.divmod(distinct, n_vertices))
    return edges, edge_of


def has_twins(faces: Integers) -> Booleans:
    """Return which faces (F,) have the same vertex twice."""
    is_twin = faces == np.roll(faces, 1, axis=1)
    return np.asarray(is_twin.any(axis=1))


def both_ways(edges: Integers) -> tuple[Integers, Integers]:
    """Return the first and the second vertex of edges (E, 2), and of the same edges reversed: (2E,) each."""
    start, end = edges.T
    return np.concatenate([start, end]), np.concatenate([end, start])


def edge_keys(start: Integers, end: Integers, n_vertices: int) -> Integers:
    """Return a number (E,) for each edge, the same in both directions, by which edges sort by their vertices."""
    return np.minimum(start, end) * n_vertices + np.maximum(start, end)


def faces_at_sides(faces: Integers) -> Integers:
    """Return the number (F, 3) of faces that share the side from each corner to the next."""
    _, edge_of = undirected_edges(faces)
    n_faces = np.bincount(edge_of)
    return np.asarray(n_faces[edge_of].reshape(-1, 3))


def components(faces: Integers, n_vertices: int) -> tuple[int, NDArray[np.int32]]:
    """Return the number of connected components, and the component (V,) of each vertex, from 0."""
    start, end = directed_edges(faces)
    return linked(start, end, n_vertices)


def linked(start: Integers, end: Integers, n: int) -> tuple[int, NDArray[np.int32]]:
    """Return the number of groups that links from start to end make of n items, and the group (n,) of each, from 0."""
    ones = np.ones(len(start), dtype=np.int8)
    graph = sparse.coo_array((ones, (start, end)), shape=(n, n))
    count, group = connected_components(graph, directed=False)
    return int(count), group


def face_parts(vertices: Floats, faces: Integers) -> tuple[Integers, Floats]:
    """Return the connected component (F,) of each face, from 0, and the areas of the components, length²."""
    _, component = components(faces, len(vertices))
    of_face = component[faces[:, 0]]
    _, part = np.unique(of_face, return_inverse=True)
    areas = np.bincount(part, weights=face_areas(vertices, faces))
    return part, np.asarray(areas, dtype=np.float64)


def signed_volume(vertices: Floats, faces: Integers) -> float:
    """Return the enclosed volume, length³, negative if inside out; for an open surface, of its cone over the centre."""
    centred = vertices - vertices.mean(axis=0)
    bases = area_vectors(centred, faces)
    corners = centred[faces[:, 0]]
    return float(np.einsum("ij,ij->", corners, bases) / 3)


def compact(vertices: Floats, faces: Integers) -> Surface:
    """Drop the vertices that no face uses; the others keep their order."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def connected(vertices: Floats, faces: Integers) -> list[Surface]:
    """Return the connected components as surfaces, in the order of their first vertices."""
    count, component = components(faces, len(vertices))
    part = component[faces[:, 0]]
    return [compact(vertices, faces[part == k]) for k in range(count)]


def largest(vertices: Floats, faces: Integers) -> Surface:
    """Return the connected component of the largest volume."""
    surfaces = connected(*compact(vertices, faces))
    return max(surfaces, key=lambda surface: abs(signed_volume(*surface)))


def stacked(surfaces: Sequence[Surface]) -> Surface:
    """Concatenate several surfaces to one."""
    all_vertices = []
    all_faces = []
    n_before = 0
    for vertices, faces in surfaces:
        all_vertices.append(vertices)
        all_faces.append(faces + n_before)
        n_before += len(vertices)
    return np.concatenate(all_vertices), np.concatenate(all_faces)


def has_area(corners: Floats, flat: float = _FLAT) -> Booleans:
    """Return whether triangles with corners (F, 3, 3) have more than a height of `flat` over their longest side."""
    sides = corners - np.roll(corners, 1, axis=1)
    squares = np.square(sides).sum(axis=2)
    normals = np.cross(sides[:, 0], sides[:, 1])
    return np.asarray(lengths(normals) > flat * squares.max(axis=1))

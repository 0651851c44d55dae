"""Functions of the arrays of a triangle surface: edges, components, areas, normals. The arrays are not checked."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from igps._arrays import Booleans, Floats, Integers, Surface

_FLAT = 2.0**-26  # triangles of at most this height over length count as flat


def area_vectors(vertices: Floats, faces: Integers) -> Floats:
    """Return the unit normal of each face times its area: (F, 3), length²."""
    a = vertices[faces[:, 0]]
    b = vertices[faces[:, 1]]
    c = vertices[faces[:, 2]]
    return np.cross(b - a, c - a) / 2


def face_areas(vertices: Floats, faces: Integers) -> Floats:
    """Return the areas (F,), length²."""
    return np.linalg.norm(area_vectors(vertices, faces), axis=1)


def vertex_areas(vertices: Floats, faces: Integers) -> Floats:
    """Return a third of the area of the faces around each vertex: (V,), length²."""
    third = np.repeat(face_areas(vertices, faces) / 3, 3)
    areas = np.bincount(faces.ravel(), third, len(vertices))
    return np.asarray(areas, dtype=np.float64)


def vertex_normals(vertices: Floats, faces: Integers) -> Floats:
    """Return the outward unit normals (V, 3) of the vertices: means of the face normals, weighted by area."""
    at_corners = np.repeat(area_vectors(vertices, faces), 3, axis=0)
    return unit(sums(faces.ravel(), at_corners, len(vertices)))


def sums(index: Integers, rows: Floats, n: int) -> Floats:
    """Return the sums (n, D) of the rows (R, D) with each index (R,)."""
    columns = [np.bincount(index, column, n) for column in rows.T]
    return np.stack(columns, axis=1)


def dots(first: Floats, second: Floats) -> Floats:
    """Return the products (N,) of vectors (N, 3) with others."""
    return np.einsum("ij,ij->i", first, second)


def edge_lengths(vertices: Floats, edges: Integers) -> Floats:
    """Return the lengths (E,) of edges (E, 2)."""
    start = vertices[edges[:, 0]]
    end = vertices[edges[:, 1]]
    return np.linalg.norm(end - start, axis=1)


def mean_of_neighbours(vertices: Floats, faces: Integers) -> Floats:
    """Return the mean (V, 3) of each vertex's neighbours, weighted by inverse squared distance, length."""
    ends = undirected_edges(faces, len(vertices))[0]
    squares = np.square(edge_lengths(vertices, ends))
    # Coincident vertices get a large weight, without a division by zero.
    weights = 1 / np.maximum(squares, 1e-12 * squares.mean())
    total = np.zeros(len(vertices))
    mean = np.zeros_like(vertices)
    for here, there in (ends.T, ends.T[::-1]):
        total += np.bincount(here, weights, len(vertices))
        mean += sums(here, weights[:, None] * vertices[there], len(vertices))
    return mean / total[:, None]


def unit(vectors: Floats) -> Floats:
    """Return the vectors (N, 3) scaled to length 1; zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(lengths, np.finfo(float).tiny)


def box_sides(points: Floats) -> Floats:
    """Return the sides (3,) of the bounding box of points (N, 3), length."""
    # With contiguous columns NumPy takes a thirtieth of the time.
    return np.asarray(np.ptp(np.ascontiguousarray(points.T), axis=1))


def longest_side(points: Floats) -> float:
    """Return the longest side of the bounding box of points (N, 3), length."""
    return float(box_sides(points).max())


def diagonal(vertices: Floats) -> float:
    """Return the diagonal of the bounding box, length."""
    return float(np.linalg.norm(box_sides(vertices)))


def directed_edges(faces: Integers) -> tuple[Integers, Integers]:
    """Return the first and the second vertex of every side of every face: (3F,) each, face by face."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def undirected_edges(faces: Integers, n_vertices: int) -> tuple[Integers, Integers]:
    """Return the edges (E, 2) in ascending order, the smaller vertex first, and the edge (3F,) of every side."""
    start, end = directed_edges(faces)
    key_of_side = np.minimum(start, end) * n_vertices + np.maximum(start, end)
    keys, edge_of = np.unique(key_of_side, return_inverse=True)
    edges = np.stack([keys // n_vertices, keys % n_vertices], axis=1)
    return edges, edge_of


def components(faces: Integers, n_vertices: int) -> tuple[int, NDArray[np.int32]]:
    """Return the number of connected components, and the component (V,) of each vertex, from 0."""
    start, end = directed_edges(faces)
    ones = np.ones(len(start), dtype=np.int8)
    graph = sparse.coo_array((ones, (start, end)), shape=(n_vertices, n_vertices))
    count, label = connected_components(graph, directed=False)
    return int(count), label


def face_parts(vertices: Floats, faces: Integers) -> tuple[Integers, Floats]:
    """Return the connected component (F,) of each face, from 0, and the areas of the components, length²."""
    _, component = components(faces, len(vertices))
    _, part = np.unique(component[faces[:, 0]], return_inverse=True)
    areas = np.bincount(part, weights=face_areas(vertices, faces))
    return part.astype(np.int64), np.asarray(areas, dtype=np.float64)


def signed_volume(vertices: Floats, faces: Integers) -> float:
    """Return the enclosed volume, length³, negative if inside out; for an open surface, of its cone over the centre."""
    centred = vertices - vertices.mean(axis=0)
    bases = area_vectors(centred, faces)
    return float(np.einsum("ij,ij->", centred[faces[:, 0]], bases) / 3)


def compact(vertices: Floats, faces: Integers) -> Surface:
    """Drop the vertices that no face uses; the others keep their order."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def connected(vertices: Floats, faces: Integers) -> list[Surface]:
    """Return the connected components as surfaces, in the order of their first vertices."""
    count, component = components(faces, len(vertices))
    of_face = component[faces[:, 0]]
    return [compact(vertices, faces[of_face == k]) for k in range(count)]


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


def has_area(corners: Floats) -> Booleans:
    """Return whether triangles with corners (F, 3, 3) have an area, beyond rounding errors: (F,)."""
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1)
    normals = np.cross(sides[:, 0], sides[:, 1])
    double_areas = np.linalg.norm(normals, axis=1)
    return np.asarray(double_areas > _FLAT * longest)

"""What the arrays of a triangle surface say: edges, components, areas, normals. They are not checked here."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from igps._arrays import Booleans, Floats, Integers, Surface

_FLAT = 2.0**-26  # height over length of a triangle that counts as flat


def area_vectors(vertices: Floats, faces: Integers) -> Floats:
    """Normal of each face times its area: (F, 3), length²."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a) / 2


def face_areas(vertices: Floats, faces: Integers) -> Floats:
    """(F,) areas, length²."""
    return np.linalg.norm(area_vectors(vertices, faces), axis=1)


def vertex_areas(vertices: Floats, faces: Integers) -> Floats:
    """(V,) a third of the areas of the faces around each vertex, length²."""
    third = np.repeat(face_areas(vertices, faces) / 3, 3)
    return np.asarray(np.bincount(faces.ravel(), third, len(vertices)), dtype=np.float64)


def vertex_normals(vertices: Floats, faces: Integers) -> Floats:
    """(V, 3) outward unit normals of the vertices, means of those of their faces weighted by area."""
    return unit(sums(faces.ravel(), np.repeat(area_vectors(vertices, faces), 3, axis=0), len(vertices)))


def sums(index: Integers, rows: Floats, n: int) -> Floats:
    """(n, D) sums of those rows (R, D) that have each index (R,)."""
    return np.stack([np.bincount(index, column, n) for column in rows.T], axis=1)


def mean_of_neighbours(vertices: Floats, faces: Integers) -> Floats:
    """(V, 3) length, the mean of each vertex's neighbours, each by the inverse square of its distance."""
    ends = undirected_edges(faces, len(vertices))[0]
    squares = np.square(vertices[ends[:, 0]] - vertices[ends[:, 1]]).sum(axis=1)
    # Vertices in one place: nearer than any other, and no division by zero.
    weights = 1 / np.maximum(squares, 1e-12 * squares.mean())
    total, mean = np.zeros(len(vertices)), np.zeros_like(vertices)
    for here, there in (ends.T, ends.T[::-1]):
        total += np.bincount(here, weights, len(vertices))
        mean += sums(here, weights[:, None] * vertices[there], len(vertices))
    return mean / total[:, None]


def unit(vectors: Floats) -> Floats:
    """(N, 3) vectors of length 1 in the same directions; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)


def box_sides(points: Floats) -> Floats:
    """(3,) sides of the bounding box of points (N, 3), length."""
    # By columns that lie side by side NumPy takes a thirtieth of the time.
    return np.asarray(np.ptp(np.ascontiguousarray(points.T), axis=1))


def longest_side(points: Floats) -> float:
    """The longest side of the bounding box of points (N, 3), length."""
    return float(box_sides(points).max())


def diagonal(vertices: Floats) -> float:
    """Length of the diagonal of the bounding box."""
    return float(np.linalg.norm(box_sides(vertices)))


def directed_edges(faces: Integers) -> tuple[Integers, Integers]:
    """First and second vertex of every side of every face: (3F,) each, face by face."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def undirected_edges(faces: Integers, n_vertices: int) -> tuple[Integers, Integers]:
    """The edges in ascending order, (E, 2) with the smaller vertex first; and (3F,) the edge of every side."""
    start, end = directed_edges(faces)
    keys, edge_of = np.unique(np.minimum(start, end) * n_vertices + np.maximum(start, end), return_inverse=True)
    return np.stack([keys // n_vertices, keys % n_vertices], axis=1), edge_of


def components(faces: Integers, n_vertices: int) -> tuple[int, NDArray[np.int32]]:
    """Number of connected components, and the number of each vertex's, (V,)."""
    start, end = directed_edges(faces)
    graph = sparse.coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(n_vertices, n_vertices))
    count, label = connected_components(graph, directed=False)
    return int(count), label


def face_parts(vertices: Floats, faces: Integers) -> tuple[Integers, Floats]:
    """The connected part of each face, (F,) counted from zero, and the areas of the parts, length²."""
    part = np.unique(components(faces, len(vertices))[1][faces[:, 0]], return_inverse=True)[1]
    areas = np.bincount(part, weights=face_areas(vertices, faces))
    return part.astype(np.int64), np.asarray(areas, dtype=np.float64)


def face_patches(faces: Integers, n_vertices: int) -> tuple[Integers, Booleans]:
    """The patch of each face, (F,) counted from zero, and which patches (P,) end only where two other faces meet.

    Faces are of one patch that share an edge with each other alone.
    """
    _, edge_of_side = undirected_edges(faces, n_vertices)
    by_edge = np.argsort(edge_of_side, kind="stable")
    count = np.bincount(edge_of_side)
    at = (np.cumsum(count) - count)[count == 2]
    one, two = by_edge[at] // 3, by_edge[at + 1] // 3
    graph = sparse.coo_array((np.ones(len(one), dtype=np.int8), (one, two)), shape=(len(faces), len(faces)))
    n_patches, patch = connected_components(graph, directed=False)
    # An edge where the patch itself has more than one face is no end of it that others could take over.
    ends, n_own = np.unique(np.stack([np.repeat(patch, 3), edge_of_side]), axis=1, return_counts=True)
    patch_at, n_at = ends[0], count[ends[1]]
    n_free = np.bincount(patch_at, (n_at - n_own < 2) & (n_at != 2), n_patches)
    return patch.astype(np.int64), (n_free == 0) & (np.bincount(patch_at, n_at > 2, n_patches) > 0)


def signed_volume(vertices: Floats, faces: Integers) -> float:
    """Enclosed volume, length³, negative inside out (of an open surface: of its cone over the vertices' centre)."""
    centred = vertices - vertices.mean(axis=0)
    return float(np.einsum("ij,ij->", centred[faces[:, 0]], area_vectors(centred, faces)) / 3)


def compact(vertices: Floats, faces: Integers) -> Surface:
    """The vertices that faces use, in their order, and the faces that use them."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def connected(vertices: Floats, faces: Integers) -> list[Surface]:
    """The connected components, each by itself, in the order of their first vertices."""
    count, owner = components(faces, len(vertices))
    return [compact(vertices, faces[owner[faces[:, 0]] == k]) for k in range(count)]


def largest(vertices: Floats, faces: Integers) -> Surface:
    """The connected component of the largest volume."""
    return max(connected(*compact(vertices, faces)), key=lambda surface: abs(signed_volume(*surface)))


def stacked(surfaces: Sequence[Surface]) -> Surface:
    """Several surfaces as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    faces = [faces + start for (_, faces), start in zip(surfaces, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(faces)


def has_area(corners: Floats) -> Booleans:
    """(F,) whether triangles of corners (F, 3, 3) are more than lines: their height is not lost beside their length."""
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1)
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > _FLAT * longest)

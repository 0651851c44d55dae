"""Whether a surface is rough with noise, and the surface without it.

Noise of a scanner moves neighbouring vertices independently, shape does not: what is left of a vertex's height over its
neighbours when their mean height is taken off is small on a shape, and neighbours have it in common; on noise it is
large, and neighbours have it in opposite directions more often than not. Only where both are so on most of the surface
is anything changed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from igps.geometry.surface import undirected_edges, vertex_normals

# The lower quartile of that remainder over the mean length of a vertex's edges: up to 0.014 on generated shapes, 0.038
# to 0.092 with noise of 0.2 % of the diagonal. The quartile, because noise is everywhere and details are not.
_ROUGH = 0.035
# The share of edges on whose ends it has the same sign: from 0.51 to 0.57 on those shapes, 0.40 to 0.42 with noise.
_IN_COMMON = 0.43
# What is rough with fewer vertices was made so; and what hardly is a surface has no normals to speak of.
_FEWEST, _REGULAR = 2000, 0.97
# Taubin's two steps and their number: the area of generated shapes with that noise comes back to within 0.6 % of the
# clean one's (median), their volume to within 0.5 %.
_SHRINK, _GROW, _PASSES = 0.5, -0.53, 10


def is_noisy(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> bool:
    """Whether most of a surface is rough with noise that neighbouring vertices do not share.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) welded and turned alike.
    """
    if len(vertices) < _FEWEST:
        return False
    edges, averaging, length = _neighbours(vertices, faces)
    if (_faces_at_sides(faces, len(vertices)) == 2).mean() < _REGULAR:
        return False
    # Of the averaged surface: where noise is larger than the triangles, theirs say nothing.
    normals = vertex_normals(averaging @ (averaging @ vertices), faces)
    rough, in_common = _statistics(vertices, normals, edges, averaging, length)
    return rough > _ROUGH and in_common < _IN_COMMON


def _statistics(
    vertices: NDArray[np.float64],
    normals: NDArray[np.float64],
    edges: NDArray[np.int64],
    averaging: sparse.csr_array,
    length: NDArray[np.float64],
) -> tuple[float, float]:
    """The lower quartile of the remainder over the edges' lengths, and the share of edges with one sign at the ends."""
    height = np.einsum("ij,ij->i", vertices - averaging @ vertices, normals)
    rest = (height - averaging @ height) / np.maximum(length, np.finfo(float).tiny)
    return float(np.quantile(np.abs(rest), 0.25)), float((rest[edges[:, 0]] * rest[edges[:, 1]] > 0).mean())


def denoised(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """(V, 3) vertices of a smoother surface of the same size, by Taubin's λ|μ passes (1995).

    Vertices on boundaries stay where they are.
    """
    _, averaging, _ = _neighbours(vertices, faces)
    free = np.ones((len(vertices), 1))
    alone = _faces_at_sides(faces, len(vertices)) == 1
    free[faces[alone]] = 0
    free[np.roll(faces, -1, axis=1)[alone]] = 0
    for _ in range(_PASSES):
        for step in (_SHRINK, _GROW):
            vertices = vertices + step * free * (averaging @ vertices - vertices)
    return vertices


def _faces_at_sides(faces: NDArray[np.int64], n_vertices: int) -> NDArray[np.int64]:
    """(F, 3) how many faces share the side from each corner to the next."""
    _, edge_of = undirected_edges(faces, n_vertices)
    return np.asarray(np.bincount(edge_of)[edge_of].reshape(-1, 3))


def _neighbours(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.int64], sparse.csr_array, NDArray[np.float64]]:
    """(E, 2) edges, the matrix that averages over neighbours, and the mean length of each vertex's edges."""
    n = len(vertices)
    edges, _ = undirected_edges(faces, n)
    rows, columns = edges.T.ravel(), edges[:, ::-1].T.ravel()
    degree = np.maximum(np.bincount(rows, minlength=n), 1)
    averaging = sparse.csr_array((1 / degree[rows], (rows, columns)), shape=(n, n))
    length = np.tile(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 2)
    return edges, averaging, np.bincount(rows, weights=length, minlength=n) / degree

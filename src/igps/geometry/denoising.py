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

# The lower quartile of that remainder over the mean length of a vertex's edges: up to 0.014 on generated shapes of more
# than 2,000 vertices and up to 0.028 on those of 1,000 to 2,000, 0.034 to 0.092 with noise of 0.2 % of the diagonal,
# but for thick bodies of few triangles, which it hardly changes. The quartile, because noise is everywhere and details
# are not.
_ROUGH = 0.035
# The share of edges on whose ends it has the same sign: from 0.50 to 0.57 on those shapes, 0.39 to 0.45 with noise. Of
# 34 of 1,000 to 2,600 vertices 31 are noisy by both; 0.45 would be all, and take some clean scans for noisy.
_IN_COMMON = 0.43
# What is rough with fewer vertices was made so; and what hardly is a surface has no normals to speak of.
_FEWEST, _REGULAR = 1000, 0.97
# Taubin's two steps.
_SHRINK, _GROW = 0.5, -0.53
# Their number for noise as large as an edge is long, and bounds for it. What a number of passes n leaves of the noise
# has waves longer than about n^(1/4) edges, and adds a share of the area in proportion to (noise / edge)² / n: as many
# passes go as leave the same share of every surface, 0.1 to 0.6 %. On generated shapes of 1,700 to 14,000 vertices with
# noise of 0.06 to 0.31 edges the normals came nearest to the clean ones' with 3 to 5 passes at 0.1, 10 at 0.15, 20 at
# 0.22 and 40 at 0.3. Fewer leave noise, more take thin limbs.
_PASSES, _FEWEST_PASSES, _MOST_PASSES = 430, 3, 60
# The lower quartile of the size of a normal deviate.
_QUARTILE = 0.3186


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

    As many passes as the noise asks for, see `noise_over_edge`. Vertices on boundaries stay where they are.
    """
    averaging = _neighbours(vertices, faces)[1]
    free = np.ones((len(vertices), 1))
    alone = _faces_at_sides(faces, len(vertices)) == 1
    free[faces[alone]] = 0
    free[np.roll(faces, -1, axis=1)[alone]] = 0
    n_passes = round(_PASSES * noise_over_edge(vertices, faces) ** 2)
    for _ in range(min(max(n_passes, _FEWEST_PASSES), _MOST_PASSES)):
        for step in (_SHRINK, _GROW):
            vertices = vertices + step * free * (averaging @ vertices - vertices)
    return vertices


def noise_over_edge(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Standard deviation of the noise along the normals over the root of the mean squared length of the noisy edges.

    By the lower quartile of what `is_noisy` looks at, each vertex's over what the same operator makes of white noise of
    one unit there. On generated shapes with 0.1 edges of noise and more it is within a tenth of the truth; a shape
    without noise passes for 0.01 to 0.04.
    """
    _, averaging, length = _neighbours(vertices, faces)
    normals = vertex_normals(averaging @ (averaging @ vertices), faces)
    high_pass = (sparse.eye_array(len(vertices), format="csr") - averaging).tocsr()
    rest = high_pass @ np.einsum("ij,ij->i", high_pass @ vertices, normals)
    of_a_unit = np.sqrt(np.asarray((high_pass @ high_pass).power(2).sum(axis=1)))
    noise = np.quantile(np.abs(rest) / of_a_unit, 0.25) / _QUARTILE
    return float(noise / max(np.sqrt(np.mean(length**2)), np.finfo(float).tiny))


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

"""Detect noise on a surface, and remove it.

Scanner noise moves neighbouring vertices independently; shape does not. The test uses residuals: the height of a vertex
over its neighbours, minus the mean of their heights. Without noise, residuals are small, and those of neighbours mostly
have the same sign. With noise, they are large, and have opposite signs more often. A surface is changed only if most of
it has both properties of noise. It is smoothed, and the normals of the smooth surface guide a filter of the noisy
normals, which restores edges and volume.

On the long thin triangles of turned and drawn parts, neighbours are weighted by the inverse square of their distances.
The surface is then tested and smoothed along its fine rims, where noise wrinkles it, and the steps between rims stay
sharp. Noise as large as the width of such triangles makes their normals useless: there the surface is only smoothed.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import sparse

from igps._arrays import Floats, Integers
from igps.mesh.surface import (
    TINY,
    area_vectors,
    both_ways,
    dots,
    edge_lengths,
    lengths,
    longest_side,
    undirected_edges,
    unit,
    vertex_normals,
)

# Thresholds are calibrated on generated shapes and parts of thin triangles, clean and with noise of 0.1 to 0.4 % of the
# diagonal. Values of thin triangles are in brackets.
# Lower quartile (noise is everywhere, details are not) of the residuals over the mean edge length of each vertex: up to
# 0.028 on clean shapes of 1,000 vertices and more (0.012), 0.034 to 0.092 with noise (0.027 to 0.24).
_MIN_ROUGHNESS = 0.035
# Share of neighbours whose residuals have the same sign: 0.50 to 0.57 on clean shapes (at least 0.53), 0.39 to 0.45
# with noise (at most 0.37). 0.45 would miss no noise, but take some clean scans for noisy.
_MAX_SAME_SIGN = 0.43
# Share of edges whose triangles are parallel to a tenth of a degree: up to 0.5 % with noise (5 %); 14 % and more on
# drawn houses and bicycles, whose ornaments are as rough as noise.
_MAX_FLAT = 0.1
_FLAT_ANGLE = np.radians(0.1)
# Median stretch (see `Neighbours`) above which triangles are thin: 1.02 to 1.11 on generated bodies, 4.2 to 300 on
# parts of thin triangles, the same with noise.
_THIN = 2.0
_VERY_THIN = 8.0  # stretch at single vertices of other surfaces, such as on the rim of a fan of thousands of faces
_MIN_LENGTH = 1e-9  # of an edge, in longest sides of the body; bounds the weights
# Surfaces of fewer vertices are rough by design; those with a smaller share of edges at two faces lack clear normals.
_MIN_VERTICES = 1000
_MIN_REGULAR = 0.97
# Taubin's two steps
_SHRINK = 0.5
_GROW = -0.53
# Number of Taubin passes for noise as large as the edges, and its bounds. n passes leave noise of wavelengths above
# about n^(1/4) edges, and an excess area proportional to (noise / edge)² / n. The number is chosen to leave the same
# excess on every surface, 0.1 to 0.6 %, at which normals are closest to those of clean surfaces. Fewer passes leave
# noise, more passes erode thin limbs.
_N_PASSES = 430
_MIN_PASSES = 3
_MAX_PASSES = 60
# Maximal displacement, in standard deviations of the noise. Without it, plates with holes and thin triangles, whose
# vertices have their near neighbours on one side, would lose half their volume.
_MAX_DISPLACEMENT = 5
# Width of the filter, as a difference of unit normals; its number of runs; and the number of steps in which the
# vertices follow. Width 0.3 keeps more noise, 0.4 rounds more edges; weights by distance made no difference.
_WIDTH = 0.35
_N_RUNS = 3
_N_STEPS = 10
# Faces filtered at a time, and the maximal number of faces at a vertex that count as neighbours of each other: those
# around a hub of thousands would be millions of pairs.
_FACES_AT_ONCE = 2**15
_MAX_FACES_AT_VERTEX = 64
_QUARTILE = 0.3186  # lower quartile of the absolute value of a standard normal variable


def is_noisy(vertices: Floats, faces: Integers) -> bool:
    """Return whether most of a welded, consistently oriented surface is rough with noise."""
    if len(vertices) < _MIN_VERTICES:
        return False
    vertices = vertices / _unit_of_length(vertices)
    edges, edge_of = undirected_edges(faces)
    n_faces = np.bincount(edge_of)
    if (n_faces[edge_of] == 2).mean() < _MIN_REGULAR:
        return False
    around = Neighbours.of(vertices, edges)
    averaging = around.averaging
    # Normals of the averaged surface, because noise larger than the triangles makes their own normals useless.
    once = averaging @ vertices
    normals = vertex_normals(averaging @ once, faces)
    height = dots(vertices - once, normals)
    length = np.maximum(around.length, TINY)
    residual = (height - averaging @ height) / length
    if np.quantile(np.abs(residual), 0.25) <= _MIN_ROUGHNESS:
        return False
    start, end = edges.T
    weights = averaging[start, end] + averaging[end, start]
    has_same_sign = residual[start] * residual[end] > 0
    if np.average(has_same_sign, weights=weights) >= _MAX_SAME_SIGN:
        return False
    return _share_of_flat_edges(vertices, faces, edge_of) < _MAX_FLAT


@dataclass(frozen=True)
class Neighbours:
    """Neighbours of each vertex, with equal weights, or by inverse squared distance on surfaces of thin triangles."""

    averaging: sparse.csr_array  # (V, V) averages over the neighbours
    length: Floats  # (V,) mean length of a vertex's edges: arithmetic, or by inverse squares as the weights are
    stretch: Floats  # (V,) arithmetic mean over mean by inverse squares of the lengths of a vertex's edges

    @classmethod
    def of(cls, vertices: Floats, edges: Integers) -> Self:
        n = len(vertices)
        here, there = both_ways(edges)

        def sum_around(values: Floats) -> Floats:
            """Return the sums (V,) of values (2E,) at the edges around each vertex."""
            return np.asarray(np.bincount(here, values, n), dtype=np.float64)

        length = np.tile(edge_lengths(vertices, edges), 2)
        inverse_squares = np.maximum(length, _MIN_LENGTH) ** -2.0
        weights = np.ones(len(here))
        degree = np.maximum(sum_around(weights), 1)
        mean_length = sum_around(length) / degree
        total = sum_around(inverse_squares)
        # Zero at a vertex without neighbours, like the arithmetic mean.
        squares = np.divide(degree, total, out=np.zeros(n), where=total > 0)
        near_length = np.sqrt(squares)
        stretch = np.divide(mean_length, near_length, out=np.zeros(n), where=near_length > 0)
        if np.median(stretch) > _THIN:
            weights = inverse_squares
            mean_length = near_length
        shares = weights / sum_around(weights)[here]
        averaging = sparse.csr_array((shares, (here, there)), shape=(n, n))
        return cls(averaging, mean_length, stretch)


def remove_noise(vertices: Floats, faces: Integers) -> Floats:
    """Return the vertices (V, 3) of a smoother surface of the same size; boundary vertices stay in place.

    Taubin's λ|μ passes (1995) smooth the surface; their number depends on the noise, see `noise_and_edge`. If triangles
    are not thin, the normals of the smooth surface then guide a bilateral filter of the noisy normals (Zheng, Fu, Au
    and Tai 2011; with such a guide Zhang, Deng, Zhang, Bouaziz and Liu 2015), and the noisy vertices follow the
    filtered normals (Sun, Rosin, Martin and Langbein 2007). No vertex moves farther than noise may have moved it.
    """
    unit_length = _unit_of_length(vertices)
    vertices = vertices / unit_length
    edges, edge_of = undirected_edges(faces)
    around = Neighbours.of(vertices, edges)
    is_boundary = np.bincount(edge_of) == 1
    free = np.ones((len(vertices), 1))
    free[edges[is_boundary]] = 0
    noise, edge = noise_and_edge(vertices, faces, around)
    smooth = vertices
    n_wanted = round(_N_PASSES * (noise / edge) ** 2)
    n_passes = min(max(n_wanted, _MIN_PASSES), _MAX_PASSES)
    for _ in range(n_passes):
        for step in (_SHRINK, _GROW):
            to_mean = around.averaging @ smooth - smooth
            smooth = smooth + step * free * to_mean
    if np.median(around.stretch) <= _THIN:
        normals = _filter_normals(vertices, faces, smooth)
        sharp = _fit_to_normals(vertices, faces, normals, free)
        smooth = np.where(around.stretch[:, None] > _VERY_THIN, smooth, sharp)
    move = smooth - vertices
    distance = np.maximum(lengths(move), TINY)
    share = np.minimum(1, _MAX_DISPLACEMENT * noise / distance)
    move *= share[:, None]
    return unit_length * (vertices + move)


def _filter_normals(vertices: Floats, faces: Integers, smooth: Floats) -> Floats:
    """Return unit normals (F, 3): means over the faces that share a vertex, by area and similarity of guide normals."""
    n_faces = np.bincount(faces.ravel(), minlength=len(vertices))
    has_few = n_faces <= _MAX_FACES_AT_VERTEX
    incidence = _incidence(faces, len(vertices))[:, has_few]
    areas = area_vectors(smooth, faces)
    normals = unit(area_vectors(vertices, faces))
    guide = unit(areas)
    size = lengths(areas)
    for _ in range(_N_RUNS):
        means = np.empty_like(normals)
        for start in range(0, len(faces), _FACES_AT_ONCE):
            part = slice(start, start + _FACES_AT_ONCE)
            weights = (incidence[part] @ incidence.T).tocsr()
            here = np.repeat(guide[part], np.diff(weights.indptr), axis=0)
            there = weights.indices
            # Half the squared difference of two unit vectors is 1 minus their product.
            half_squares = 1 - dots(here, guide[there])
            weights.data = size[there] * np.exp(-half_squares / _WIDTH**2)
            means[part] = weights @ normals
        normals = unit(means)
        guide = normals  # after the smooth surface, each result is the guide of the next run
    return normals


def _fit_to_normals(vertices: Floats, faces: Integers, normals: Floats, free: Floats) -> Floats:
    """Move the vertices (V, 3), where `free` (V, 1) is 1, until their faces have about the given normals (F, 3)."""
    to_vertices = _incidence(faces, len(vertices)).T.tocsr()
    projections = normals[:, :, None] * normals[:, None]
    projections = to_vertices @ projections.reshape(-1, 9)
    projections = projections.reshape(-1, 3, 3)
    n_faces = np.maximum(to_vertices.sum(axis=1), 1)
    share = free / n_faces[:, None]
    for _ in range(_N_STEPS):
        # The mean projection, on their normals, of the vectors to the centroids of the faces around
        centroids = vertices[faces].mean(axis=1)
        heights = dots(normals, centroids)
        to_centroids = to_vertices @ (heights[:, None] * normals)
        to_vertex = np.einsum("vij,vj->vi", projections, vertices)
        vertices = vertices + share * (to_centroids - to_vertex)
    return vertices


def _incidence(faces: Integers, n_vertices: int) -> sparse.csr_array:
    """(F, V) ones where a face has a vertex."""
    begins = 3 * np.arange(len(faces) + 1)
    arrays = (np.ones(faces.size), faces.ravel(), begins)
    return sparse.csr_array(arrays, shape=(len(faces), n_vertices))


def noise_and_edge(vertices: Floats, faces: Integers, around: Neighbours) -> tuple[float, float]:
    """Return the standard deviation of the noise along the normals, and the root mean square of `around.length`.

    The residuals of `is_noisy` are compared with those of white noise. On generated shapes with noise of 0.1 edges or
    more the estimate is within a tenth of the truth; without noise it is 0.01 to 0.04 edges.
    """
    averaging = around.averaging
    normals = vertex_normals(averaging @ (averaging @ vertices), faces)
    identity = sparse.eye_array(len(vertices), format="csr")
    high_pass = (identity - averaging).tocsr()
    heights = dots(high_pass @ vertices, normals)
    residual = high_pass @ heights
    squares = (high_pass @ high_pass).power(2)
    white_noise = np.sqrt(np.asarray(squares.sum(axis=1)))
    noise = np.quantile(np.abs(residual) / white_noise, 0.25) / _QUARTILE
    edge = math.sqrt(np.mean(around.length**2))
    return float(noise), max(edge, TINY)


def _unit_of_length(vertices: Floats) -> float:
    """Return the longest side, rounded down to a power of two: division is exact, and squares do not overflow."""
    side = max(longest_side(vertices), TINY)
    _, exponent = math.frexp(side)
    return math.ldexp(1.0, exponent - 1)


def _share_of_flat_edges(vertices: Floats, faces: Integers, edge_of: Integers) -> float:
    """Return the share of edges whose two triangles lie in one plane; `edge_of` (3F,) is the edge of each side."""
    normals = unit(area_vectors(vertices, faces))
    order = np.argsort(edge_of, kind="stable")
    side = order[:-1]
    next_side = order[1:]
    is_pair = edge_of[side] == edge_of[next_side]
    one_face = side[is_pair] // 3
    other_face = next_side[is_pair] // 3
    angles = lengths(normals[one_face] - normals[other_face])
    return float((angles < _FLAT_ANGLE).mean())

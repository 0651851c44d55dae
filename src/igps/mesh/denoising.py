"""Whether a surface is rough with noise, and the surface without it.

Noise of a scanner moves neighbouring vertices independently, shape does not. Take a vertex's height over its
neighbours, less the mean of theirs: on a shape what is left is small and has the same sign at neighbours; on noise it
is large and more often has opposite signs. Only where both hold on most of the surface is anything changed: it is
smoothed, and the normals of the smooth surface lead a filter of the noisy one's, by which edges and volume come back.

On the long thin triangles of turned and drawn parts a neighbour counts by the inverse square of its distance: so the
surface is looked at and smoothed along the fine rims, where noise wrinkles it, and the steps from rim to rim stay
sharp. The normals of such triangles say little where noise is as wide as they are: there smoothing is all.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import sparse

from igps._arrays import Floats, Integers
from igps.mesh.surface import area_vectors, longest_side, undirected_edges, unit, vertex_normals

# Calibrated on generated shapes and parts of thin triangles, clean and with noise of 0.1 to 0.4 % of the diagonal.
# The lower quartile of what is left over the mean length of a vertex's edges, because noise is everywhere and details
# are not: up to 0.028 on clean shapes of 1,000 vertices and more (thin triangles 0.012), 0.034 to 0.092 with noise
# (0.027 to 0.24).
_ROUGH = 0.035
# The share of neighbours on which it has the same sign: 0.50 to 0.57 on clean shapes, 0.39 to 0.45 with noise (thin
# triangles at least 0.53, at most 0.37). 0.45 would miss none, and take some clean scans for noisy.
_IN_COMMON = 0.43
# Noise leaves hardly two neighbouring triangles in one plane: up to 0.5 % of them within a tenth of a degree, 5 % on
# thin triangles. Drawn houses and bicycles, whose ornaments are as rough as noise, have 14 % and more.
_FLAT, _FLAT_ANGLE = 0.1, np.radians(0.1)
# By how much the mean length of a vertex's edges exceeds that by which the inverse squares are averaged, at the median
# vertex: 1.02 to 1.11 on generated bodies, 4.2 to 300 on parts of thin triangles, the same with noise.
_THIN = 2.0
# The same at a single vertex of another body, as on the rim of a fan of thousands of faces.
_VERY_THIN = 8.0
# Of the longest side of the body: shorter edges count as that long, so that none is infinitely short.
_SHORTEST = 1e-9
# Surfaces of fewer vertices are rough by design; those with more edges at other than two faces have no clear normals.
_FEWEST, _REGULAR = 1000, 0.97
# Taubin's two steps.
_SHRINK, _GROW = 0.5, -0.53
# Their number for noise as large as an edge is long, and bounds for it. n passes leave of the noise waves longer than
# about n^(1/4) edges, and a share of the area in proportion to (noise / edge)² / n: so as many go as leave the same
# share of every surface, 0.1 to 0.6 %. Normals came nearest to the clean ones' so. Fewer leave noise, more take thin
# limbs.
_PASSES, _FEWEST_PASSES, _MOST_PASSES = 430, 3, 60
# No vertex goes farther than so many times the noise: plates with holes and thin triangles, whose vertices have their
# near neighbours on one side, would lose half their volume.
_FARTHEST = 5
# Width of the filter of normals, as their difference, how often it is run, and how often the vertices follow. Width 0.3
# keeps more noise, 0.4 rounds more edges; weights by distance made no difference.
_WIDTH, _RUNS, _STEPS = 0.35, 3, 10
# Faces whose neighbours are gathered at a time, and the most faces around a vertex that all count as neighbours of each
# other: those around a hub of thousands would be millions of pairs.
_FACES_AT_ONCE, _MOST_AROUND = 2**15, 64
# The lower quartile of the size of a normal deviate.
_QUARTILE = 0.3186


def is_noisy(vertices: Floats, faces: Integers) -> bool:
    """Whether most of a surface of welded faces that are turned alike is rough with noise."""
    if len(vertices) < _FEWEST:
        return False
    vertices = vertices / _unit_of_length(vertices)
    around = Neighbours.of(vertices, faces)
    if (around.faces_at_sides == 2).mean() < _REGULAR:
        return False
    # Of the averaged surface: where noise is larger than the triangles, theirs say nothing.
    normals = vertex_normals(around.averaging @ (around.averaging @ vertices), faces)
    edges, averaging = around.edges, around.averaging
    height = np.einsum("ij,ij->i", vertices - averaging @ vertices, normals)
    rest = (height - averaging @ height) / np.maximum(around.length, np.finfo(float).tiny)
    weights = averaging[edges[:, 0], edges[:, 1]] + averaging[edges[:, 1], edges[:, 0]]
    in_common = np.average(rest[edges[:, 0]] * rest[edges[:, 1]] > 0, weights=weights)
    is_rough = np.quantile(np.abs(rest), 0.25) > _ROUGH and in_common < _IN_COMMON
    return bool(is_rough) and _share_of_flat_edges(vertices, faces, around.edge_of) < _FLAT


@dataclass(frozen=True)
class Neighbours:
    """Of each vertex; where most are among thin triangles, the near ones: by the inverse squares of their distances."""

    edges: Integers  # (E, 2)
    edge_of: Integers  # (3F,): of every side of every face
    averaging: sparse.csr_array  # (V, V): averages over the neighbours
    length: Floats  # (V,): of a vertex's edges
    stretch: Floats  # (V,): mean length of a vertex's edges over that of the near ones

    @classmethod
    def of(cls, vertices: Floats, faces: Integers) -> Self:
        n = len(vertices)
        edges, edge_of = undirected_edges(faces, n)
        rows, columns = edges.T.ravel(), edges[:, ::-1].T.ravel()
        degree = np.maximum(np.bincount(rows, minlength=n), 1)
        length = np.tile(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 2)
        weights, of_vertex = np.ones(len(rows)), np.bincount(rows, weights=length, minlength=n) / degree
        near = np.maximum(length, _SHORTEST) ** -2.0
        nearness = np.bincount(rows, weights=near, minlength=n)
        # Zero, as the mean is, of a vertex without neighbours.
        of_near = np.sqrt(np.divide(degree, nearness, out=np.zeros(n), where=nearness > 0))
        stretch = np.divide(of_vertex, of_near, out=np.zeros(n), where=of_near > 0)
        if np.median(stretch) > _THIN:
            weights, of_vertex = near, of_near
        total = np.bincount(rows, weights=weights, minlength=n)
        averaging = sparse.csr_array((weights / total[rows], (rows, columns)), shape=(n, n))
        return cls(edges, edge_of, averaging, of_vertex, stretch)

    @property
    def faces_at_sides(self) -> Integers:
        """(F, 3) how many faces share the side from each corner to the next."""
        return np.asarray(np.bincount(self.edge_of)[self.edge_of].reshape(-1, 3))


def denoised(vertices: Floats, faces: Integers) -> Floats:
    """(V, 3) vertices of a smoother surface of the same size; those on boundaries stay where they are.

    Taubin's λ|μ passes (1995), as many as the noise asks for, see `noise_and_edge`. Where triangles are thin, that is
    all. Elsewhere the normals of the smooth surface lead a bilateral filter of those of the noisy one (Zheng, Fu, Au
    and Tai 2011; with such a guide Zhang, Deng, Zhang, Bouaziz and Liu 2015), and the noisy vertices follow (Sun,
    Rosin, Martin and Langbein 2007). No vertex goes farther than noise may have moved it.
    """
    unit_length = _unit_of_length(vertices)
    vertices = vertices / unit_length
    around = Neighbours.of(vertices, faces)
    free = np.ones((len(vertices), 1))
    alone = around.faces_at_sides == 1
    free[faces[alone]] = 0
    free[np.roll(faces, -1, axis=1)[alone]] = 0
    noise, edge = noise_and_edge(vertices, faces, around)
    smooth = vertices
    for _ in range(min(max(round(_PASSES * (noise / edge) ** 2), _FEWEST_PASSES), _MOST_PASSES)):
        for step in (_SHRINK, _GROW):
            smooth = smooth + step * free * (around.averaging @ smooth - smooth)
    if np.median(around.stretch) <= _THIN:
        sharp = _with_normals(vertices, faces, _filtered_normals(vertices, faces, smooth), free)
        smooth = np.where(around.stretch[:, None] > _VERY_THIN, smooth, sharp)
    move = smooth - vertices
    distance = np.linalg.norm(move, axis=1, keepdims=True)
    move *= np.minimum(1, _FARTHEST * noise / np.maximum(distance, np.finfo(float).tiny))
    return unit_length * (vertices + move)


def _filtered_normals(vertices: Floats, faces: Integers, smooth: Floats) -> Floats:
    """(F, 3) unit normals: means over the faces that share a vertex, by area and by how alike a guide's normals are,
    at first the smooth surface's, then those of the run before."""
    n_around = np.bincount(faces.ravel(), minlength=len(vertices))
    at_corners = _at_corners(faces, len(vertices))[:, n_around <= _MOST_AROUND]
    areas = area_vectors(smooth, faces)
    normals, guide = unit(area_vectors(vertices, faces)), unit(areas)
    size = np.linalg.norm(areas, axis=1)
    for _ in range(_RUNS):
        means = np.empty_like(normals)
        for start in range(0, len(faces), _FACES_AT_ONCE):
            part = slice(start, start + _FACES_AT_ONCE)
            shared = (at_corners[part] @ at_corners.T).tocsr()
            here = np.repeat(guide[part], np.diff(shared.indptr), axis=0)
            # Half the squared difference of unit vectors is one less their product.
            unlike = 1 - np.einsum("ij,ij->i", here, guide[shared.indices])
            shared.data = size[shared.indices] * np.exp(-unlike / _WIDTH**2)
            means[part] = shared @ normals
        normals = guide = unit(means)
    return normals


def _with_normals(vertices: Floats, faces: Integers, normals: Floats, free: Floats) -> Floats:
    """(V, 3) vertices moved, as far as they are free (V, 1), until their faces have about these normals (F, 3)."""
    to_vertices = _at_corners(faces, len(vertices)).T.tocsr()
    projections = (to_vertices @ (normals[:, :, None] * normals[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    share = free / np.maximum(to_vertices.sum(axis=1), 1)[:, None]
    for _ in range(_STEPS):
        # Of each face around a vertex, its normal times how far along it the centroid lies.
        heights = np.einsum("ij,ij->i", normals, vertices[faces].mean(axis=1))
        move = to_vertices @ (heights[:, None] * normals) - np.einsum("vij,vj->vi", projections, vertices)
        vertices = vertices + share * move
    return vertices


def _at_corners(faces: Integers, n_vertices: int) -> sparse.csr_array:
    """(F, V) ones where a face has a vertex."""
    begins = 3 * np.arange(len(faces) + 1)
    return sparse.csr_array((np.ones(faces.size), faces.ravel(), begins), shape=(len(faces), n_vertices))


def noise_and_edge(vertices: Floats, faces: Integers, around: Neighbours) -> tuple[float, float]:
    """Standard deviation of the noise along the normals, and root mean square length of edges (if thin, near ones).

    By what `is_noisy` looks at, over what the same operator makes of white noise. On generated shapes with 0.1 edges of
    noise and more it is within a tenth of the truth; a shape without noise passes for 0.01 to 0.04 edges.
    """
    normals = vertex_normals(around.averaging @ (around.averaging @ vertices), faces)
    high_pass = (sparse.eye_array(len(vertices), format="csr") - around.averaging).tocsr()
    rest = high_pass @ np.einsum("ij,ij->i", high_pass @ vertices, normals)
    of_a_unit = np.sqrt(np.asarray((high_pass @ high_pass).power(2).sum(axis=1)))
    noise = np.quantile(np.abs(rest) / of_a_unit, 0.25) / _QUARTILE
    return float(noise), float(max(np.sqrt(np.mean(around.length**2)), np.finfo(float).tiny))


def _unit_of_length(vertices: Floats) -> float:
    """The longest side, up to a power of two: squares of lengths are numbers in it, and to divide by it is exact."""
    _, exponent = np.frexp(max(longest_side(vertices), np.finfo(float).tiny))
    return float(np.ldexp(1.0, int(exponent) - 1))


def _share_of_flat_edges(vertices: Floats, faces: Integers, edge_of: Integers) -> float:
    """The share of edges whose two triangles lie in one plane, of faces whose sides (3F,) are these edges."""
    normals = unit(area_vectors(vertices, faces))
    order = np.argsort(edge_of, kind="stable")
    pairs = np.flatnonzero(edge_of[order[1:]] == edge_of[order[:-1]])
    apart = np.linalg.norm(normals[order[pairs] // 3] - normals[order[pairs + 1] // 3], axis=1)
    return float((apart < _FLAT_ANGLE).mean())

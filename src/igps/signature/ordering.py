"""An order of the points of a body that depends only on its shape, and selections by that order.

Samples are numbered by a grid, and faces and vertices by a file. A selection by such numbers changes if the body is
turned or its mesh renumbered. Here each point gets a key, which is computed from distances in a spectral embedding, or
in space. Keys are therefore independent of position, numbering, and the signs and bases of eigenfunctions.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps.mesh.mesh import Mesh
from igps.mesh.surface import TINY, face_areas, lengths

# λ·area at which the weights of the embedding have fallen to 1/e of those of the commute time. The eigenfunctions from
# the 60th on are then negligible, and a multiplet may be cut off at the end.
_CUTOFF = 100.0
_MIN_WEIGHT = 1e-4  # relative to the first eigenfunction
_N_NEIGHBOURS = 32  # of `nearest_spacing`
# Weights in the key, relative to the potential. Those of the distances from the anchors are incommensurable, so that
# two points have equal keys only by chance.
_TIE_BREAKER_WEIGHT = 0.03
_ANCHOR_WEIGHTS = 0.1 / np.sqrt([1.0, 2.0, 3.0, 5.0])


def ordering_keys(
    eigenfunctions: NDArray[np.floating],
    eigenvalues: Floats,
    area: float,
    tie_breakers: Floats | float = 0.0,
) -> Floats:
    """Return a key (P,), dimensionless, for each point of a body, for an order independent of the numbering.

    The key is the barycentroid potential (Rustamov 2010) in a smooth low-pass embedding of eigenfunctions (P, K) at the
    points, plus multiples of the distances from four of the points, the anchors. The first anchor is the point of
    largest potential, each further one is far from those before. In a body with symmetries many points have the same
    potential, and the anchors distinguish them. Rounding decides which of several equivalent points becomes an anchor,
    but all choices lead to equivalent keys.

    The tie-breakers (P,), of order 1, distinguish points further. The symmetries of a body need not be those of its
    samples: around the axis of a vase the surface is the same everywhere, but the grid and the triangles are not.
    """
    scaled = eigenvalues * area
    weights = np.sqrt(area / scaled)
    weights *= np.exp(-scaled / _CUTOFF)
    is_used = weights > _MIN_WEIGHT * weights[0]  # up to some index, as weights decrease
    n_used = int(is_used.sum())
    functions = eigenfunctions[:, :n_used]
    return _keys(functions * weights[:n_used], tie_breakers)


def spatial_ordering_keys(mesh: Mesh) -> Floats:
    """Return keys (V,) for the vertices of a mesh, from Euclidean distances to the surface's centroid and to anchors.

    Unlike `ordering_keys`, they change with pose.
    """
    areas = face_areas(mesh.vertices, mesh.faces)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    centroid = areas @ centres / areas.sum()
    embedding = mesh.vertices - centroid
    embedding /= lengths(embedding).max()
    return _keys(embedding, vertex_area_shares(mesh.faces, areas))


def in_canonical_order(mesh: Mesh) -> Mesh:
    """Return the mesh with vertices, faces and first corners of faces in an order independent of their numbering."""
    order = np.argsort(spatial_ordering_keys(mesh), kind="stable")
    rank = np.argsort(order)
    corners = rank[mesh.faces]
    first = corners.argmin(axis=1)[:, None]
    turned = (first + np.arange(3)) % 3
    corners = np.take_along_axis(corners, turned, axis=1)
    ascending = np.lexsort(corners.T[::-1])
    return replace(mesh, vertices=mesh.vertices[order], faces=corners[ascending])


def _keys(embedding: NDArray[np.floating], tie_breakers: Floats | float) -> Floats:
    keys = lengths(embedding) + _TIE_BREAKER_WEIGHT * tie_breakers
    anchor = int(np.argmax(keys))
    nearest = np.full(len(keys), np.inf)
    for weight in _ANCHOR_WEIGHTS:
        distance = lengths(embedding - embedding[anchor])
        keys += weight * distance
        nearest = np.minimum(nearest, distance)
        # The nearest distance alone may be the same for two points that differ in the distances from other anchors.
        anchor = int(np.argmax(nearest + keys))
    return keys


def nearest_spacing(points: Floats) -> Floats:
    """Return each point's (P, 3) mean distance from its neighbours, over the mean of all: tie-breakers (P,)."""
    n_neighbours = min(_N_NEIGHBOURS + 1, len(points))
    distances, _ = cKDTree(points).query(points, n_neighbours)
    distances = distances.reshape(len(points), n_neighbours)
    spacing = distances.mean(axis=1)
    return spacing / max(spacing.mean(), TINY)


def vertex_area_shares(faces: Integers, areas: Floats) -> Floats:
    """Return the area of the faces (F, 3) around each vertex, over its mean: tie-breakers (V,) of `ordering_keys`."""
    at_corners = np.repeat(areas, 3)
    around = np.bincount(faces.ravel(), weights=at_corners)
    return around / around.mean()


def systematic_sample(sizes: Floats, n: int, generator: np.random.Generator) -> Integers:
    """Draw n indices (n,), ascending, with frequencies proportional to sizes (F,).

    The sizes are laid end to end, their total is cut into n equal parts, and one position is drawn in each. A large
    item may be drawn several times.
    """
    ends = np.cumsum(sizes)
    part = ends[-1] / n
    in_part = generator.random(n)
    positions = (np.arange(n) + in_part) * part
    drawn = np.searchsorted(ends, positions, side="right")
    last = np.flatnonzero(sizes)[-1]
    return np.minimum(drawn, last)


def spatial_order(points: Floats, size: int) -> Integers:
    """Return an order (n,) of points (n, 3) whose consecutive blocks of size·2ᵏ points are compact in space, for all k.

    It is found by median cuts: the points of each bounding box are repeatedly halved along its longest side.
    """
    n_points = len(points)
    if not n_points:
        return np.empty(0, np.int64)
    n_cuts = max(0, math.ceil(math.log2(n_points / size)))
    order = np.minimum(np.arange(size << n_cuts), n_points)
    # Index n_points is padding: the mean point for bounding boxes, behind all others for cuts.
    padding = points.mean(axis=0)
    padded = np.vstack([points, padding])
    padded = np.ascontiguousarray(padded.T)
    for cut in range(n_cuts):
        n_boxes = 1 << cut
        boxes = padded.take(order, axis=1).reshape(3, n_boxes, -1)
        sides = np.ptp(boxes, axis=2)
        longest = sides.argmax(axis=0)
        along = boxes[longest, np.arange(n_boxes)]
        order = order.reshape(along.shape)
        along[order == n_points] = np.inf
        last_left = along.shape[1] // 2 - 1
        halves = np.argpartition(along, last_left, axis=1)
        order = np.take_along_axis(order, halves, axis=1).ravel()
    return order[order < n_points]


def principal_axes(points: Floats) -> Floats:
    """Return the principal axes of points (n, 3) as columns (3, 3); each points towards the longer tail."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred).eigenvectors
    coordinates = centred @ axes
    skewness = (coordinates**3).sum(axis=0)
    return np.where(skewness < 0, -axes, axes)

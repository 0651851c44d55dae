"""An order of the points of a body that depends on its form alone, and choices along it.

Samples come in the order of a grid, faces and vertices in that of a file. What is chosen by such an order changes when
the body is turned or its mesh numbered anew. Here points are ordered by one number each, which consists of distances in
a spectral embedding, or in space, and so does not depend on place, numbering, or sign and basis of eigenfunctions.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps.mesh.mesh import Mesh
from igps.mesh.surface import face_areas

# λ·area at which the embedding's weights have fallen to 1/e of the commute time's: the eigenfunctions from the 60th on
# count for nothing, and it does not matter whether the last ones are all of a multiplet.
_CUTOFF = 100.0
_N_NEAREST = 32
_LEAST_WEIGHT = 1e-4
# Of the distances from the anchors, beside the potential. They are no multiples of each other, so that two points have
# the same place only by chance.
_MARK_SHARE = 0.03
_ANCHOR_SHARES = 0.1 / np.sqrt([1.0, 2.0, 3.0, 5.0])


def ordering_keys(
    eigenfunctions: NDArray[np.floating], eigenvalues: Floats, area: float, marks: Floats | float = 0.0
) -> Floats:
    """One number for each of some points of a body, by which they can be ordered whatever the order they come in.

    The barycentroid potential (Rustamov 2010) in a smooth low-pass embedding, and shares of the distances from four
    anchors. These are among the points: the one of greatest potential, then each time one far from those before. In a
    body with symmetries many points have one potential, and the anchors tell them apart; which of several like points
    becomes an anchor is decided by rounding, but whichever it is, all that follows is like what would follow another.

    Of eigenfunctions (P, K) at the points it is (P,), dimensionless. Marks (P,) of the order of 1 are what else tells
    points apart: a body's symmetries need not be those of the points that stand for it. Around the axis of a vase the
    surface is the same, the grid or the triangles are not.
    """
    scaled = eigenvalues * area
    weights = np.sqrt(area / scaled) * np.exp(-scaled / _CUTOFF)
    n_kept = int((weights > _LEAST_WEIGHT * weights[0]).sum())  # the first: weights fall
    return _by_anchors(eigenfunctions[:, :n_kept] * weights[:n_kept], marks)


def spatial_ordering_keys(mesh: Mesh) -> Floats:
    """(V,) the same for the vertices of a mesh, by straight distances from the surface's centroid and from anchors.

    This needs no eigenfunctions, but changes with pose.
    """
    areas = face_areas(mesh.vertices, mesh.faces)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    embedding = mesh.vertices - areas @ centres / areas.sum()
    embedding /= np.linalg.norm(embedding, axis=1).max()
    return _by_anchors(embedding, vertex_area_shares(mesh.faces, areas))


def canonically_ordered(mesh: Mesh) -> Mesh:
    """The mesh with vertices, faces and the first corner of each in an order that its numbering does not change."""
    found = spatial_ordering_keys(mesh)
    order = np.argsort(found, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    corners = rank[mesh.faces]
    first = corners.argmin(axis=1)[:, None]
    corners = np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1)
    return replace(mesh, vertices=mesh.vertices[order], faces=corners[np.lexsort(corners.T[::-1])])


def _by_anchors(embedding: Floats, marks: Floats | float) -> Floats:
    found = np.linalg.norm(embedding, axis=1) + _MARK_SHARE * marks
    anchor, nearest = int(np.argmax(found)), np.full(len(found), np.inf)
    for share in _ANCHOR_SHARES:
        distance = np.linalg.norm(embedding - embedding[anchor], axis=1)
        found += share * distance
        nearest = np.minimum(nearest, distance)
        # Not the nearest alone: that of two points may agree where the distances from the other anchors do not.
        anchor = int(np.argmax(nearest + found))
    return found


def nearest_spacing(points: Floats) -> Floats:
    """Mean distance of each of some points (P, 3) from its nearest ones, over that of all, for `ordering_keys`."""
    n_nearest = min(_N_NEAREST + 1, len(points))
    distance = cKDTree(points).query(points, n_nearest)[0].reshape(len(points), n_nearest).mean(axis=1)
    return distance / max(distance.mean(), np.finfo(float).tiny)


def vertex_area_shares(faces: Integers, areas: Floats) -> Floats:
    """Area of the faces (F, 3) around each vertex, over the mean: marks for `ordering_keys`."""
    around = np.bincount(faces.ravel(), weights=np.repeat(areas, 3))
    return around / around.mean()


def systematic_sample(sizes: Floats, n: int, generator: np.random.Generator) -> Integers:
    """Draw n of things of sizes (F,) laid end to end: one at random in each n-th of the length; (n,) ascending indices.

    Each is drawn as often as its size asks, a large one several times.
    """
    ends = np.cumsum(sizes)
    position = (np.arange(n) + generator.random(n)) * (ends[-1] / n)
    return np.minimum(np.searchsorted(ends, position, side="right"), np.flatnonzero(sizes)[-1])


def spatial_order(points: Floats, size: int) -> Integers:
    """An order (n,) of points (n, 3) in which all runs of size·2ᵏ, counted from the start, are compact in space.

    The median cut: halves along the longest side of their bounding box, again and again.
    """
    n_points = len(points)
    n_cuts = max(0, math.ceil(math.log2(max(1, n_points) / size)))
    order = np.minimum(np.arange(size << n_cuts), n_points)
    # Runs are filled up by a point that is in the middle for the boxes, and behind all others for the cuts.
    padded = np.ascontiguousarray(np.vstack([points, points.mean(axis=0) if n_points else np.zeros(3)]).T)
    for cut in range(n_cuts):
        boxes = padded.take(order, axis=1).reshape(3, 1 << cut, -1)
        along = boxes[np.ptp(boxes, axis=2).argmax(axis=0), np.arange(1 << cut)]
        along[order.reshape(along.shape) == n_points] = np.inf
        halves = np.argpartition(along, along.shape[1] // 2 - 1, axis=1)
        order = np.take_along_axis(order.reshape(along.shape), halves, axis=1).ravel()
    return order[order < n_points]


def principal_axes(points: Floats) -> Floats:
    """The principal axes of points (n, 3), as columns (3, 3), towards the longer tails: cuts turn with the points."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred).eigenvectors
    skewness = ((centred @ axes) ** 3).sum(axis=0)
    return np.where(skewness < 0, -axes, axes)

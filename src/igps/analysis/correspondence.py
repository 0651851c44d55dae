"""Local differences between corresponding places of two bodies, independent of their poses."""

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from igps._arrays import Floats, Integers
from igps.data.batch import SampleBatch, SignatureBatch
from igps.mesh.surface import unit

# Times of the heat kernel over the area. The kernel of large times identifies the place on the body, the kernel of
# small times depends on the surface around it
_LARGE_TIMES, _SMALL_TIMES = 0.01 * 2.0 ** np.arange(6), 0.0008 * 2.0 ** np.arange(5)
_N_CORRESPONDING = 10  # samples of the other body that correspond to a sample
_MIN_DEVIATION = (
    0.1  # smallest standard deviation at a place, as a fraction of that of the whole body
)
_SMOOTHING = 0.06  # standard deviation of the smoothing kernel, over the square root of the area
_PATCH = 0.04  # radius of the patches of surface whose curvature is measured, over the square root of the area
_N_PLANE, _N_INSIDE = (
    12,
    6,
)  # nearest surface samples that determine a tangent plane, and interior ones its side
_MAX_BALL = 0.5  # largest radius of a ball, over the square root of the area
_NEAR, _MIN_SINE = (
    0.03,
    0.2,
)  # a ball may contain samples nearer than this (over √area), or nearer the tangent plane


def dissimilarity(body: SignatureBatch, other: SignatureBatch) -> Floats:
    """Return how much each surface sample of a body differs from the corresponding samples of another body.

    The ten corresponding samples are the nearest by the heat kernels (Sun, Ovsjanikov and Guibas 2009) at large times,
    which do not depend on the pose. Two kinds of measures are compared: the principal curvatures and the thickness; and
    the heat kernels at small times. For each kind, this is the squared Mahalanobis distance from the mean of the
    corresponding samples, by their covariance, which is large where poses bend the surface. Its logarithm is smoothed
    on the surface and standardised.

    Args:
        body, other: batches of one body each.

    Returns:
        (P,) the exponential of the sum of both, positive.
    """
    (large, small), (other_large, other_small) = _heat_kernels(body), _heat_kernels(other)
    nearest, points = _nearest(large, other_large), _points(body.surface, body)
    total = np.zeros(len(points))
    for own, others in ((local_shape(body), local_shape(other)), (small, other_small)):
        smoothed = _smoothed(np.log1p(squared_deviations(own, others, nearest)), points)
        total += (smoothed - smoothed.mean()) / (smoothed.std() + 1e-12)
    return np.exp(total)


def _points(samples: SampleBatch, body: SignatureBatch) -> Floats:
    """Return the positions of samples (P, 3), over √area."""
    return samples.points[0][samples.mask[0]].double().numpy() / float(body.area[0]) ** 0.5


def _heat_kernels(body: SignatureBatch) -> tuple[Floats, Floats]:
    """Return log(heat kernel · area) at each surface sample, (P, times), for large and for small times."""
    area, is_sample = float(body.area[0]), body.surface.mask[0]
    squares = body.surface.eigenfunctions[0][is_sample].double().square().numpy() * area
    values = body.eigenvalues[0].double().numpy() * area
    large, small = (
        np.log1p(squares @ np.exp(-np.outer(values, times)))
        for times in (_LARGE_TIMES, _SMALL_TIMES)
    )
    return large, small


def _nearest(one: Floats, other: Floats) -> Integers:
    """Return indices (P, n) of the nearest rows of the other array, each column standardised by it."""
    scale, n = other.std(axis=0) + 1e-9, min(_N_CORRESPONDING, len(other))
    return cKDTree(other / scale).query(one / scale, list(range(1, n + 1)))[1]


def squared_deviations(own: Floats, others: Floats, nearest: Integers) -> Floats:
    """Return the squared Mahalanobis distance of each row from the corresponding rows of another array.

    Args:
        own, others: (P, D) and (Q, D) measures.
        nearest: (P, n) indices of the corresponding rows. A fraction of the covariance of all rows is added to theirs.

    Returns:
        (P,) squared distances from their means.
    """
    corresponding = others[nearest]
    means = corresponding.mean(axis=1)
    offsets, steps = corresponding - means[:, None], (own - means)[:, :, None]
    least = np.square(_MIN_DEVIATION) * np.cov(others.T, bias=True) + 1e-12 * np.eye(
        others.shape[1]
    )
    covariances = offsets.transpose(0, 2, 1) @ offsets / nearest.shape[1] + least
    return (steps * np.linalg.solve(covariances, steps)).sum(axis=(1, 2))


def local_shape(body: SignatureBatch) -> Floats:
    """Return (P, 3): the principal curvatures at each surface sample, and the log of the largest ball inside there.

    The curvatures, ascending and over the radius of a patch, are those of the linear function of the position that fits
    the normals of the patch (least squares). Normals are outward, and estimated if the samples have none.
    """
    points, directions = (
        _points(body.surface, body),
        body.surface.attributes.get("surface_direction"),
    )
    if directions is None:
        normals = _estimated_normals(points, _points(body.interior, body))
    else:
        normals = unit(directions[0][body.surface.mask[0]].double().numpy())
    tangent = unit(np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)]))
    axes, tree = np.stack([tangent, np.cross(normals, tangent)], axis=2), cKDTree(points)
    # A disc of this radius has a share π r² of all samples; the curved surface, and another one near it, have more
    n = max(_N_PLANE, math.ceil(1.5 * math.pi * _PATCH**2 * len(points)))
    distances, patch = tree.query(points, list(range(1, min(n, len(points)) + 1)))
    weights = np.clip(1 - np.square(distances / _PATCH), 0, 1)
    weights *= (
        np.einsum("pkc,pc->pk", normals[patch], normals) > 0.2
    )  # not the other side of a thin part
    steps = (points[patch] - points[:, None]) @ axes / _PATCH
    terms = np.concatenate([np.ones_like(steps[:, :, :1]), steps], axis=2)
    weighted = (terms * weights[:, :, None]).transpose(0, 2, 1)
    fits = np.linalg.solve(weighted @ terms + 1e-3 * np.eye(3), weighted @ (normals[patch] @ axes))
    curvatures = np.linalg.eigvalsh((fits[:, 1:] + fits[:, 1:].transpose(0, 2, 1)) / 2)
    if directions is None:
        normals = unit(normals + (axes @ fits[:, 0, :, None])[:, :, 0])
    return np.column_stack([curvatures, np.log(_inner_balls(points, normals))])


def _estimated_normals(points: Floats, inside: Floats) -> Floats:
    """Return outward normals (P, 3) of planes through the nearest points, by the nearest samples of the interior."""
    _, plane = cKDTree(points).query(points, list(range(1, min(_N_PLANE, len(points)) + 1)))
    offsets = points[plane] - points[plane].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets).eigenvectors[:, :, 0]
    _, deep = cKDTree(inside).query(points, list(range(1, min(_N_INSIDE, len(inside)) + 1)))
    is_inward = ((points - inside[deep].mean(axis=1)) * normals).sum(axis=1) < 0
    return np.where(is_inward, -1, 1)[:, None] * normals


def _inner_balls(points: Floats, normals: Floats) -> Floats:
    """Return the radius (P,) of the ball that touches each point from inside and contains at most two other points.

    Points near the touching point are left out, as the error of the normal decides whether the ball contains them.
    """
    radii = np.empty(len(points))
    for rows in np.array_split(np.arange(len(points)), math.ceil(len(points) / 256)):
        squares = cdist(points[rows], points, "sqeuclidean")
        depths = (normals[rows] * points[rows]).sum(axis=1, keepdims=True) - normals[
            rows
        ] @ points.T
        counts = (squares > _NEAR**2) & (depths > _MIN_SINE * np.sqrt(squares))
        through = np.where(counts, squares / np.where(counts, 2 * depths, 1), _MAX_BALL)
        radii[rows] = np.partition(through, 2, axis=1)[:, 2]
    return np.minimum(radii, _MAX_BALL)


def _smoothed(values: Floats, points: Floats) -> Floats:
    """Return Gaussian means of the values at the points within two standard deviations of each point."""
    tree = cKDTree(points)
    pairs = tree.sparse_distance_matrix(tree, 2 * _SMOOTHING, output_type="coo_matrix")
    weights = np.exp(-np.square(pairs.data / _SMOOTHING) / 2)
    sums = np.bincount(pairs.row, weights * values[pairs.col], len(points))
    return sums / np.bincount(pairs.row, weights, len(points))

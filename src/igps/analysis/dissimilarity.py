"""Local differences between corresponding places of two bodies, independent of their poses."""

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from igps._arrays import Floats, Integers
from igps.data.batch import Body
from igps.data.requirements import SURFACE_DIRECTION
from igps.mesh.surface import unit

REQUIREMENTS = SURFACE_DIRECTION
"""What bodies must have beside samples: outward normals."""


# Times of the heat kernel over the area. The kernel of large times identifies the place on the body, the kernel of
# small times depends on the surface around it
_LARGE_TIMES: Floats = np.asarray(0.01 * 2.0 ** np.arange(6), np.float64)
_SMALL_TIMES: Floats = np.asarray(0.0008 * 2.0 ** np.arange(5), np.float64)
_N_CORRESPONDING = 10  # samples of the other body that correspond to a sample
# Smallest standard deviation at a place, as a fraction of that of the whole body
_MIN_DEVIATION = 0.1
# Lengths below are in units of the square root of the area.
_SMOOTHING = 0.06  # standard deviation of the smoothing kernel
_PATCH = 0.04  # radius of the patches of surface whose curvature is measured
_MAX_BALL = 0.5  # largest radius of a ball
_MIN_PATCH = 12  # samples of a patch at least
# A ball may contain samples that are nearer to its touching point than _NEAR, or whose direction from there has a
# smaller sine to the tangent plane than _MIN_SINE
_NEAR = 0.03
_MIN_SINE = 0.2
# Smallest cosine between the normals of a patch and that of its centre; the other side of a thin part has less
_MIN_COSINE = 0.2
_BLOCK_ROWS = 256  # samples whose distances from all samples are in memory at once


def dissimilarity(body: Body, other: Body) -> Floats:
    """Return how much each surface sample of a body differs from the corresponding samples of another body.

    The ten corresponding samples are the nearest by the heat kernels (Sun, Ovsjanikov and Guibas 2009) at large times,
    which do not depend on the pose. Two kinds of measures are compared: the principal curvatures and the thickness; and
    the heat kernels at small times. For each kind, this is the squared Mahalanobis distance from the mean of the
    corresponding samples, by their covariance, which is large where poses bend the surface. Its logarithm is smoothed
    on the surface and standardised.

    Returns:
        (P,) the exponential of the sum of both, positive.
    """
    places = _heat_kernels(body, _LARGE_TIMES)
    other_places = _heat_kernels(other, _LARGE_TIMES)
    nearest = _nearest(places, other_places)
    by_shape = squared_deviations(local_shape(body), local_shape(other), nearest)
    small = _heat_kernels(body, _SMALL_TIMES)
    other_small = _heat_kernels(other, _SMALL_TIMES)
    by_heat = squared_deviations(small, other_small, nearest)
    points = _points(body)
    shape = _standardised(by_shape, points)
    heat = _standardised(by_heat, points)
    return np.exp(shape + heat)


def _standardised(deviations: Floats, points: Floats) -> Floats:
    """Return the logarithms of squared deviations, smoothed on the surface, with mean 0 and scatter 1."""
    smoothed = _smoothed(np.log1p(deviations), points)
    scatter = smoothed.std() + 1e-12
    return (smoothed - smoothed.mean()) / scatter


def _points(body: Body) -> Floats:
    """Return the positions of the surface samples (P, 3), over √area."""
    return body.surface.points / body.area**0.5


def _heat_kernels(body: Body, times: Floats) -> Floats:
    """Return log(heat kernel · area) at each surface sample, (P, times)."""
    eigenfunctions = body.surface.eigenfunctions.astype(np.float64)
    squares = np.square(eigenfunctions) * body.area
    exponents = np.outer(body.eigenvalues * body.area, times)
    return np.log1p(squares @ np.exp(-exponents))


def _nearest(one: Floats, other: Floats) -> Integers:
    """Return indices (P, n) of the nearest rows of the other array, each column standardised by it."""
    scale = other.std(axis=0) + 1e-9
    ranks = _ranks(_N_CORRESPONDING, len(other))
    _, nearest = cKDTree(other / scale).query(one / scale, ranks)
    return nearest


def _ranks(count: int, n_points: int) -> list[int]:
    """Return the ranks 1 to count, or to the number of points; as a list, a tree answers in two dimensions."""
    return list(range(1, min(count, n_points) + 1))


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
    offsets = corresponding - means[:, None]
    steps = (own - means)[:, :, None]
    overall = np.cov(others.T, bias=True)
    n_measures = others.shape[1]
    least = np.square(_MIN_DEVIATION) * overall + 1e-12 * np.eye(n_measures)
    n_corresponding = nearest.shape[1]
    covariances = offsets.transpose(0, 2, 1) @ offsets / n_corresponding
    covariances = covariances + least
    solved = np.linalg.solve(covariances, steps)
    return (steps * solved).sum(axis=(1, 2))


def local_shape(body: Body) -> Floats:
    """Return (P, 3): the principal curvatures at each surface sample, and the log of the largest ball inside there.

    The curvatures, ascending and over the radius of a patch, are those of the linear function of the position that fits
    the normals of the patch (least squares). The body meets `REQUIREMENTS`.
    """
    points = _points(body)
    directions = body.surface.attributes["surface_direction"]
    normals = unit(directions.astype(np.float64))
    slopes = _slopes_of_normals(points, normals)
    symmetric = (slopes + slopes.transpose(0, 2, 1)) / 2
    curvatures = np.linalg.eigvalsh(symmetric)
    radii = _inner_balls(points, normals)
    return np.column_stack([curvatures, np.log(radii)])


def _tangents(normals: Floats) -> Floats:
    """Return two orthonormal tangents at each normal, (P, 3, 2)."""
    smallest = np.abs(normals).argmin(axis=1)
    apart = np.eye(3)[smallest]
    first = unit(np.cross(normals, apart))
    second = np.cross(normals, first)
    return np.stack([first, second], axis=2)


def _slopes_of_normals(points: Floats, normals: Floats) -> Floats:
    """Fit the normals of the patch around each point by a linear function of the position, by least squares.

    Returns:
        (P, 2, 2) its slopes along two tangents, over _PATCH, of the parts of the normal along both.
    """
    axes = _tangents(normals)
    # A disc of this radius has a share π r² of all samples; the curved surface, and another one near it, have more
    n_expected = 1.5 * math.pi * _PATCH**2 * len(points)
    n_patch = max(_MIN_PATCH, math.ceil(n_expected))
    ranks = _ranks(n_patch, len(points))
    distances, patch = cKDTree(points).query(points, ranks)
    patch_normals = normals[patch]
    cosines = np.einsum("pkc,pc->pk", patch_normals, normals)
    weights = np.clip(1 - np.square(distances / _PATCH), 0, 1)
    weights *= cosines > _MIN_COSINE
    offsets = points[patch] - points[:, None]
    steps = offsets @ axes / _PATCH
    ones = np.ones_like(steps[:, :, :1])
    terms = np.concatenate([ones, steps], axis=2)
    weighted_terms = terms * weights[:, :, None]
    weighted = weighted_terms.transpose(0, 2, 1)
    matrix = weighted @ terms + 1e-3 * np.eye(3)  # solvable if all weights but one are 0
    tilts = patch_normals @ axes
    fits = np.linalg.solve(matrix, weighted @ tilts)
    return fits[:, 1:]


def _inner_balls(points: Floats, normals: Floats) -> Floats:
    """Return the radius (P,) of the ball that touches each point from inside and contains at most two other points.

    Points near the touching point are left out, as the error of the normal decides whether the ball contains them.
    """
    radii = np.empty(len(points))
    n_blocks = math.ceil(len(points) / _BLOCK_ROWS)
    for rows in np.array_split(np.arange(len(points)), n_blocks):
        own = points[rows]
        inward = normals[rows]
        squares = cdist(own, points, "sqeuclidean")
        own_heights = (inward * own).sum(axis=1, keepdims=True)
        depths = own_heights - inward @ points.T
        is_away = squares > _NEAR**2
        is_below = depths > _MIN_SINE * np.sqrt(squares)
        counts = is_away & is_below
        diameters = np.where(counts, 2 * depths, 1)
        # Radius of the ball that touches here and runs through each other point
        through = np.where(counts, squares / diameters, _MAX_BALL)
        smallest = np.partition(through, 2, axis=1)
        radii[rows] = smallest[:, 2]
    return np.minimum(radii, _MAX_BALL)


def _smoothed(values: Floats, points: Floats) -> Floats:
    """Return Gaussian means of the values at the points within two standard deviations of each point."""
    tree = cKDTree(points)
    pairs = tree.sparse_distance_matrix(tree, 2 * _SMOOTHING, output_type="coo_matrix")
    weights = np.exp(-np.square(pairs.data / _SMOOTHING) / 2)
    weighted = weights * values[pairs.col]
    sums = np.bincount(pairs.row, weighted, len(points))
    totals = np.bincount(pairs.row, weights, len(points))
    return sums / totals

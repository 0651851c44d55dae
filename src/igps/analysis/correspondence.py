"""Local differences between corresponding places of two bodies, independent of their poses."""

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps.data.batch import SignatureBatch

# Times of the heat kernel over the area. The kernel of large times identifies the place on the body, the kernel of
# small times depends on the surface around it
_LARGE_TIMES, _SMALL_TIMES = 0.01 * 2.0 ** np.arange(6), 0.0008 * 2.0 ** np.arange(5)
_N_CORRESPONDING = 10  # samples of the other body that correspond to a sample
_N_NEAREST = 4  # samples of the other body over which the distance is averaged
_MIN_DEVIATION = 0.1  # smallest standard deviation at a place, as a fraction of that of the whole body
_SMOOTHING = 0.06  # standard deviation of the smoothing kernel, over the square root of the area


def dissimilarity(body: SignatureBatch, other: SignatureBatch) -> Floats:
    """Return how much each surface sample of a body differs from the corresponding samples of another body.

    The ten corresponding samples are the nearest by the heat kernels (Sun, Ovsjanikov and Guibas 2009) at large times,
    which do not depend on the pose. Two measures are combined: the squared deviation of the kernels at small times from
    their mean over the corresponding samples, divided by their variance; and the mean distance to the four samples that
    are nearest by the kernels at all times. The logarithm of each is smoothed on the surface and standardised.

    Args:
        body, other: batches of one body each.

    Returns:
        (P,) the exponential of the sum of both measures, positive.
    """
    large, small = zip(*(_heat_kernels(batch) for batch in (body, other)), strict=True)
    scale = large[1].std(axis=0) + 1e-9
    _, indices = cKDTree(large[1] / scale).query(large[0] / scale, min(_N_CORRESPONDING, len(large[1])))
    corresponding = small[1][indices.reshape(len(large[0]), -1)]
    variance = corresponding.var(axis=1) + np.square(_MIN_DEVIATION * small[1].std(axis=0)) + 1e-18
    deviations = np.square(small[0] - corresponding.mean(axis=1)) / variance
    kernels = [np.hstack(both) for both in zip(large, small, strict=True)]
    scale = kernels[1].std(axis=0) + 1e-9
    distances, _ = cKDTree(kernels[1] / scale).query(kernels[0] / scale, min(_N_NEAREST, len(kernels[1])))
    points = body.surface.points[0][body.surface.mask[0]].double().numpy()
    width, total = _SMOOTHING * float(body.area[0]) ** 0.5, np.zeros(len(points))
    for values in (np.log1p(deviations.mean(axis=1)), np.log(distances.reshape(len(points), -1).mean(axis=1) + 1e-6)):
        smoothed = _smoothed(values, points, width)
        total += (smoothed - smoothed.mean()) / (smoothed.std() + 1e-12)
    return np.exp(total)


def _heat_kernels(body: SignatureBatch) -> tuple[Floats, Floats]:
    """Return log(heat kernel · area) at each surface sample, (P, times), for large and for small times."""
    area, is_sample = float(body.area[0]), body.surface.mask[0]
    squares = body.surface.eigenfunctions[0][is_sample].double().square().numpy() * area
    values = body.eigenvalues[0].double().numpy() * area
    large, small = (np.log1p(squares @ np.exp(-np.outer(values, times))) for times in (_LARGE_TIMES, _SMALL_TIMES))
    return large, small


def _smoothed(values: Floats, points: Floats, width: float) -> Floats:
    """Return Gaussian means of the values at the points within two widths of each point."""
    tree = cKDTree(points)
    pairs = tree.sparse_distance_matrix(tree, 2 * width, output_type="coo_matrix")
    weights = np.exp(-np.square(pairs.data / width) / 2)
    sums = np.bincount(pairs.row, weights * values[pairs.col], len(points))
    return sums / np.bincount(pairs.row, weights, len(points))

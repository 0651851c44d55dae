"""How unlike the places of a body are to those of another body that correspond to them, whatever the poses."""

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps.data.batch import SignatureBatch

# Times of the heat kernel, over the area: the coarse tell which place this is, the fine what the surface is like there
_COARSE, _FINE = 0.01 * 2.0 ** np.arange(6), 0.0008 * 2.0 ** np.arange(5)
# Samples of the other body that correspond to one, and the nearest of which the distance counts
_CORRESPONDING, _NEAREST = 10, 4
# Least scatter at a place, over that of the whole body
_LEAST = 0.1
# Of the root of the area, over which dissimilarity is averaged
_REACH = 0.06


def dissimilarity(body: SignatureBatch, other: SignatureBatch) -> Floats:
    """(P,) positive numbers of the surface samples of a body: how unlike they are to what corresponds to them.

    Samples of the surface correspond where heat flows alike (Sun, Ovsjanikov and Guibas 2009) over large times, which
    does not depend on the pose. A sample is unlike by as many standard deviations as its heat kernel of small times is
    away from those of the ten that correspond to it; and by how far the nearest are by all times. Both are averaged
    over the surface around and standardised; the result is the exponential of their sum. Each batch is of one body.
    """
    coarse, fine = zip(*(_heat_kernels(one) for one in (body, other)), strict=True)
    scale = coarse[1].std(axis=0) + 1e-9
    _, near = cKDTree(coarse[1] / scale).query(coarse[0] / scale, min(_CORRESPONDING, len(coarse[1])))
    alike = fine[1][near.reshape(len(coarse[0]), -1)]
    variance = alike.var(axis=1) + np.square(_LEAST * fine[1].std(axis=0)) + 1e-18
    away = np.square(fine[0] - alike.mean(axis=1)) / variance
    whole = [np.hstack(both) for both in zip(coarse, fine, strict=True)]
    scale = whole[1].std(axis=0) + 1e-9
    novel, _ = cKDTree(whole[1] / scale).query(whole[0] / scale, min(_NEAREST, len(whole[1])))
    points = body.surface.points[0][body.surface.mask[0]].double().numpy()
    reach = _REACH * float(body.area[0]) ** 0.5
    found = np.zeros(len(points))
    for values in (np.log1p(away.mean(axis=1)), np.log(novel.reshape(len(points), -1).mean(axis=1) + 1e-6)):
        around = _averaged(values, points, reach)
        found += (around - around.mean()) / (around.std() + 1e-12)
    return np.exp(found)


def _heat_kernels(body: SignatureBatch) -> tuple[Floats, Floats]:
    """(P, times) logarithms of the heat that stays at each sample of the surface, over that of the whole."""
    area, real = float(body.area[0]), body.surface.mask[0]
    squares = body.surface.eigenfunctions[0][real].double().square().numpy() * area
    values = body.eigenvalues[0].double().numpy() * area
    coarse, fine = (np.log1p(squares @ np.exp(-np.outer(values, times))) for times in (_COARSE, _FINE))
    return coarse, fine


def _averaged(values: Floats, points: Floats, reach: float) -> Floats:
    """Means with Gaussian weights of the points around each, no further than twice the reach."""
    tree = cKDTree(points)
    pairs = tree.sparse_distance_matrix(tree, 2 * reach, output_type="coo_matrix")
    weights = np.exp(-np.square(pairs.data / reach) / 2)
    sums = np.bincount(pairs.row, weights * values[pairs.col], len(points))
    return sums / np.bincount(pairs.row, weights, len(points))

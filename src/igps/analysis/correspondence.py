"""How unlike the places of a body are to those of another body that correspond to them, whatever the poses."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from igps.data.batch import SampleBatch, SignatureBatch

Values = NDArray[np.float64]

# Times of the heat kernel, over the area: the coarse tell which place this is, the fine what the surface is like there
_COARSE, _FINE = 0.01 * 2.0 ** np.arange(6), 0.0008 * 2.0 ** np.arange(5)
# Samples of the other body that correspond to one, and the nearest of which the distance counts
_CORRESPONDING, _NEAREST = 10, 4
# Least scatter at a place, over that of the whole body
_LEAST = 0.1
# The same of curvature and thickness
_LEAST_OF_FORM = 0.3
# Eigenfunctions of the maps: the first number, which is the step too, and the last; and samples that correspond then
_FUNCTIONS, _REFINED = (8, 81), 8
# Samples that tell the normal of one
_AROUND = 10
# Of the root of the area, over which curvature is taken and unlikeness is averaged
_REACH = 0.06


def unlikeness(body: SignatureBatch, other: SignatureBatch) -> Values:
    """(P,) positive numbers of the surface samples of a body: how unlike they are to what corresponds to them.

    Samples of the surface correspond where heat flows alike (Sun, Ovsjanikov and Guibas 2009) over large times, which
    does not depend on the pose; and where a map of eigenfunctions that is refined from there leads (Melzi et al. 2019).
    A sample is unlike by as many standard deviations as it is away from those that correspond to it: in its heat kernel
    of small times, by the former, in curvature and thickness, by the latter; and by how far the nearest are by all
    times. Each is averaged over the surface around and standardised; the result is the exponential of their sum.

    Args:
        body, other: a body each.
    """
    coarse, fine = zip(*(_heat_kernels(one) for one in (body, other)), strict=True)
    near = _nearest(coarse[0], coarse[1], _CORRESPONDING)
    novel = _distances(*(np.hstack(both) for both in zip(coarse, fine, strict=True)))
    parts = [np.log1p(_away(fine[0], fine[1][near], _LEAST * fine[1].std(axis=0)).mean(axis=1)), np.log(novel + 1e-6)]
    near = _refined(body, other, near)
    parts += [
        np.log1p(_away(one, others[near], _LEAST_OF_FORM * others.std()))
        for one, others in zip(_forms(body), _forms(other), strict=True)
    ]
    points = _points(body.surface)
    found = np.zeros(len(points))
    for values in parts:
        around = _averaged(values, points, _REACH * float(body.area[0]) ** 0.5)
        found += (around - around.mean()) / (around.std() + 1e-12)
    return np.exp(found)


def _away(values: Values, alike: Values, least: Values) -> Values:
    """How far values are from those of what corresponds to them, (P, n, ...), squared, over their variance."""
    away: Values = np.square(values - alike.mean(axis=1)) / (alike.var(axis=1) + np.square(least) + 1e-18)
    return away


def _nearest(one: Values, other: Values, n: int) -> NDArray[np.int64]:
    """(P, n) the rows of the other that are nearest to each."""
    scale = other.std(axis=0) + 1e-9
    near = cKDTree(other / scale).query(one / scale, min(n, len(other)))[1]
    return np.asarray(near, dtype=np.int64).reshape(len(one), -1)


def _refined(body: SignatureBatch, other: SignatureBatch, near: NDArray[np.int64]) -> NDArray[np.int64]:
    """What corresponds by maps of more and more eigenfunctions, each an isometry from the samples by the one before."""
    one, two = (_functions(batch.surface, batch) for batch in (body, other))
    for n in range(*_FUNCTIONS, _FUNCTIONS[0]):
        n = min(n, one.shape[1], two.shape[1])
        left, _, right = torch.linalg.svd(one[:, :n].T @ two[near, :n].mean(dim=1))
        away = torch.cdist(one[:, :n] @ (left @ right), two[:, :n])
        near = away.topk(min(_REFINED, len(two)), largest=False).indices.numpy()
    return near


def _functions(samples: SampleBatch, body: SignatureBatch) -> Tensor:
    """(P, K + 1) the eigenfunctions at samples, the constant one first, for an area of 1."""
    values = samples.eigenfunctions[0][samples.mask[0]].float() * body.area[0].float() ** 0.5
    return torch.cat([torch.ones(len(values), 1), values], dim=1)


def _forms(body: SignatureBatch) -> tuple[Values, Values]:
    """(P,) each: the mean curvature at samples of the surface, and the logarithm of the largest ball within there."""
    points, inside, size = _points(body.surface), _points(body.interior), float(body.area[0]) ** 0.5
    # Both are measured from centres of their own; what interpolates eigenfunctions inside interpolates places too
    at, within = (_functions(samples, body).double().numpy() for samples in (body.surface, body.interior))
    inside += (within @ np.linalg.lstsq(at, points, rcond=1e-3)[0] - inside).mean(axis=0)
    tree = cKDTree(points)
    around = points[tree.query(points, min(_AROUND, len(points)))[1]] - points[:, None]
    outward = np.linalg.svd(around - around.mean(axis=1, keepdims=True), full_matrices=False)[2][:, -1]
    away = points - inside[cKDTree(inside).query(points)[1]]
    outward *= np.where((outward * away).sum(axis=1) < 0, -1, 1)[:, None]
    reach = _REACH * size
    pairs = tree.sparse_distance_matrix(tree, reach, output_type="coo_matrix")
    heights = ((points[pairs.col] - points[pairs.row]) * outward[pairs.row]).sum(axis=1)
    weights = np.clip(1 - np.square(pairs.data / reach), 0, 1) * (
        (outward[pairs.row] * outward[pairs.col]).sum(axis=1) > 0
    )
    sums = np.bincount(pairs.row, weights * heights, len(points))
    curvature = sums / (np.bincount(pairs.row, weights, len(points)) + 1e-12) / reach
    where, normals = (torch.from_numpy(values / scale).float() for values, scale in ((points, size), (outward, 1)))
    below = (normals * where).sum(dim=1)[:, None] - normals @ where.T
    away = torch.cdist(where, where)
    radii = torch.where(below > torch.minimum(torch.tensor(0.02), 0.3 * away), away.square() / (2 * below), torch.inf)
    third = radii.topk(min(3, len(points)), largest=False).values[:, -1]
    ball = np.log(third.clamp(1e-6, 0.5).double().numpy())
    return curvature, np.median(ball[tree.query(points, min(8, len(points)))[1]], axis=1)


def _distances(one: Values, other: Values) -> Values:
    """(P,) the mean distance of each to the nearest rows of the other."""
    scale = other.std(axis=0) + 1e-9
    away = cKDTree(other / scale).query(one / scale, min(_NEAREST, len(other)))[0]
    means: Values = away.reshape(len(one), -1).mean(axis=1)
    return means


def _points(samples: SampleBatch) -> Values:
    return samples.points[0][samples.mask[0]].double().numpy()


def _heat_kernels(body: SignatureBatch) -> tuple[Values, Values]:
    """(P, times) logarithms of the heat that stays at each sample of the surface, over that of the whole."""
    area, real = float(body.area[0]), body.surface.mask[0]
    squares = body.surface.eigenfunctions[0][real].double().square().numpy() * area
    values = body.eigenvalues[0].double().numpy() * area
    coarse, fine = (np.log1p(squares @ np.exp(-np.outer(values, times))) for times in (_COARSE, _FINE))
    return coarse, fine


def _averaged(values: Values, points: Values, reach: float) -> Values:
    """Means with Gaussian weights of the points around each, no further than twice the reach."""
    tree = cKDTree(points)
    pairs = tree.sparse_distance_matrix(tree, 2 * reach, output_type="coo_matrix")
    weights = np.exp(-np.square(pairs.data / reach) / 2)
    sums = np.bincount(pairs.row, weights * values[pairs.col], len(points))
    found: Values = sums / np.bincount(pairs.row, weights, len(points))
    return found

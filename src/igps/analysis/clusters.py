"""Hierarchical clustering of bodies by their distances, and the stability of the clusters."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.cluster import hierarchy
from scipy.spatial.distance import squareform

from igps._arrays import Floats, Integers
from igps._parameters import check_at_least, check_one_of
from igps.analysis.groups import medoids_of
from igps.analysis.map import checked_distances

Linkage = Literal["average", "complete", "single"]
STABLE = 0.75
"""Clusters with a lower stability are not reliable (Hennig 2007)."""
_MAX_CLUSTERS = 30  # largest number of clusters that is tried by default


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of N bodies, cut from a hierarchical clustering."""

    labels: Integers  # (N,) cluster of each body, 0 for the largest cluster
    # Body of each cluster with the smallest sum of distances to the others
    medoids: tuple[int, ...]
    # Largest Jaccard index of each cluster with the clusters of a random half of the bodies, averaged over the halves
    # with at least two bodies of the cluster; NaN if there is no such half
    stability: tuple[float, ...]
    tree: Floats  # (N − 1, 4) result of `scipy.cluster.hierarchy.linkage`


def clusters_of(
    distances: Floats,
    n_clusters: int | None = None,
    *,
    linkage: Linkage = "average",
    n_resamples: int = 100,
    seed: int = 0,
) -> Clusters:
    """Cluster bodies by their distances.

    Args:
        distances: (N, N) distances.
        n_clusters: number of clusters; None selects the number from 2 to 30 with the largest mean silhouette
            (Rousseeuw 1987), or one cluster if no silhouette is positive.
        linkage: distance between two clusters: the mean ("average"), largest ("complete") or smallest ("single")
            distance between their bodies.
        n_resamples: number of random halves of the bodies, for the stability (Hennig 2007).
        seed: seed of the random halves.

    Raises:
        ValueError: invalid distances, or a number of clusters that is not between 1 and N.
    """
    check_one_of(get_args(Linkage), linkage=linkage)
    check_at_least(0, n_resamples=n_resamples)
    check_at_least(1, n_clusters=n_clusters)
    square = checked_distances(distances)
    n = len(distances)
    tree = _tree(square, linkage)
    if n_clusters is None:
        n_clusters = _best_number(square, tree)
    if not 1 <= n_clusters <= n:
        raise ValueError(f"n_clusters: expected 1 to {n}, got {n_clusters}.")
    labels = _by_size(_cut(tree, n_clusters))
    n_found = int(labels.max()) + 1
    jaccard = np.full((n_resamples, n_found), np.nan)
    if n > max(3, 2 * n_found):  # half of three bodies cannot be clustered
        random = np.random.default_rng(seed)
        for row in jaccard:
            half = np.sort(random.choice(n, n // 2, replace=False))
            tree_of_half = _tree(square[np.ix_(half, half)], linkage)
            resampled = _cut(tree_of_half, n_found)
            row[:] = _jaccard(labels[half], resampled, n_found)
    n_halves = np.isfinite(jaccard).sum(axis=0)
    means = np.nansum(jaccard, axis=0) / np.maximum(n_halves, 1)
    stability = np.where(n_halves, means, np.nan)
    medoids = tuple(medoids_of(square, labels))
    return Clusters(labels, medoids, tuple(stability.tolist()), tree)


def _best_number(distances: Floats, tree: Floats) -> int:
    """Return the number of clusters with the largest mean silhouette; 1 if none is positive."""
    from sklearn.metrics import silhouette_score

    best = 1
    largest = 0.0
    for n_clusters in range(2, min(_MAX_CLUSTERS, len(distances) - 1) + 1):
        labels = _cut(tree, n_clusters)
        if labels.max() == 0:
            continue
        score = silhouette_score(distances, labels, metric="precomputed")
        if score > largest:
            best = n_clusters
            largest = score
    return best


def _by_size(labels: Integers) -> Integers:
    """Number clusters anew from 0 on, the largest first."""
    largest_first = np.argsort(-np.bincount(labels), kind="stable")
    rank = np.argsort(largest_first)
    _, numbers = np.unique(rank[labels], return_inverse=True)
    return numbers


def _jaccard(original: Integers, resampled: Integers, n_clusters: int) -> Floats:
    """Return the largest Jaccard index of each original cluster with the resampled ones, among drawn bodies (n,).

    It is NaN for a cluster of at most one drawn body, which would be found again in any clustering.
    """
    original_sets = np.eye(n_clusters, dtype=np.int64)[original]
    resampled_sets = np.eye(len(resampled), dtype=np.int64)[resampled]
    n_drawn = original_sets.sum(axis=0)
    n_resampled = resampled_sets.sum(axis=0)
    intersection = original_sets.T @ resampled_sets
    union = n_drawn[:, None] + n_resampled - intersection
    indices = intersection / np.maximum(union, 1)
    largest = indices.max(axis=1)
    return np.where(n_drawn > 1, largest, np.nan)


def _tree(distances: Floats, linkage: Linkage) -> Floats:
    return hierarchy.linkage(squareform(distances, checks=False), linkage)


def _cut(tree: Floats, n_clusters: int) -> Integers:
    return hierarchy.cut_tree(tree, n_clusters).ravel().astype(np.int64)

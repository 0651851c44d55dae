"""Hierarchical clustering of bodies by their distances, and the stability of the clusters."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.cluster import hierarchy
from scipy.spatial.distance import squareform

from igps._arrays import Floats, Integers
from igps._parameters import check_at_least, check_one_of
from igps.analysis.map import checked_distances

Linkage = Literal["average", "complete", "single"]
STABLE = 0.75
"""Clusters with a lower stability are not reliable (Hennig 2007)."""
_MAX_CLUSTERS = 30  # largest number of clusters that is tried by default


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of N bodies, cut from a hierarchical clustering."""

    labels: Integers  # (N,) cluster of each body, 0 for the largest cluster
    medoids: tuple[
        int, ...
    ]  # body of each cluster with the smallest sum of distances to the others
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
    from sklearn.metrics import silhouette_score

    check_one_of(get_args(Linkage), linkage=linkage)
    check_at_least(0, n_resamples=n_resamples)
    check_at_least(1, n_clusters=n_clusters)
    square, n = checked_distances(distances), len(distances)
    tree = _tree(square, linkage)
    if n_clusters is None:
        cuts = {k: _cut(tree, k) for k in range(2, min(_MAX_CLUSTERS, n - 1) + 1)}
        scores = {
            k: silhouette_score(square, cut, metric="precomputed")
            for k, cut in cuts.items()
            if cut.max()
        }
        n_clusters = max(
            (k for k, score in scores.items() if score > 0), key=lambda k: scores[k], default=1
        )
    if not 1 <= n_clusters <= n:
        raise ValueError(f"n_clusters: expected 1 to {n}, got {n_clusters}.")
    labels = _cut(tree, n_clusters)
    _, labels = np.unique(
        np.argsort(np.argsort(-np.bincount(labels), kind="stable"))[labels], return_inverse=True
    )
    members = [np.flatnonzero(labels == number) for number in range(labels.max() + 1)]
    medoids = tuple(int(own[square[np.ix_(own, own)].sum(axis=1).argmin()]) for own in members)
    random, jaccard = np.random.default_rng(seed), np.full((n_resamples, len(members)), np.nan)
    for row in (
        jaccard if n > max(3, 2 * len(members)) else ()
    ):  # half of three bodies cannot be clustered
        half = np.sort(random.choice(n, n // 2, replace=False))
        resampled = np.eye(n, dtype=np.int64)[
            _cut(_tree(square[np.ix_(half, half)], linkage), len(members))
        ]
        original = np.eye(len(members), dtype=np.int64)[labels[half]]
        n_drawn = original.sum(axis=0)
        intersection = original.T @ resampled
        union = n_drawn[:, None] + resampled.sum(axis=0) - intersection
        # A single body does not count: it would be found again in any clustering
        row[:] = np.where(n_drawn > 1, (intersection / np.maximum(union, 1)).max(axis=1), np.nan)
    n_halves = np.isfinite(jaccard).sum(axis=0)
    stability = np.where(n_halves, np.nansum(jaccard, axis=0) / np.maximum(n_halves, 1), np.nan)
    return Clusters(labels, medoids, tuple(stability.tolist()), tree)


def _tree(distances: Floats, linkage: Linkage) -> Floats:
    return hierarchy.linkage(squareform(distances, checks=False), linkage)


def _cut(tree: Floats, n_clusters: int) -> Integers:
    return hierarchy.cut_tree(tree, n_clusters).ravel().astype(np.int64)

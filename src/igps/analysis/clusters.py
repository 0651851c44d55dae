"""Bodies in clusters, by their distances alone, and which of these clusters another sample would show again."""

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
"""A cluster whose stability is less is not to be relied on (Hennig 2007)."""
_MOST_CLUSTERS = 30


@dataclass(frozen=True, eq=False)
class Clusters:
    """A hierarchical clustering, cut."""

    labels: Integers  # (N,) the cluster of each body, 0 for the largest
    medoids: tuple[int, ...]  # of each cluster, the body with the smallest sum of distances to its others
    # Of each cluster, how much of it comes together again when half of the bodies are clustered alone: mean largest
    # Jaccard index with a cluster of them, where two of its bodies or more were drawn; NaN where that never was
    stability: tuple[float, ...]
    tree: Floats  # (N − 1, 4) as of `scipy.cluster.hierarchy.linkage`


def clusters_of(
    distances: Floats,
    n_clusters: int | None = None,
    *,
    linkage: Linkage = "average",
    n_resamples: int = 100,
    seed: int = 0,
) -> Clusters:
    """Cluster bodies.

    Args:
        distances: (N, N).
        n_clusters: how many; if None, as many of 2 to 30 as have the largest mean silhouette (Rousseeuw 1987),
            or one where none is above zero.
        linkage: two clusters are as far apart as their bodies are in mean, at most, or at least.
        n_resamples: random halves of the bodies, for the stability (Hennig 2007).
        seed: of these.

    Raises:
        ValueError: distances that cannot be clustered, or a number of clusters that cannot be had.
    """
    from sklearn.metrics import silhouette_score

    check_one_of(get_args(Linkage), linkage=linkage)
    check_at_least(0, n_resamples=n_resamples)
    check_at_least(1, n_clusters=n_clusters)
    found, n = checked_distances(distances), len(distances)
    tree = _tree(found, linkage)
    if n_clusters is None:
        cuts = {k: _cut(tree, k) for k in range(2, min(_MOST_CLUSTERS, n - 1) + 1)}
        scores = {k: silhouette_score(found, cut, metric="precomputed") for k, cut in cuts.items() if cut.max()}
        # One where no cut keeps together what is nearer than the rest, such as of bodies that are all alike
        n_clusters = max((k for k, one in scores.items() if one > 0), key=lambda k: scores[k], default=1)
    if not 1 <= n_clusters <= n:
        raise ValueError(f"n_clusters: expected 1 to {n}, got {n_clusters}.")
    numbers = _cut(tree, n_clusters)
    _, numbers = np.unique(np.argsort(np.argsort(-np.bincount(numbers), kind="stable"))[numbers], return_inverse=True)
    members = [np.flatnonzero(numbers == one) for one in range(numbers.max() + 1)]
    medoids = tuple(int(own[found[np.ix_(own, own)].sum(axis=1).argmin()]) for own in members)
    random, shares = np.random.default_rng(seed), np.full((n_resamples, len(members)), np.nan)
    for row in shares if n > max(3, 2 * len(members)) else ():  # half of three is one body, which makes no tree
        drawn = np.sort(random.choice(n, n // 2, replace=False))
        again = np.eye(n, dtype=np.int64)[_cut(_tree(found[np.ix_(drawn, drawn)], linkage), len(members))]
        first = np.eye(len(members), dtype=np.int64)[numbers[drawn]]
        n_drawn = first.sum(axis=0)
        both = first.T @ again
        either = n_drawn[:, None] + again.sum(axis=0) - both
        # A body alone is found again whatever the clusters are
        row[:] = np.where(n_drawn > 1, (both / np.maximum(either, 1)).max(axis=1), np.nan)
    counted = np.isfinite(shares).sum(axis=0)
    stability = np.where(counted, np.nansum(shares, axis=0) / np.maximum(counted, 1), np.nan)
    return Clusters(numbers, medoids, tuple(stability.tolist()), tree)


def _tree(distances: Floats, linkage: Linkage) -> Floats:
    return hierarchy.linkage(squareform(distances, checks=False), linkage)


def _cut(tree: Floats, n_clusters: int) -> Integers:
    return hierarchy.cut_tree(tree, n_clusters).ravel().astype(np.int64)

"""Bodies as points in the plane, as far from each other as their distances are, as well as that goes."""

import warnings
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.linalg import eigh
from scipy.sparse.linalg import eigsh
from scipy.spatial.distance import pdist, squareform

from igps._arrays import Floats
from igps._parameters import check_one_of

Layout = Literal["mds", "umap"]

# Entries of distance matrices that the improvement of a map may go through in all
_MOST_ENTRIES, _MOST_ROUNDS = 10**9, 300


@dataclass(frozen=True, eq=False)
class BodyMap:
    """Where bodies lie."""

    points: Floats  # (N, 2), in units of the distances for "mds", in none for "umap"
    # Root of the squared errors of all distances over their squares (Kruskal 1964), after the best scaling: 0 where the
    # map keeps every distance, above 0.2 it distorts much
    stress: float


def checked_distances(distances: Floats) -> Floats:
    """(N, N) symmetric, zero on the diagonal: the mean of both directions; a ValueError of another shape, or NaN."""
    found = np.asarray(distances, dtype=float)
    if found.ndim != 2 or len(found) != found.shape[-1] or len(found) < 3:
        raise ValueError(f"distances: expected (N, N) between three bodies or more, got {found.shape}.")
    if not np.isfinite(found).all():
        raise ValueError("distances: expected finite numbers. Leave out bodies that cannot be compared.")
    found = np.maximum((found + found.T) / 2, 0)
    np.fill_diagonal(found, 0)
    return found


def body_map(distances: Floats, layout: Layout = "mds", *, seed: int = 0) -> BodyMap:
    """Lay bodies out in the plane.

    Metric multidimensional scaling: the classical solution (Torgerson 1952), improved by SMACOF (de Leeuw 1977), as far
    as time allows for thousands of bodies. UMAP (McInnes et al. 2018) keeps neighbours together and lets go of large
    distances; it needs umap-learn. Axes are principal, with the longer tail on the positive side.

    Args:
        distances: (N, N).
        seed: of UMAP.

    Raises:
        ValueError: distances of which no map can be drawn, or another layout.
        ImportError: umap-learn is not installed.
    """
    check_one_of(get_args(Layout), layout=layout)
    wanted = checked_distances(distances)
    points = _classical(wanted) if layout == "mds" else _umap(wanted, seed)
    if layout == "mds" and (rounds := min(_MOST_ROUNDS, _MOST_ENTRIES // wanted.size)) and wanted.any():
        from sklearn.manifold import smacof

        points = smacof(wanted, init=points, n_init=1, max_iter=rounds, eps=1e-6, normalized_stress=False)[0]
    centred = points - points.mean(axis=0)
    turned = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    turned *= np.where((turned**3).sum(axis=0) < 0, -1, 1)
    return BodyMap(turned, _stress(wanted, turned))


def _classical(distances: Floats) -> Floats:
    squares, n = distances**2, len(distances)
    means = squares.mean(axis=0)
    products = (means[:, None] + means - means.mean() - squares) / 2
    if n < 500 or not products.any():  # ARPACK starts anew at random where few axes hold all, or none does
        values, axes = eigh(products, subset_by_index=(n - 2, n - 1))
    else:
        values, axes = eigsh(products, 2, which="LA", v0=np.sin(np.arange(n) + 1.0))
    return axes * np.sqrt(np.maximum(values, 0))


def import_umap() -> Any:
    """The class of umap-learn; an ImportError that names it."""
    try:
        from umap import UMAP
    except ImportError as error:
        raise ImportError("layout: umap needs umap-learn. Install it, or take mds.") from error
    return UMAP


def _umap(distances: Floats, seed: int) -> Floats:
    UMAP = import_umap()
    with warnings.catch_warnings():  # of what precomputed distances cannot do afterwards
        warnings.simplefilter("ignore", UserWarning)
        chosen = UMAP(n_neighbors=min(15, len(distances) - 1), metric="precomputed", random_state=seed, n_jobs=1)
        return chosen.fit_transform(distances).astype(float)


def _stress(wanted: Floats, points: Floats) -> float:
    one, other = squareform(wanted, checks=False), pdist(points)
    if not one.any():
        return 0.0
    other = other * ((one @ other) / max(float(other @ other), 1e-300))
    return float(np.sqrt(np.square(one - other).sum() / np.square(one).sum()))

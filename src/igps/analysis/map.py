"""Maps of bodies: points in the plane whose distances approximate those of the bodies."""

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

_MAX_ITERATIONS = 300  # of SMACOF
# Of the distance matrix times the iterations of SMACOF, which then take seconds
_MAX_ENTRIES = 10**9


@dataclass(frozen=True, eq=False)
class BodyMap:
    """Map of N bodies."""

    points: Floats  # (N, 2), in units of the distances for "mds", without unit for "umap"
    # Root of the sum of squared errors of the distances over the sum of their squares (Kruskal 1964), after the best
    # scaling: 0 means exact distances, above 0.2 strong distortion
    stress: float


def checked_distances(distances: Floats) -> Floats:
    """Return symmetric distances (N, N) with a zero diagonal; raise a ValueError for another shape, N < 3, or NaN."""
    square = np.asarray(distances, dtype=float)
    n = len(square)
    if square.shape != (n, n) or n < 3:
        raise ValueError(
            f"distances: expected (N, N) between three bodies or more, got {square.shape}."
        )
    if not np.isfinite(square).all():
        raise ValueError(
            "distances: expected finite numbers. Leave out bodies that cannot be compared."
        )
    square = np.maximum((square + square.T) / 2, 0)
    np.fill_diagonal(square, 0)
    return square


def body_map(distances: Floats, layout: Layout = "mds", *, seed: int = 0) -> BodyMap:
    """Lay bodies out in the plane.

    The layout "mds" is metric multidimensional scaling: the classical solution (Torgerson 1952), improved by SMACOF (de
    Leeuw 1977) with fewer iterations for thousands of bodies. The layout "umap" (McInnes et al. 2018) preserves
    neighbours rather than large distances, and needs umap-learn. The axes are the principal axes, with the longer tail
    on the positive side.

    Args:
        distances: (N, N) distances.
        layout: "mds" or "umap".
        seed: seed of UMAP.

    Raises:
        ValueError: invalid distances, or an unknown layout.
        ImportError: umap-learn is not installed.
    """
    check_one_of(get_args(Layout), layout=layout)
    square = checked_distances(distances)
    points = _metric_mds(square) if layout == "mds" else _umap(square, seed)
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    rotated = centred @ axes.T
    skewness = (rotated**3).sum(axis=0)
    rotated *= np.where(skewness < 0, -1, 1)
    return BodyMap(rotated, _stress(square, rotated))


def ends_of_axis(distances: Floats, axis: int) -> tuple[tuple[int, int], float]:
    """Return the two bodies at the ends of an axis of the map, and the share of the squared distances along the axis.

    Args:
        distances: (N, N) distances.
        axis: 1 or 2, see `body_map`.
    """
    along = body_map(distances).points[:, axis - 1]
    mean_square = np.square(checked_distances(distances)).mean()
    # The mean square of a distance is twice the variance
    share = 2 * float(along.var() / mean_square)
    return (int(along.argmin()), int(along.argmax())), share


def _metric_mds(distances: Floats) -> Floats:
    points = _classical_mds(distances)
    n_iterations = min(_MAX_ITERATIONS, _MAX_ENTRIES // distances.size)
    if n_iterations == 0 or not distances.any():
        return points
    from sklearn.manifold import smacof

    options = {"n_init": 1, "max_iter": n_iterations, "eps": 1e-6, "normalized_stress": False}
    return smacof(distances, init=points, **options)[0]


def _classical_mds(distances: Floats) -> Floats:
    squares = distances**2
    n = len(distances)
    means = squares.mean(axis=0)
    products = (means[:, None] + means - means.mean() - squares) / 2
    # ARPACK restarts from a random vector if the matrix has low rank or is zero
    if n < 500 or not products.any():
        values, axes = eigh(products, subset_by_index=(n - 2, n - 1))
    else:
        start = np.sin(np.arange(n) + 1.0)
        values, axes = eigsh(products, 2, which="LA", v0=start)
    return axes * np.sqrt(np.maximum(values, 0))


def import_umap() -> Any:
    """Return the class UMAP of umap-learn; raise an ImportError with a remedy if it is not installed."""
    try:
        from umap import UMAP
    except ImportError as error:
        raise ImportError("layout: umap needs umap-learn. Install it, or use mds.") from error
    return UMAP


def _umap(distances: Floats, seed: int) -> Floats:
    UMAP = import_umap()
    # UMAP warns that a fit to precomputed distances cannot transform new points
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        umap = UMAP(
            n_neighbors=min(15, len(distances) - 1),
            metric="precomputed",
            random_state=seed,
            n_jobs=1,
        )
        return umap.fit_transform(distances).astype(float)


def _stress(distances: Floats, points: Floats) -> float:
    expected = squareform(distances, checks=False)
    mapped = pdist(points)
    if not expected.any():
        return 0.0
    scale = (expected @ mapped) / max(float(mapped @ mapped), 1e-300)
    mapped = mapped * scale
    errors = np.square(expected - mapped).sum()
    return float(np.sqrt(errors / np.square(expected).sum()))

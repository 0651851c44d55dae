from itertools import product
from math import gcd

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.testing import assert_allclose
from one_body import of_signature
from scipy.sparse.csgraph import floyd_warshall
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from igps.descriptors.literature.inner_distance import METRICATION, InnerDistance, inner_distances
from igps.signature.signature import Samples, Signature, SignatureConfig
from own_descriptors import changed


def body_of(points, area=1.0):
    samples = Samples(
        points,
        np.zeros((len(points), 1), dtype=np.float32),
    )
    signature = Signature(
        np.ones(1),
        samples,
        samples,
        area,
        1.0,
        SignatureConfig(n_eigenpairs=1),
    )
    return of_signature(signature)


def block(x, y, z):
    return np.array(
        list(product(range(x), range(y), range(z))),
        dtype=float,
    )


def index_of(points, point):
    return int(np.argmin(norm(points - point, axis=1)))


def every(points):
    return inner_distances(points, np.arange(len(points)))


def links_by_looking(points):
    """Lengths of the links between cells, 0 for none: each segment is walked along in small steps."""
    cells = {tuple(int(i) for i in p) for p in points}
    links = np.zeros((len(points), len(points)))
    # Steps that never land on the border between two cells.
    steps = (np.arange(100) + 0.5) / 100
    for i, j in zip(
        *np.nonzero(cdist(points, points, "chebyshev") <= 2),
        strict=True,
    ):
        p = points[i]
        q = points[j]
        offset = np.abs(q - p).astype(int)
        if gcd(*(int(k) for k in offset)) != 1:
            continue
        on_the_way = {tuple(int(k) for k in np.round(p + t * (q - p))) for t in steps}
        if offset.max() == 1 or on_the_way <= cells:
            links[i, j] = norm(q - p)
    return links


def test_bound_is_that_of_the_98_directions():
    steps = np.array(
        [s for s in product(range(-2, 3), repeat=3) if gcd(*s) == 1],
        dtype=float,
    )
    assert len(steps) == 98
    # A path made of the steps is longest for its span where the hull of the unit steps is nearest to the origin.
    hull = ConvexHull(steps / norm(steps, axis=1, keepdims=True))
    inradius = -hull.equations[:, 3].max()
    assert 1 / inradius <= METRICATION < 1 / inradius + 1e-3


def test_box_has_euclidean_distances_within_the_bound():
    points = block(9, 7, 12) * 0.3 + [1.0, -2.0, 5.0]
    inner = every(points)
    straight = cdist(points, points)
    assert (inner >= straight - 1e-12).all()
    assert (inner <= METRICATION * straight + 1e-12).all()
    assert_allclose(inner, inner.T, atol=1e-12)


def test_random_cells_equal_floyd_and_warshall():
    generator = np.random.default_rng(3)
    points = block(6, 5, 5)[generator.random(150) < 0.45]
    expected = floyd_warshall(links_by_looking(points))
    assert np.isfinite(expected).all(), "the oracle knows no pieces"
    assert_allclose(every(points), expected, rtol=1e-12)


def test_path_goes_round_the_corner_of_an_l():
    whole = block(21, 21, 3)
    points = whole[(whole[:, 0] <= 2) | (whole[:, 1] <= 2)]
    a = index_of(points, (20, 2, 1))
    b = index_of(points, (2, 20, 1))
    exact = 2 * np.hypot(17.5, 0.5)  # by way of the edge at (2.5, 2.5)
    length = inner_distances(points, np.array([a]))[0, b]
    assert exact <= length <= METRICATION * exact
    assert length > 1.3 * np.hypot(18, 18)


def test_pieces_are_joined_at_their_closest_samples():
    points = np.concatenate(
        [
            block(3, 3, 3),
            block(3, 3, 3) + np.array([7, 0, 0]),
        ]
    )
    start = index_of(points, (0, 1, 1))
    end = index_of(points, (9, 1, 1))
    length = inner_distances(points, np.array([start]))[0, end]
    # One link of 5 cells, at any of the equally close pairs
    assert 9 <= length <= 9 * METRICATION + 4


def test_chain_of_single_cells_is_walked_along():
    points = np.array(
        [[0, 0, 0], [3, 0, 0], [7, 0, 0], [7, 5, 0], [7, 5, 1]],
        dtype=float,
    )
    assert_allclose(inner_distances(points, np.array([0]))[0], [0, 3, 7, 12, 13])


def test_cell_is_found_where_no_two_samples_are_neighbours():
    points = np.array([[0, 0, 0], [2, 0, 0], [5, 0, 0]]) * 0.1 + 0.7
    assert_allclose(inner_distances(points, np.array([0]))[0], [0, 0.2, 0.5])


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((1, 3)), "at least two"),
        (np.random.default_rng(0).random((30, 3)), "cubic grid"),
    ],
)
def test_samples_off_a_grid_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        inner_distances(points, np.array([0]))


def test_histogram_equals_a_loop_over_all_pairs():
    points = block(4, 3, 5) * 0.5
    area = 9.0
    descriptor = changed(InnerDistance(), n_bins=8, max_distance=0.8, n_sources=1000)
    lengths = floyd_warshall(links_by_looking((points / 0.5).round())) * 0.5
    expected = np.zeros(8)
    n_beyond = 0
    for i, j in product(range(len(points)), repeat=2):
        if i == j:
            continue
        position = lengths[i, j] / 3.0 / 0.8 * 8 - 0.5
        n_beyond += position > 7
        position = min(max(position, 0.0), 7.0)
        for k in range(8):
            expected[k] += max(0.0, 1 - abs(position - k))
    assert n_beyond
    histogram = descriptor.describe_body(body_of(points, area))
    assert histogram.dtype == np.float32
    assert_allclose(histogram, expected / expected.sum(), atol=1e-6)


def test_few_sources_estimate_the_whole():
    points = block(12, 8, 8) / 8
    whole = changed(InnerDistance(), n_bins=16, n_sources=1000).describe_body(body_of(points))
    few = changed(InnerDistance(), n_bins=16, n_sources=150).describe_body(body_of(points))
    assert few.sum() == pytest.approx(1, abs=1e-6)
    assert 0 < np.abs(few - whole).sum() < 0.05

"""Maps keep what distances a plane can keep; clusters are those that were put in, and chance ones are told unstable."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.distance import cdist

from igps.analysis.clusters import STABLE, clusters_of
from igps.analysis.map import body_map, ends_of_axis


def blobs(n_each, centres, scatter, seed=0):
    random = default_rng(seed)
    return np.concatenate(
        [
            random.normal(
                centre,
                scatter,
                (n_each, len(centre)),
            )
            for centre in centres
        ]
    )


@pytest.mark.parametrize("n", [5, 60])
def test_points_of_a_plane_keep_all_their_distances(n):
    points = default_rng(0).normal(size=(n, 2)) * [3, 1]
    distances = cdist(points, points)
    found = body_map(distances)
    np.testing.assert_allclose(
        cdist(found.points, found.points),
        distances,
        atol=1e-6,
    )
    assert found.stress < 1e-6
    assert found.points[:, 0].var() > found.points[:, 1].var()
    order = default_rng(1).permutation(n)
    shuffled = body_map(distances[np.ix_(order, order)])
    np.testing.assert_allclose(shuffled.points, found.points[order], atol=1e-5)


def test_the_improved_map_has_less_stress_than_the_classical_one():
    points = default_rng(0).normal(size=(40, 6))
    distances = cdist(points, points)
    centring = np.eye(40) - 1 / 40
    values, axes = np.linalg.eigh(-centring @ distances**2 @ centring / 2)
    classical = axes[:, -2:] * np.sqrt(values[-2:])

    def stress(plane):
        other = cdist(plane, plane)
        other *= (distances * other).sum() / (other**2).sum()
        return float(np.sqrt(((distances - other) ** 2).sum() / (distances**2).sum()))

    found = body_map(distances)
    assert found.stress == pytest.approx(stress(found.points))
    assert found.stress < stress(classical) - 0.01


@pytest.mark.parametrize("n", [4, 600])
def test_alike_bodies_lie_in_one_point(n):
    found = body_map(np.zeros((n, n)))
    assert not found.points.any()
    assert found.stress == 0


UMAP = """
from sys import argv
import numpy as np
from igps.analysis.map import body_map
np.save(argv[2], body_map(np.load(argv[1]), "umap").points)
"""


def test_umap_puts_clusters_apart(tmp_path):
    """In a process in which nothing is compiled, which would take longer than thirty points."""
    pytest.importorskip("umap", reason="umap-learn is not installed")
    points = blobs(15, [[0, 0, 0], [9, 0, 0]], 0.5)
    np.save(tmp_path / "distances.npy", cdist(points, points))
    command = [sys.executable, "-c", UMAP, "distances.npy", "map.npy"]
    uncompiled = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(command, check=True, cwd=tmp_path, env=uncompiled)
    found = np.load(tmp_path / "map.npy")
    assert cdist(found[:15], found[:15]).max() < cdist(found[:15], found[15:]).min()


@pytest.mark.parametrize(
    ("distances", "match"),
    [
        (np.ones((2, 2)), "three bodies"),
        (np.ones((4, 3)), "got .4, 3"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_what_are_no_distances_is_refused(distances, match):
    with pytest.raises(ValueError, match=match):
        body_map(distances)
    with pytest.raises(ValueError, match=match):
        clusters_of(distances)


def test_words_and_numbers_that_are_none_are_refused():
    with pytest.raises(ValueError, match="mds, umap"):
        body_map(np.ones((4, 4)), "tsne")
    with pytest.raises(ValueError, match="average"):
        clusters_of(np.ones((4, 4)), linkage="ward")
    with pytest.raises(ValueError, match="1 to 4, got 9"):
        clusters_of(np.ones((4, 4)), 9)
    with pytest.raises(ValueError, match="n_resamples: expected at least 0, got -1"):
        clusters_of(np.ones((4, 4)), n_resamples=-1)


@pytest.mark.parametrize("linkage", ["average", "single"])
def test_clusters_that_were_put_in_are_found_and_stable(linkage):
    large = blobs(20, [[0, 0, 0]], 0.4)
    points = np.concatenate(
        [
            large,
            blobs(12, [[9, 0, 0], [0, 9, 0]], 0.4, seed=1),
        ]
    )
    found = clusters_of(cdist(points, points), linkage=linkage)
    assert found.labels[:20].tolist() == [0] * 20
    assert sorted(found.labels[20:].tolist()) == [1] * 12 + [2] * 12
    assert np.ptp(found.labels[20:32]) == np.ptp(found.labels[32:]) == 0
    assert min(found.stability) > 0.99
    for number, middle in enumerate(found.medoids):
        own = points[found.labels == number]
        assert np.allclose(
            points[middle],
            own[cdist(own, own).sum(axis=1).argmin()],
        )


def test_bodies_that_are_alike_are_one_cluster():
    for apart in (0.0, 1.0):  # all of them, or each from each other by the same
        for n in (3, 4, 6):
            assert clusters_of(apart * (np.ones((n, n)) - np.eye(n))).labels.tolist() == [0] * n


def test_clusters_of_one_cloud_are_told_unstable():
    random = default_rng(3)
    found = []
    for _ in range(5):
        points = random.normal(size=(80, 5))
        found += clusters_of(cdist(points, points), 6, linkage="complete").stability
    assert len(found) == 30
    assert np.mean(np.array(found) >= STABLE) < 0.05


def test_a_body_alone_has_no_stability():
    """A cluster of one body has stability NaN; under 70 % of chance clusters of two bodies count as stable."""
    points = np.concatenate(
        [
            blobs(20, [[0, 0, 0]], 0.4),
            [[50.0, 0, 0]],
        ]
    )
    assert np.isnan(clusters_of(cdist(points, points), 2).stability[1])
    pairs = []
    for seed in range(3):
        points = default_rng(seed).normal(size=(80, 5))
        found = clusters_of(cdist(points, points), 22, linkage="complete")
        of_two = np.flatnonzero(np.bincount(found.labels) == 2)
        pairs += [found.stability[k] >= STABLE for k in of_two]
    assert len(pairs) > 10
    assert np.mean(pairs) < 0.7


def test_stability_is_the_mean_largest_jaccard_index_of_halves():
    """Against a loop over sets, on the same halves."""
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import pdist

    points = default_rng(4).normal(size=(30, 2)) * [4, 1]
    found = clusters_of(
        cdist(points, points),
        3,
        n_resamples=20,
        seed=5,
    )
    first = [set(np.flatnonzero(found.labels == one).tolist()) for one in range(3)]

    random = default_rng(5)
    shares = [[], [], []]
    for _ in range(20):
        drawn = np.sort(random.choice(30, 15, replace=False))
        cut = fcluster(linkage(pdist(points[drawn]), "average"), 3, "maxclust")
        again = [set(drawn[cut == one].tolist()) for one in set(cut)]
        for own, of in zip(first, shares, strict=True):
            left = own & set(drawn.tolist())
            if len(left) > 1:
                of.append(max(len(left & one) / len(left | one) for one in again))
    assert found.stability == pytest.approx([np.mean(of) for of in shares])


def test_too_few_bodies_have_no_stability():
    points = default_rng(6).normal(size=(4, 2))
    assert np.isnan(clusters_of(cdist(points, points), 3).stability).all()


def test_the_ends_of_an_axis_and_what_it_holds():
    """Points of a cross: the longer arm has its share of the squared distances, by the variances."""
    points = np.array(
        [
            [-3.0, 0],
            [0, 0],
            [4, 0],
            [0, 1],
            [0, -1],
        ]
    )
    distances = np.linalg.norm(
        points[:, None] - points,
        axis=2,
    )
    variances = points.var(axis=0)
    for axis, ends in ((1, {0, 2}), (2, {3, 4})):
        found, share = ends_of_axis(distances, axis)
        assert set(found) == ends
        expected = pytest.approx(
            variances[axis - 1] / variances.sum(),
            rel=1e-3,
        )
        assert share == expected

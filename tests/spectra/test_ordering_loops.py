"""The ordering: compiled and plain, it is the same; and it separates."""

from __future__ import annotations

import numpy as np
import pytest
from problems import torus
from scipy import sparse

from igps._compiled import is_available
from igps.spectra import _ordering as ordering


def random_graph(n: int, seed: int) -> sparse.csr_array:
    pattern = sparse.random_array((n, n), density=min(1, 2 / n), rng=np.random.default_rng(seed))
    return sparse.csr_array(pattern + pattern.T + sparse.eye_array(n))


def mesh_graph() -> tuple[sparse.csr_array, np.ndarray]:
    mesh = torus()
    i, j = mesh.edges_unique.T
    n = len(mesh.vertices)
    graph = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
    return sparse.csr_array(graph + graph.T + sparse.eye_array(n)), np.array(mesh.vertices)


@pytest.mark.skipif(not is_available(), reason="needs numba, the extra [fast]")
@pytest.mark.parametrize("leaf_size", [1, 5, 32, 5000])
@pytest.mark.parametrize("n", [1, 2, 17, 300, 0])
def test_the_compiled_ordering_is_the_plain_one(n: int, leaf_size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    if n:
        graph, places = random_graph(n, seed=n), np.random.default_rng(n).integers(0, 9, (n, 2)).astype(float)
    else:
        graph, places = mesh_graph()
    node, n_levels = ordering.nested_dissection(graph, places, leaf_size)
    monkeypatch.setattr(ordering, "is_available", lambda: False)
    expected, expected_levels = ordering.nested_dissection(graph, places, leaf_size)
    assert n_levels == expected_levels
    np.testing.assert_array_equal(node, expected)


@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize("leaf_size", [5, 32])
def test_no_edge_joins_two_branches(leaf_size: int) -> None:
    """Of two neighbours' nodes, one is the other's ancestor or the same: or else the fronts would lack an entry."""
    graph, places = mesh_graph()
    node, n_levels = ordering.nested_dissection(graph, places, leaf_size)
    assert node.max() < 2**n_levels - 1
    for i, j in zip(*graph.nonzero(), strict=True):
        upper, lower = sorted((int(node[i]), int(node[j])))
        while lower > upper:
            lower = (lower - 1) // 2
        assert lower == upper

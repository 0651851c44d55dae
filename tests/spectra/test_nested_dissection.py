"""The ordering: its separators separate, and are the smallest that a cut can have."""

from __future__ import annotations

import numpy as np
import pytest
from problems import torus
from scipy import sparse

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


def smallest_cut(graph: np.ndarray, places: np.ndarray, part: np.ndarray) -> int:
    """The fewest vertices on one side of a cut with a neighbour behind it, by trying all cuts within the window."""
    n = len(part)
    sizes = []
    for column in places.T:
        order = part[np.argsort(column[part], kind="stable")]
        for cut in range(1, n):
            if abs(cut - n / 2) <= max(ordering.CUT_WINDOW * n, 1):
                across = graph[np.ix_(order[:cut], order[cut:])]
                sizes += [int(across.any(axis=1).sum()), int(across.any(axis=0).sum())]
    return min(sizes, default=0)


@pytest.mark.parametrize("leaf_size", [1, 5, 32, 5000])
@pytest.mark.parametrize("n", [1, 2, 17, 300, 0])
def test_every_separator_is_the_smallest_and_separates(n, leaf_size):
    if n:
        graph = random_graph(n, seed=n)
        places = np.random.default_rng(n).integers(0, 9, (n, 2)).astype(float)
    else:
        graph, places = mesh_graph()
    node, n_levels = ordering.nested_dissection(graph, places, leaf_size)
    dense = graph.toarray() != 0
    assert n_levels == 1 + max(0, int(np.ceil(np.log2(len(places) / leaf_size))))
    assert node.max() < 2**n_levels - 1
    members: dict[int, list[int]] = {place: [] for place in range(2**n_levels - 1)}
    for vertex, place in enumerate(node.tolist()):
        while place >= 0:
            members[place].append(vertex)
            place = (place - 1) // 2 if place else -1
    for place in range(2 ** (n_levels - 1) - 1):
        part, left, right = (
            np.array(members[k], dtype=int) for k in (place, 2 * place + 1, 2 * place + 2)
        )
        assert not dense[np.ix_(left, right)].any()
        assert (node[part] == place).sum() == smallest_cut(dense, places, part)

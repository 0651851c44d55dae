"""The sparse factorization against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import sparse

from igps.linalg.factorization import SingularMatrixError, factorize
from igps.linalg.symbolic import dissect


def grid_matrix(n: int, seed: int = 0) -> tuple[sparse.csr_array, np.ndarray]:
    """A symmetric indefinite matrix on a jittered, triangulated n × n grid, and the places of its vertices."""
    rng = np.random.default_rng(seed)
    index = np.arange(n * n).reshape(n, n)
    pairs = [(index[1:], index[:-1]), (index[:, 1:], index[:, :-1]), (index[1:, 1:], index[:-1, :-1])]
    rows, columns = (np.concatenate([pair[side].ravel() for pair in pairs]) for side in (0, 1))
    weights = rng.uniform(0.5, 2, len(rows))
    off_diagonal = sparse.coo_array((weights, (rows, columns)), shape=(n * n, n * n))
    matrix = off_diagonal + off_diagonal.T + sparse.diags_array(rng.normal(size=n * n))
    places = np.stack(np.meshgrid(range(n), range(n)), axis=-1).reshape(-1, 2) + rng.uniform(0, 0.3, (n * n, 2))
    return sparse.csr_array(matrix), places


def random_graph_matrix(n: int, seed: int) -> sparse.csr_array:
    """A symmetric matrix on a random graph, not connected and without any geometry."""
    pattern = sparse.random_array((n, n), density=min(1, 1.5 / n), rng=np.random.default_rng(seed))
    diagonal = np.random.default_rng(seed).normal(size=n)
    return sparse.csr_array(pattern + pattern.T + sparse.diags_array(diagonal))


@pytest.mark.parametrize("shift", [-20.0, 0.37, 3.0])
@pytest.mark.parametrize("leaf_size", [4, 32, 10_000])
@pytest.mark.parametrize("with_places", [True, False])
def test_solve_and_inertia_on_a_grid(shift: float, leaf_size: int, with_places: bool) -> None:
    matrix, places = grid_matrix(23)
    dense = matrix.toarray() - shift * np.eye(matrix.shape[0])
    right = np.random.default_rng(1).normal(size=(len(dense), 5))
    factors = factorize(dissect(matrix, places if with_places else None, leaf_size=leaf_size), matrix, shift)
    solution = factors.solve(torch.from_numpy(right)).numpy()
    # pivoting only within blocks: no digit is lost for a definite matrix, some are for an indefinite one
    np.testing.assert_allclose(dense @ solution, right, atol=1e-12 if shift == -20 else 1e-4)
    assert factors.n_negative == (np.linalg.eigvalsh(dense) < 0).sum()


@pytest.mark.parametrize("n", [1, 2, 3, 7, 60, 400])
def test_solve_and_inertia_on_random_graphs(n: int) -> None:
    matrix = random_graph_matrix(n, seed=n)
    dense = matrix.toarray()
    factors = factorize(dissect(matrix, leaf_size=8), matrix)
    right = np.random.default_rng(n).normal(size=(n, 2))
    np.testing.assert_allclose(dense @ factors.solve(torch.from_numpy(right)).numpy(), right, atol=1e-7)
    assert factors.n_negative == (np.linalg.eigvalsh(dense) < 0).sum()


def test_coinciding_places_are_allowed() -> None:
    matrix, _ = grid_matrix(12)
    factors = factorize(dissect(matrix, np.zeros((144, 3)), leaf_size=8), matrix, -20.0)
    right = np.random.default_rng(0).normal(size=(144, 1))
    dense = matrix.toarray() + 20 * np.eye(144)
    np.testing.assert_allclose(
        factors.solve(torch.from_numpy(right)).numpy(), np.linalg.solve(dense, right), atol=1e-10
    )


def test_a_separator_keeps_blocks_small() -> None:
    """On an n × n grid the root needs about n unknowns; a cut through the wrong place would need many more."""
    matrix, places = grid_matrix(40)
    root = dissect(matrix, places).levels[-1]
    assert len(root.own) <= 1.5 * 40


def test_one_dissection_serves_other_values() -> None:
    matrix, places = grid_matrix(15)
    dissection = dissect(matrix, places)
    other = matrix.copy()
    other.data *= 3
    right = torch.ones(225, 1, dtype=torch.float64)
    thrice = factorize(dissection, other, 0.3).solve(right)
    torch.testing.assert_close(thrice, factorize(dissection, matrix, 0.1).solve(right) / 3, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="dissect it anew"):
        factorize(dissection, grid_matrix(16)[0])


def test_arguments_are_left_alone() -> None:
    matrix, places = grid_matrix(10)
    unsorted = sparse.csr_array((matrix.data.copy(), matrix.indices.copy(), matrix.indptr.copy()), shape=matrix.shape)
    row = slice(matrix.indptr[5], matrix.indptr[6])
    unsorted.indices[row], unsorted.data[row] = unsorted.indices[row][::-1], unsorted.data[row][::-1]
    before = unsorted.indices.copy(), unsorted.data.copy(), places.copy()
    right = torch.ones(100, 2, dtype=torch.float64)
    solution = factorize(dissect(unsorted, places), unsorted, 0.1).solve(right)
    for now, then in zip((unsorted.indices, unsorted.data, places), before, strict=True):
        np.testing.assert_array_equal(now, then)
    assert torch.equal(right, torch.ones(100, 2, dtype=torch.float64))
    torch.testing.assert_close(solution, factorize(dissect(matrix, places), matrix, 0.1).solve(right))


def test_what_is_refused() -> None:
    matrix, places = grid_matrix(6)
    with pytest.raises(ValueError, match="must store entry"):
        dissect(sparse.csr_array(sparse.triu(matrix)), places)
    with pytest.raises(ValueError, match="diagonal"):
        dissect(sparse.csr_array(matrix - sparse.diags_array(matrix.diagonal())), places)
    with pytest.raises(ValueError, match="coordinates"):
        dissect(matrix, places[:-1])
    zero = sparse.csr_array((np.zeros(4), np.arange(4), np.arange(5)), shape=(4, 4))
    with pytest.raises(SingularMatrixError):
        factorize(dissect(zero), zero)

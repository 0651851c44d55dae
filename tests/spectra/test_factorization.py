"""The sparse factorization against dense linear algebra."""

import functools

import numpy as np
import pytest
import torch
import trimesh
from numpy.random import default_rng
from problems import cotangent_problem, torus
from scipy import sparse

from conftest import with_slivers
from igps._threads import Team
from igps.spectra.multifrontal import SingularMatrixError, analyse
from igps.spectra.tree import BLOCK

# A single block of all unknowns is not cut, with places or without
SPLITS = [(4, False), (32, True), (10_000, True)]
EPSILON = float(np.finfo(float).eps)


def grid_matrix(n, seed=0):
    """A symmetric indefinite matrix on a jittered, triangulated n × n grid, and the places of its vertices."""
    rng = default_rng(seed)
    index = np.arange(n * n).reshape(n, n)
    pairs = [
        (index[1:], index[:-1]),
        (index[:, 1:], index[:, :-1]),
        (index[1:, 1:], index[:-1, :-1]),
    ]
    rows, columns = (np.concatenate([pair[side].ravel() for pair in pairs]) for side in (0, 1))
    weights = rng.uniform(0.5, 2, len(rows))
    off_diagonal = sparse.coo_array((weights, (rows, columns)), shape=(n * n, n * n))
    matrix = off_diagonal + off_diagonal.T + sparse.diags_array(rng.normal(size=n * n))
    places = np.stack(np.meshgrid(range(n), range(n)), axis=-1).reshape(-1, 2) + rng.uniform(
        0, 0.3, (n * n, 2)
    )
    return sparse.csr_array(matrix), places


def random_graph_matrix(n, seed):
    """A symmetric matrix on a random graph, not connected and without any geometry."""
    pattern = sparse.random_array((n, n), density=min(1, 1.5 / n), rng=default_rng(seed))
    diagonal = default_rng(seed).normal(size=n)
    return sparse.csr_array(pattern + pattern.T + sparse.diags_array(diagonal))


@functools.cache
def sliver_matrix():
    """M^-½ L M^-½ of a torus some faces of which are slivers, in units of 1/area, and the places of its vertices."""
    mesh = torus(jitter=0)
    vertices, faces = with_slivers(np.array(mesh.vertices), np.array(mesh.faces), 30)
    stiffness, mass, places = cotangent_problem(trimesh.Trimesh(vertices, faces, process=False))
    assert abs(stiffness).max() > 1000
    scale = sparse.diags_array(np.sqrt(mass.sum() / mass))
    return sparse.csr_array(scale @ stiffness @ scale), places


@functools.cache
def sliver_eigenvalues():
    return np.linalg.eigvalsh(sliver_matrix()[0].toarray())


def backward_error(matrix, solution, right, norm=None):
    """The relative change of the matrix for which the solution would be exact (Rigal and Gaches 1967)."""
    residual = np.linalg.norm(matrix @ solution - right)
    return float(residual / ((norm or np.linalg.norm(matrix, 2)) * np.linalg.norm(solution)))


def eliminations(factors):
    """E of every node that has one."""
    structure = factors.tree.structure
    found = []
    starts = structure.nodes[BLOCK]
    for node, n_own in enumerate(structure.n_own):
        block = factors.blocks[starts[node] : starts[node + 1]]
        found.append(block.reshape(n_own, -1)[:, n_own:] if n_own else block)
    return [elimination for elimination in found if elimination.size]


def elimination_growth(factors):
    """The largest norm of the multipliers E of one elimination, at least 1."""
    return max(
        [1.0, *(float(np.linalg.norm(elimination)) for elimination in eliminations(factors))]
    )


@pytest.mark.parametrize("shift", [-20.0, 0.37, 3.0])
@pytest.mark.parametrize(("leaf_size", "with_places"), SPLITS)
def test_solve_and_inertia_on_a_grid(shift, leaf_size, with_places):
    matrix, places = grid_matrix(23)
    dense = matrix.toarray() - shift * np.eye(matrix.shape[0])
    right = default_rng(1).normal(size=(len(dense), 5))
    structure = analyse(matrix, places if with_places else None, leaf_size=leaf_size)
    factors = structure.factorize(matrix, shift)
    solution = factors.solve(torch.from_numpy(right)).numpy()
    # Pivoting only within blocks, only the growth of what is eliminated costs digits: none where the matrix is definite
    # or a single block. The square is the bound for any matrix, and far too large for most.
    growth = elimination_growth(factors)
    assert growth == 1 or (shift != -20 and leaf_size < 10_000)
    assert backward_error(dense, solution, right) < EPSILON * min(10 * growth**2, 1000 * growth)
    assert factors.n_negative == (np.linalg.eigvalsh(dense) < 0).sum()


@pytest.mark.parametrize("shift", [-1.0, 700.0])
@pytest.mark.parametrize(("leaf_size", "with_places"), SPLITS)
def test_slivers_and_shifts_among_the_eigenvalues_cost_no_digits(shift, leaf_size, with_places):
    """As the eigensolver uses it: eigenvalues from 0 to 10⁷, of which the shift has none to some hundred below it.

    One shift in about a hundred lies so close to an eigenvalue of a leading block that it does cost digits.
    """
    matrix, places = sliver_matrix()
    structure = analyse(matrix, places if with_places else None, leaf_size=leaf_size)
    right = default_rng(1).normal(size=(matrix.shape[0], 5))
    errors = []
    for other in (0.8 * shift, shift, 1.25 * shift):
        shifted = matrix.toarray() - other * np.eye(matrix.shape[0])
        factors = structure.factorize(matrix, other)
        eigenvalues = sliver_eigenvalues() - other
        solution = factors.solve(torch.from_numpy(right)).numpy()
        errors.append(backward_error(shifted, solution, right, np.abs(eigenvalues).max()))
        n_negative = (eigenvalues < 0).sum()
        assert factors.n_negative == structure.inertia(matrix, other) == n_negative
    assert np.median(errors) < 100 * EPSILON
    assert max(errors) < 1e4 * EPSILON


@pytest.mark.parametrize("n", [1, 2, 60, 400])
def test_solve_and_inertia_on_random_graphs(n):
    matrix = random_graph_matrix(n, seed=n)
    dense = matrix.toarray()
    factors = analyse(matrix, leaf_size=8).factorize(matrix)
    right = default_rng(n).normal(size=(n, 2))
    solution = factors.solve(torch.from_numpy(right)).numpy()
    assert backward_error(dense, solution, right) < 10 * EPSILON
    assert factors.n_negative == (np.linalg.eigvalsh(dense) < 0).sum()


def test_subtrees_eliminated_side_by_side():
    """The five-point Laplacian of as large a grid, its inertia from its eigenvalues: a team changes no bit."""
    line = sparse.diags_array([[-1.0] * 142, [2.0] * 143, [-1.0] * 142], offsets=[-1, 0, 1])
    one = sparse.eye_array(143)
    matrix = sparse.csr_array(sparse.kron(line, one) + sparse.kron(one, line))
    places = np.stack(np.meshgrid(range(143), range(143)), axis=-1).reshape(-1, 2)
    of_line = 2 - 2 * np.cos(np.arange(1, 144) * np.pi / 144)
    eigenvalues = np.sort((of_line[:, None] + of_line).ravel())
    behind = 500 + int(np.diff(eigenvalues[500:600]).argmax())
    shift = float(eigenvalues[behind : behind + 2].mean())
    structure = analyse(matrix, places)
    factors = structure.factorize(matrix, shift)
    assert factors.n_negative == structure.inertia(matrix, shift) == behind + 1
    right = torch.from_numpy(default_rng(1).normal(size=(143**2, 2)))
    solution = factors.solve(right)
    residual = matrix @ solution.numpy() - shift * solution.numpy() - right.numpy()
    assert np.abs(residual).max() < 1e4 * EPSILON * 8 * float(solution.abs().max())
    with Team(3) as team:
        for _ in range(3):
            again = structure.factorize(matrix, shift, team)
            assert torch.equal(again.solve(right), solution)
            assert again.n_negative == structure.inertia(matrix, shift, team) == behind + 1


def test_a_separator_keeps_blocks_small():
    """On an n × n grid the root needs about n unknowns; a cut through the wrong place would need many more."""
    matrix, places = grid_matrix(40)
    assert analyse(matrix, places).structure.n_own[-1] <= 1.5 * 40


def test_what_is_refused():
    matrix, places = grid_matrix(6)
    with pytest.raises(ValueError, match="got an asymmetric pattern"):
        analyse(sparse.csr_array(sparse.triu(matrix)), places)
    with pytest.raises(ValueError, match="diagonal"):
        analyse(sparse.csr_array(matrix - sparse.diags_array(matrix.diagonal())), places)
    with pytest.raises(ValueError, match="coordinates"):
        analyse(matrix, places[:-1])
    zero = sparse.csr_array((np.zeros(4), np.arange(4), np.arange(5)), shape=(4, 4))
    with pytest.raises(SingularMatrixError):
        analyse(zero).factorize(zero)

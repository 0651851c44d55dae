"""Pivot blocks inverted by the compiled loops, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from igps.spectra._pivots import STEP, Scratch, invert_front


def invert(matrix: np.ndarray) -> tuple[int, np.ndarray]:
    """What the loops say of a pivot block: its negative eigenvalues, and its inverse."""
    n = len(matrix)
    width = -(-n // STEP) * STEP
    front = np.full((n, n + 3), np.nan)
    front[:, :n] = np.triu(matrix)
    squares = [np.full(n * width, np.nan) for _ in range(3)]
    strips = [np.full(STEP * (width + STEP), np.nan) for _ in range(2)]
    scratch = Scratch(np.empty(0, dtype=np.int64), front.ravel(), *squares, *strips)
    return invert_front(scratch, n, n + 3, width), scratch.inverse.reshape(n, width)[:, :n]


@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 26, 63, 120])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_block_is_inverted_and_its_negative_eigenvalues_counted(n, share):
    rng = np.random.default_rng(n)
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    eigenvalues = rng.uniform(1, 3, n) * np.where(np.arange(n) < share * n, -1, 1)
    n_negative, inverse = invert(vectors * eigenvalues @ vectors.T)
    if n_negative < 0:  # neither order of the pivots will do
        assert 0 < share < 1
        assert n > 2
    else:
        assert n_negative == (eigenvalues < 0).sum()
        np.testing.assert_allclose(inverse, vectors / eigenvalues @ vectors.T, rtol=0, atol=1e-12)


def test_most_indefinite_blocks_are_inverted():
    """Shifted Laplacians on a line against NumPy: at most 3 of 56 blocks are refused, and no result is wrong."""
    refused = 0
    for n in range(5, 61):
        matrix = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1) - 0.37 * np.eye(n)
        n_negative, inverse = invert(matrix)
        if n_negative < 0:
            refused += 1
            continue
        assert n_negative == (np.linalg.eigvalsh(matrix) < 0).sum()
        np.testing.assert_allclose(matrix @ inverse, np.eye(n), rtol=0, atol=1e-11)
    assert refused <= 3


@pytest.mark.parametrize("n", [2, 3, 10, 19])
@pytest.mark.parametrize("tiny", [0.0, 1e-9])
def test_pivots_that_are_too_small_are_taken_last(n, tiny):
    """An arrow's: its tip, nearly 0, is the first of the pivots; backwards, it is the last."""
    matrix = np.diag(np.arange(1.0, n + 1))
    matrix[0, 1:] = matrix[1:, 0] = 1.0
    matrix[0, 0] = tiny
    n_negative, inverse = invert(matrix)
    assert n_negative == 1
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=0, atol=1e-13)


@pytest.mark.parametrize("tiny", [0.0, 1e-9, np.nan])
def test_a_block_with_small_pivots_at_both_ends_is_refused(tiny):
    matrix = np.eye(6)
    matrix[:2, :2] = matrix[4:, 4:] = [[tiny, 1], [1, tiny]]
    assert invert(matrix)[0] == -1

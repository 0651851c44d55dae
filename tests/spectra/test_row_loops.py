"""Products of a few rows with many, against NumPy's: whatever the numbers of rows are, and wherever a piece begins."""

from __future__ import annotations

import numpy as np
import pytest

from igps._compiled import is_available

pytestmark = pytest.mark.skipif(not is_available(), reason="needs numba, the extra [fast]")

N_ROWS = [(1, 1), (3, 2), (4, 6), (5, 7), (8, 13), (12, 24), (24, 41)]
# One that is shorter than a strip, and one that is longer than a chunk
PIECES = [(0, 9), (17, 4999)]
N_COLUMNS = 5003


def rows(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, N_COLUMNS))


@pytest.mark.parametrize("piece", PIECES)
@pytest.mark.parametrize("n_rows", N_ROWS)
def test_overlaps_are_the_products_of_the_rows(n_rows: tuple[int, int], piece: tuple[int, int]) -> None:
    from igps.spectra._row_loops import overlaps

    a, b = rows(n_rows[0], seed=0), rows(n_rows[1], seed=1)
    columns = slice(*piece)
    np.testing.assert_allclose(overlaps(a, b, *piece), a[:, columns] @ b[:, columns].T, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("precision", "error"), [(np.float64, 1e-13), (np.float32, 1e-5)])
@pytest.mark.parametrize("piece", PIECES)
@pytest.mark.parametrize("n_rows", N_ROWS)
def test_subtract_takes_the_product_from_a_piece(
    n_rows: tuple[int, int], piece: tuple[int, int], precision: type, error: float
) -> None:
    from igps.spectra._row_loops import subtract

    before, others = rows(n_rows[0], seed=0), rows(n_rows[1], seed=1).astype(precision)
    factors = np.random.default_rng(2).standard_normal(n_rows).astype(precision)
    found = before.copy()
    subtract(found, factors, others, *piece)
    expected, columns = before.copy(), slice(*piece)
    expected[:, columns] -= factors.astype(np.float64) @ others[:, columns].astype(np.float64)
    np.testing.assert_allclose(found, expected, rtol=0, atol=error * np.abs(expected).max())
    outside = np.ones(N_COLUMNS, dtype=bool)
    outside[columns] = False
    np.testing.assert_array_equal(found[:, outside], before[:, outside])


def test_what_is_taken_out_in_single_precision_leaves_the_rows_in_double() -> None:
    """Of rows of length 1, a part of 1e-9 is taken out to 1e-15: the factors are rounded, the rows are not."""
    from igps.spectra._row_loops import overlaps, subtract

    basis = np.linalg.qr(rows(20, seed=3).T)[0].T.copy()
    old, new = basis[:16], basis[16:] + 1e-9 * basis[:4]
    lost = overlaps(new, old, 0, N_COLUMNS)
    subtract(new, lost.astype(np.float32), old.astype(np.float32), 0, N_COLUMNS)
    assert np.abs(lost).max() > 0.9e-9
    assert np.abs(new @ old.T).max() < 1e-15

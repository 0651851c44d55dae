"""Products of small matrices, and of a few rows with many, against NumPy's: of any shape, from anywhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from llvmlite import binding

from igps.spectra._products import loops_beat_blas, overlaps, product, subtract

SHAPES = [
    (1, 1, 1),
    (6, 8, 5),
    (7, 9, 3),
    (13, 7, 20),
    (5, 1, 40),
    (30, 31, 30),
    (12, 12, 0),
    (0, 8, 4),
    (2, 16, 1),
]
N_ROWS = [(1, 1), (3, 2), (4, 6), (5, 7), (8, 13), (12, 24), (24, 41)]
# A short one, and one that is longer than a chunk
PIECES = [(0, 9), (17, 4999)]
N_COLUMNS = 5003


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize("transposed", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_product_in_tiles(shape, transposed, keep):
    """Between other numbers, which stay as they are."""
    m, n, k = shape
    rng = np.random.default_rng(0)
    a = rng.normal(size=(k, m))
    x = rng.normal(size=(k, n + 2))
    source = rng.normal(size=(m, n + 1))
    before = rng.normal(size=(m + 2, n + 5))
    out = before.copy()
    laid_out = np.ascontiguousarray(a.T) if transposed else a
    strides = (1, k) if transposed else (m, 1)
    product(
        shape,
        -0.5,
        (laid_out.ravel(), 0, *strides),
        (x.ravel(), 1, n + 2),
        keep,
        (source.ravel(), 0, n + 1),
        (out.ravel(), n + 5 + 3, n + 5),
    )
    expected = before.copy()
    expected[1 : m + 1, 3 : n + 3] = keep * source[:, :n] - 0.5 * a.T @ x[:, 1 : n + 1]
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-13)


def test_a_product_of_whole_tiles_may_be_added_in_place():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(5, 9))
    x = rng.normal(size=(5, 24))
    out = rng.normal(size=(9, 24))
    expected = out + a.T @ x
    whole = out.ravel(), 0, 24
    product((9, 24, 5), 1.0, (a.ravel(), 0, 9, 1), (x.ravel(), 0, 24), True, whole, whole)
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-13)


def rows(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, N_COLUMNS))


@pytest.mark.usefixtures("either_processor")
@pytest.mark.parametrize("piece", PIECES)
@pytest.mark.parametrize("n_rows", N_ROWS)
def test_overlaps_are_the_products_of_the_rows(n_rows, piece):
    a = rows(n_rows[0], seed=0)
    b = rows(n_rows[1], seed=1)
    columns = slice(*piece)
    found = overlaps(torch.from_numpy(a), torch.from_numpy(b), columns)
    np.testing.assert_allclose(found.numpy(), a[:, columns] @ b[:, columns].T, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("precision", "error"), [(np.float64, 1e-13), (np.float32, 1e-5)])
@pytest.mark.parametrize("piece", PIECES)
@pytest.mark.parametrize("n_rows", N_ROWS)
def test_subtract_takes_the_product_from_a_piece(n_rows, piece, precision, error):
    before = rows(n_rows[0], seed=0)
    others = rows(n_rows[1], seed=1).astype(precision)
    factors = np.random.default_rng(2).standard_normal(n_rows).astype(precision)
    found = before.copy()
    expected = before.copy()
    columns = slice(*piece)
    subtract(torch.from_numpy(found), torch.from_numpy(factors), torch.from_numpy(others), columns)
    expected[:, columns] -= factors.astype(np.float64) @ others[:, columns].astype(np.float64)
    np.testing.assert_allclose(found, expected, rtol=0, atol=error * np.abs(expected).max())
    outside = np.ones(N_COLUMNS, dtype=bool)
    outside[columns] = False
    np.testing.assert_array_equal(found[:, outside], before[:, outside])


@pytest.mark.usefixtures("either_processor")
def test_subtraction_by_single_precision_factors_keeps_double_rows():
    """A component of 1e-9 is removed from unit rows down to 1e-15, although the factors are rounded to single."""
    basis = np.linalg.qr(rows(20, seed=3).T)[0].T.copy()
    old = basis[:16]
    new = basis[16:] + 1e-9 * basis[:4]
    everywhere = slice(0, N_COLUMNS)
    of_new = torch.from_numpy(new)
    of_old = torch.from_numpy(old)
    lost = overlaps(of_new, of_old, everywhere)
    subtract(of_new, lost.float(), of_old.float(), everywhere)
    assert float(lost.abs().max()) > 0.9e-9
    assert np.abs(new @ old.T).max() < 1e-15


@pytest.mark.parametrize(
    ("processor", "has_avx512", "has_mkl", "expected"),
    [
        ("emeraldrapids", True, True, False),
        ("emeraldrapids", True, False, True),
        ("haswell", False, True, True),
        ("znver4", True, True, True),
        ("neoverse-n1", False, False, True),
    ],
)
def test_mkl_is_preferred_only_on_intel_processors_with_avx_512(
    processor, has_avx512, has_mkl, expected, monkeypatch
):
    monkeypatch.setattr(binding, "get_host_cpu_name", lambda: processor)
    monkeypatch.setattr(binding, "get_host_cpu_features", lambda: {"avx512f": has_avx512})
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: has_mkl)
    assert loops_beat_blas.__wrapped__() is expected

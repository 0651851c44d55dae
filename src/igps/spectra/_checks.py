"""Checks of the matrices, before any computation."""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from igps._parameters import check_at_least

# Relative size of rounding errors, and relative tolerance for the symmetry and the row sums of a matrix.
ROUNDING, TOLERANCE = 1e-14, 1e-8


def canonical(matrix: sparse.csr_array) -> sparse.csr_array:
    """Return the matrix with sorted indices and without duplicates; the argument is not changed."""
    matrix = sparse.csr_array(matrix)
    if not matrix.has_canonical_format:
        matrix = matrix.copy()
        matrix.sum_duplicates()
    return matrix


def pattern(matrix: sparse.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Return the starts of the rows (V + 1,) and the columns (E,) of the entries of a matrix, as int32."""
    starts = matrix.indptr.astype(np.int32, copy=False)
    columns = matrix.indices.astype(np.int32, copy=False)
    return starts, columns


def checked_entries(
    matrix: sparse.csr_array, indptr: np.ndarray, indices: np.ndarray
) -> sparse.csr_array:
    """Return the canonical matrix, and check that it stores the same entries as a known structure."""
    matrix = canonical(matrix)
    has_same_rows = np.array_equal(matrix.indptr, indptr)
    if not has_same_rows or not np.array_equal(matrix.indices, indices):
        raise ValueError(
            "matrix: expected the stored entries of the analysed matrix, got others. Analyse it anew."
        )
    return matrix


def checked_mass(mass: np.ndarray | sparse.sparray | sparse.spmatrix) -> np.ndarray:
    """Return the mass, a vector or a diagonal sparse matrix, as a new float64 vector (V,)."""
    if not sparse.issparse(mass):
        return np.array(mass, dtype=np.float64)
    entries = sparse.coo_array(mass)
    off_diagonal = entries.data[entries.row != entries.col]
    if mass.shape[0] != mass.shape[1] or np.any(off_diagonal):
        raise ValueError(
            f"mass: expected (V,) or a diagonal sparse matrix, got a sparse matrix of shape {mass.shape} that is not "
            "diagonal. Lump it: mass.sum(axis=1)."
        )
    return np.array(mass.diagonal(), dtype=np.float64)


def checked_stiffness(
    stiffness: sparse.sparray | sparse.spmatrix, mass: np.ndarray, n_eigenpairs: int
) -> sparse.csr_array:
    """Check all arguments; return the stiffness as an exactly symmetric csr array, which may be the argument."""
    if not sparse.issparse(stiffness):
        raise ValueError(
            f"stiffness: expected a scipy sparse matrix, got {type(stiffness).__name__}."
        )
    n_vertices = len(mass)
    if mass.ndim != 1 or stiffness.shape != (n_vertices, n_vertices):
        raise ValueError(
            f"stiffness and mass: expected (V, V) and (V,), got {stiffness.shape} and {mass.shape}."
        )
    check_at_least(1, n_eigenpairs=n_eigenpairs)
    if n_eigenpairs + 1 >= n_vertices:
        raise ValueError(
            f"n_eigenpairs: expected at most {n_vertices - 2} for matrices of {n_vertices} rows, got {n_eigenpairs}. "
            "Compute fewer eigenpairs, or subdivide the surface."
        )
    stiffness = canonical(sparse.csr_array(stiffness, dtype=np.float64))
    if not np.isfinite(stiffness.data).all():
        raise ValueError(
            "stiffness: expected finite entries, got NaN or infinity. Repair degenerate triangles."
        )
    if not np.isfinite(mass).all() or mass.min() <= 0:
        raise ValueError(
            "mass: expected finite entries > 0, got others. Remove unused vertices and empty triangles."
        )
    if stiffness.trace() < 0:
        raise ValueError(
            "stiffness: expected a positive semi-definite matrix, got a negative trace. Pass -stiffness if your "
            "library has the opposite sign, as libigl's cotmatrix."
        )

    transpose = sparse.csr_array(stiffness.T)
    arrays = ((matrix.indptr, matrix.indices, matrix.data) for matrix in (stiffness, transpose))
    is_symmetric = all(map(np.array_equal, *arrays))
    magnitude = abs(stiffness)
    asymmetry = 0.0 if is_symmetric else abs(stiffness - transpose).max()
    if asymmetry > TOLERANCE * magnitude.max():
        raise ValueError(
            "stiffness: expected a symmetric matrix, got one that differs from its transpose."
        )
    # Relative to each row, so that the zero mode is recognised at any scale and in spite of slivers.
    row_sums = np.abs(stiffness.sum(axis=1))
    if (row_sums > TOLERANCE * magnitude.sum(axis=1)).any():
        raise ValueError(
            "stiffness: expected rows that sum to zero, as the constant is an eigenfunction on a closed surface; got "
            "other sums."
        )
    symmetric = stiffness if is_symmetric else sparse.csr_array((stiffness + transpose) / 2)
    n_components = connected_components(
        _significant(symmetric), directed=False, return_labels=False
    )
    if n_components > 1:
        raise ValueError(
            f"stiffness: expected 1 connected component, got {n_components}, each with a zero eigenvalue. Join the "
            "components of the surface or keep one of them."
        )
    return symmetric


def _significant(stiffness: sparse.csr_array) -> sparse.csr_array:
    """Return the matrix without entries that are rounding errors of zero, which would connect components."""
    entries = stiffness.tocoo()
    diagonal = stiffness.diagonal()
    smaller = np.minimum(diagonal[entries.row], diagonal[entries.col])
    is_large = np.abs(entries.data) > ROUNDING * smaller
    if is_large.all():
        return stiffness
    ends = (entries.row[is_large], entries.col[is_large])
    return sparse.csr_array((entries.data[is_large], ends), shape=stiffness.shape)

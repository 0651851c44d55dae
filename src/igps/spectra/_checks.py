"""What the matrices must be, before anything is computed with them."""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from igps._parameters import check_at_least

# Below these, relative to what it came from, a number is rounding, a matrix sloppy
ROUNDING, SLOPPINESS = 1e-14, 1e-8


def canonical(matrix: sparse.csr_array) -> sparse.csr_array:
    """The matrix with sorted indices and no duplicates; the argument is not touched."""
    matrix = sparse.csr_array(matrix)
    if not matrix.has_canonical_format:
        matrix = matrix.copy()
        matrix.sum_duplicates()
    return matrix


def checked_entries(matrix: sparse.csr_array, indptr: np.ndarray, indices: np.ndarray) -> sparse.csr_array:
    """The canonical matrix, which must store the entries of the one whose structure is known."""
    matrix = canonical(matrix)
    if not (np.array_equal(matrix.indptr, indptr) and np.array_equal(matrix.indices, indices)):
        raise ValueError("matrix must store the same entries as the one that was dissected: dissect it anew")
    return matrix


def checked_mass(mass: np.ndarray | sparse.sparray | sparse.spmatrix) -> np.ndarray:
    """The mass as a new float64 vector, (V,) where a vector or a diagonal sparse matrix is given."""
    if not sparse.issparse(mass):
        return np.array(mass, dtype=np.float64)
    entries = sparse.coo_array(mass)
    if mass.shape[0] != mass.shape[1] or np.any(entries.data[entries.row != entries.col]):
        raise ValueError(
            f"mass must be (V,) or a diagonal sparse matrix, got a sparse matrix of shape {mass.shape} that is not "
            "diagonal: lump it, mass.sum(axis=1)"
        )
    return np.array(mass.diagonal(), dtype=np.float64)


def checked_stiffness(
    stiffness: sparse.sparray | sparse.spmatrix, mass: np.ndarray, n_eigenpairs: int
) -> sparse.csr_array:
    """The stiffness as an exactly symmetric csr array, which may be the argument, after all checks on the arguments."""
    if not sparse.issparse(stiffness):
        raise ValueError(f"stiffness must be a scipy sparse matrix, got {type(stiffness).__name__}")
    n_vertices = len(mass)
    if mass.ndim != 1 or stiffness.shape != (n_vertices, n_vertices):
        raise ValueError(f"stiffness must be (V, V) and mass (V,), got {stiffness.shape} and {mass.shape}")
    check_at_least(1, n_eigenpairs=n_eigenpairs)
    if n_eigenpairs + 1 >= n_vertices:
        raise ValueError(
            f"n_eigenpairs={n_eigenpairs} needs matrices of more than {n_eigenpairs + 1} rows, these have "
            f"{n_vertices}: ask for fewer eigenpairs, or subdivide the surface"
        )
    stiffness = canonical(sparse.csr_array(stiffness, dtype=np.float64))
    if not np.isfinite(stiffness.data).all():
        raise ValueError(
            "stiffness has entries that are not finite: of a surface, repair the degenerate triangles first"
        )
    if not np.isfinite(mass).all() or mass.min() <= 0:
        raise ValueError(
            "mass must be finite and positive: of a surface, remove unreferenced vertices and empty triangles"
        )
    if stiffness.trace() < 0:
        raise ValueError(
            "stiffness must be positive semi-definite, its trace is negative: pass -stiffness if your library has the "
            "other sign, as libigl's cotmatrix"
        )

    transpose = sparse.csr_array(stiffness.T)
    arrays = ((matrix.indptr, matrix.indices, matrix.data) for matrix in (stiffness, transpose))
    exact = all(map(np.array_equal, *arrays))
    magnitude = abs(stiffness)
    if not exact and abs(stiffness - transpose).max() > SLOPPINESS * magnitude.max():
        raise ValueError("stiffness must be symmetric")
    # relative to each row: only this detects the zero mode at any scale and beside any sliver
    if (np.abs(stiffness.sum(axis=1)) > SLOPPINESS * magnitude.sum(axis=1)).any():
        raise ValueError(
            "the rows of stiffness must sum to zero, as on a closed surface the constant is an eigenfunction"
        )
    symmetric = stiffness if exact else sparse.csr_array((stiffness + transpose) / 2)
    n_components = connected_components(_significant(symmetric), directed=False, return_labels=False)
    if n_components > 1:
        raise ValueError(
            f"stiffness has {n_components} connected components and so {n_components} zero eigenvalues, expected 1: "
            "of a surface, join the components or keep one of them"
        )
    return symmetric


def _significant(stiffness: sparse.csr_array) -> sparse.csr_array:
    """The matrix without entries that are zero but for rounding: these would tie components together in vain."""
    entries, diagonal = stiffness.tocoo(), stiffness.diagonal()
    kept = np.abs(entries.data) > ROUNDING * np.minimum(diagonal[entries.row], diagonal[entries.col])
    if kept.all():
        return stiffness
    return sparse.csr_array((entries.data[kept], (entries.row[kept], entries.col[kept])), shape=stiffness.shape)

"""The K smallest non-zero eigenpairs of the generalised problem ``L φ = λ M φ``, with a proof that none is missing.

The algorithm is block Lanczos with a shift inside the wanted part of the spectrum (Ericsson & Ruhe 1980; Grimes,
Lewis & Simon 1994):

1. With y = M^½ φ the problem is A y = λ y, A = M^-½ L M^-½, and orthogonality is Euclidean. Lengths are measured in
   units of √area, so that nothing depends on the scale of the coordinates.
2. Weyl's law N(λ) ≈ λ · area / 4π places a shift σ where about SHIFT_RANK of the wanted eigenvalues lie below it.
   (A − σI)⁻¹ is applied by `_multifrontal`. It maps λ to θ = 1/(λ − σ), so that the wanted eigenvalues lie at both ends
   of the spectrum, and those below σ have nothing unwanted on their side. The basis that is needed is a third smaller
   than with a shift below the spectrum. Bands with a shift each (manifold harmonics, Vallet & Lévy 2008) would shrink
   it further, but cost a factorization each and leave vectors of neighbouring bands to be made orthogonal.
3. The block Krylov basis Q follows the three-term recurrence, with one full reorthogonalisation of every two blocks at
   once. With T = Qᵀ (A − σI)⁻¹ Q and its eigenpairs (θ, s), the Ritz vectors are Q s.
4. One more application of (A − σI)⁻¹ to a Ritz vector takes only the block R that couples the basis to the next one. It
   removes the high frequencies, which A would amplify, and leaves a residual that is known before any vector is formed:
   ‖A y − λ y‖ = ‖R s_last‖ / θ², with s_last the rows of s that belong to the last block.
5. The eigenvalues below a second shift μ, in a gap behind the last wanted one, number as many as the negative pivots
   of A − μI (Sylvester's law of inertia). Where that is more than were found, the block is widened by random
   vectors and the iteration goes on: so a multiplet larger than the block is found.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import ArpackError, eigsh

from igps._compiled import compiled
from igps._threads import one_thread
from igps.spectra._checks import ROUNDING, checked_mass, checked_stiffness
from igps.spectra._lanczos import ConvergenceError, gap_behind, lanczos
from igps.spectra._multifrontal import SingularMatrixError, analyse

logger = logging.getLogger(__name__)

# Pairs computed beyond the last one, to find a gap behind it; the Lanczos basis holds some anyway
N_GUARDS = 16
# The largest residual that rounding may excuse
RESIDUAL_LIMIT = 1e-4
# Of the eigenvectors, that change their places together
ROWS_AT_ONCE = 2**12
# Up to here a dense solver is as fast, or the basis would fill most of the space
DENSE_VERTICES, DENSE_VERTICES_PER_EIGENPAIR = 1000, 4

Solver = Callable[[], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Spectrum:
    """The low end of the spectrum of `L φ = λ M φ`, a shape's Laplace–Beltrami spectrum; the constant is left out.

    Attributes:
        eigenvalues: (K,) float64, ascending, 1/length².
        eigenfunctions: (V, K) float64, M-orthonormal, 1/length.
        mass: (V,) float64, the vertex areas, length².
        residual: the largest ‖L φ − λ M φ‖ / λ of the pairs, in the norm of M⁻¹, as measured.
    """

    eigenvalues: np.ndarray
    eigenfunctions: np.ndarray
    mass: np.ndarray
    residual: float


@one_thread()
def eigenpairs(
    stiffness: sparse.sparray | sparse.spmatrix,
    mass: np.ndarray | sparse.sparray | sparse.spmatrix,
    n_eigenpairs: int,
    *,
    positions: np.ndarray | None = None,
    tolerance: float = 1e-7,
    seed: int = 0,
) -> Spectrum:
    """The ``n_eigenpairs`` smallest non-zero eigenpairs of ``L φ = λ M φ`` on a connected closed surface.

    None is missing: their number is proved by inertia. The residual of each pair, ‖L φ − λ M φ‖ / λ in the norm of M⁻¹,
    is at most the tolerance, or as small as rounding allows, and then at most RESIDUAL_LIMIT. Small matrices go to a
    dense solver; where a solver fails, ARPACK follows, with a logged warning and the same proof. Within a multiplet the
    basis is arbitrary. The result is the same for the same seed, to the bit with any number of threads.

    The matrices may come from any library, with the sign that makes the stiffness positive semi-definite.

    Example:
        A ring of n equal springs has the eigenvalues 2 − 2 cos(2 π k / n), each twice.

        >>> ring = sparse.diags_array([2.0] * 12) - sparse.diags_array([1.0] * 11, offsets=1)
        >>> ring = ring - sparse.diags_array([1.0] * 11, offsets=-1)
        >>> ring = ring - sparse.coo_array(([1.0, 1.0], ([0, 11], [11, 0])), shape=(12, 12))
        >>> eigenpairs(ring, np.ones(12), 4).eigenvalues.round(6).tolist()
        [0.267949, 0.267949, 1.0, 1.0]

    Args:
        stiffness: (V, V) positive semi-definite, symmetric, rows summing to zero; no unit (cotangents).
        mass: (V,) lumped vertex areas, length², or a diagonal (V, V) sparse matrix of them.
        n_eigenpairs: how many, the zero mode not counted.
        positions: (V, 3) vertex positions, any unit. They only guide the elimination order; without them it is slower.
        tolerance: largest residual, relative to the eigenvalue. An eigenvalue's error is about its square.
        seed: of the random start vectors.

    Raises:
        ValueError: the matrices are malformed or not finite, rows do not sum to zero, the matrix falls into
            several components or has too few rows.
        ConvergenceError: the tolerance was not reached.
    """
    mass = checked_mass(mass)
    stiffness = checked_stiffness(stiffness, mass, n_eigenpairs)
    if positions is not None and (positions.shape != (len(mass), 3) or not np.isfinite(positions).all()):
        raise ValueError(f"positions must be finite and ({len(mass)}, 3), got {positions.shape}")

    area = mass.sum()
    scale = np.sqrt(area / mass)
    matrix = stiffness.copy()
    matrix.data *= scale.repeat(np.diff(matrix.indptr)) * scale[matrix.indices]

    def dense() -> tuple[np.ndarray, np.ndarray]:
        return eigh(matrix.toarray(), subset_by_index=(1, n_eigenpairs), overwrite_a=True)

    def krylov(inside: bool) -> tuple[np.ndarray, np.ndarray]:
        return lanczos(matrix, np.sqrt(mass / area), n_eigenpairs, positions, tolerance, seed, inside)

    def arpack() -> tuple[np.ndarray, np.ndarray]:
        n_guarded = min(n_eigenpairs + N_GUARDS, len(mass) - 2)
        eigenvalues, eigenfunctions = _arpack(stiffness, mass, n_guarded, seed)
        eigenvalues *= area
        _prove_complete(matrix, eigenvalues, n_eigenpairs, positions)
        return eigenvalues[:n_eigenpairs], eigenfunctions[:, :n_eigenpairs] * np.sqrt(mass)[:, None]

    small = len(mass) <= max(DENSE_VERTICES, DENSE_VERTICES_PER_EIGENPAIR * n_eigenpairs)
    solvers: list[Solver] = [dense, arpack] if small else [partial(krylov, True), partial(krylov, False), arpack]
    eigenvalues, vectors, residual = _first_that_passes(solvers, matrix, tolerance)
    vectors /= np.sqrt(mass)[:, None]
    return Spectrum(eigenvalues / area, vectors, mass, residual)


def _first_that_passes(
    solvers: Sequence[Solver], matrix: sparse.csr_array, tolerance: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Eigenvalues (K,), orthonormal eigenvectors (V, K) and the largest residual, by the first solver that passes."""
    for solver in solvers:
        try:
            eigenvalues, vectors = solver()
            residual, correction = _residual(matrix, eigenvalues, vectors, tolerance)
            # Rayleigh's quotients: what rounding leaves in (A − σI)⁻¹ near an eigenvalue is not in A y
            eigenvalues = eigenvalues + correction
            order = np.argsort(eigenvalues, kind="stable")
            if (order[1:] < order[:-1]).any():  # in a multiplet
                eigenvalues = eigenvalues[order]
                for start in range(0, len(vectors), ROWS_AT_ONCE):  # a second copy of all may take gigabytes
                    rows = vectors[start : start + ROWS_AT_ONCE]
                    rows[:] = rows[:, order]
            return eigenvalues, vectors, residual
        except (ConvergenceError, SingularMatrixError, np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:
            if solver is solvers[-1]:
                raise ConvergenceError(f"no solver reached the tolerance, the last one: {error}") from error
            if solver is solvers[-2]:
                logger.warning("falling back to ARPACK: %s", error)
            else:
                logger.info("falling back to a shift below 0: %s", error)
    raise AssertionError("unreachable")


def _arpack(
    stiffness: sparse.csr_array, mass: np.ndarray, n_eigenpairs: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    start = np.random.default_rng(seed).standard_normal(len(mass))
    shift = -0.01 / mass.sum()
    try:
        eigenvalues, eigenfunctions = eigsh(
            stiffness.tocsc(), n_eigenpairs + 1, sparse.diags_array(mass, format="csc"), sigma=shift, v0=start
        )
    except (ArpackError, RuntimeError) as error:
        raise ConvergenceError(f"ARPACK found no {n_eigenpairs} eigenpairs: {error}") from error
    order = np.argsort(eigenvalues)[1:]
    return eigenvalues[order], eigenfunctions[:, order]


def _prove_complete(
    matrix: sparse.csr_array, eigenvalues: np.ndarray, n_eigenpairs: int, positions: np.ndarray | None
) -> None:
    gap = gap_behind(torch.from_numpy(eigenvalues), n_eigenpairs)
    if gap is None:
        raise ConvergenceError(f"no gap behind eigenvalue {n_eigenpairs} to count at: ask for more or fewer eigenpairs")
    n_present = analyse(matrix, positions).inertia(matrix, gap[1]) - 1
    if n_present != gap[0]:
        raise ConvergenceError(f"found {gap[0]} of {n_present} eigenvalues below {gap[1]:.6g} / area")


def _residual(
    matrix: sparse.csr_array, eigenvalues: np.ndarray, vectors: np.ndarray, tolerance: float
) -> tuple[float, np.ndarray]:
    """The largest relative residual, and what makes of the eigenvalues Rayleigh's quotients of their vectors (K,).

    A ConvergenceError if one is above the tolerance though rounding allows a smaller one, or above RESIDUAL_LIMIT.
    """
    largest = 0.0
    squares, corrections = _defects(
        matrix.data, matrix.indptr, matrix.indices, eigenvalues, np.ascontiguousarray(vectors)
    )
    for start in range(0, len(eigenvalues), 64):
        part = slice(start, start + 64)
        values = eigenvalues[part]
        residuals = np.sqrt(squares[part]) / np.abs(values)
        largest = max(largest, float(residuals.max()))
        if not (residuals <= tolerance).all():
            rounding = np.linalg.norm(abs(matrix) @ np.abs(vectors[:, part]), axis=0) * ROUNDING / np.abs(values)
            allowed = np.maximum(tolerance, np.minimum(tolerance + rounding, RESIDUAL_LIMIT))
            bad = ~(residuals <= allowed)
            if bad.any():
                raise ConvergenceError(
                    f"{bad.sum()} of eigenpairs {start + 1} to {start + len(values)} have a relative residual above "
                    f"{allowed[bad].min():.1e}, up to {residuals[bad].max():.1e}: raise the tolerance, or of a surface "
                    "repair the bad triangles"
                )
    return largest, corrections


@compiled()
def _defects(
    values: np.ndarray, indptr: np.ndarray, indices: np.ndarray, eigenvalues: np.ndarray, vectors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(K,) squared lengths of A y − λ y and (K,) its products with y, for a csr matrix and vectors (V, K)."""
    n_vertices, n_vectors = vectors.shape
    defect, squares, products = np.empty(n_vectors), np.zeros(n_vectors), np.zeros(n_vectors)
    for i in range(n_vertices):
        for c in range(n_vectors):
            defect[c] = -eigenvalues[c] * vectors[i, c]
        for k in range(indptr[i], indptr[i + 1]):
            value, j = values[k], indices[k]
            for c in range(n_vectors):
                defect[c] += value * vectors[j, c]
        for c in range(n_vectors):
            squares[c] += defect[c] * defect[c]
            products[c] += defect[c] * vectors[i, c]
    return squares, products

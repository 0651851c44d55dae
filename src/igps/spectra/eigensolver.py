"""The K smallest non-zero eigenpairs of the generalised problem ``L φ = λ M φ``, with a proof that none is missing.

The algorithm is block Lanczos with a shift inside the wanted part of the spectrum (Ericsson & Ruhe 1980; Grimes, Lewis
& Simon 1994):

1. With y = M^½ φ the problem is A y = λ y, A = M^-½ L M^-½, and orthogonality is Euclidean. Lengths are measured in
   units of √area, so that nothing depends on the scale of the coordinates.
2. Weyl's law N(λ) ≈ λ · area / 4π gives a shift σ with about SHIFT_RANK of the wanted eigenvalues below it.
   (A − σI)⁻¹ is applied by `multifrontal`. It maps λ to θ = 1/(λ − σ): the wanted eigenvalues are at both ends of the
   spectrum, and every eigenvalue below σ is wanted. The basis is a third smaller than with a shift below
   the spectrum. Several bands with a shift each (manifold harmonics, Vallet & Lévy 2008) would reduce it further, but
   each costs a factorization, and the vectors of neighbouring bands would have to be orthogonalised.
3. The block Krylov basis Q is computed by the three-term recurrence, with a full reorthogonalisation of two blocks at a
   time. With T = Qᵀ (A − σI)⁻¹ Q and its eigenpairs (θ, s), the Ritz vectors are Q s.
4. Another application of (A − σI)⁻¹ to a Ritz vector requires only the block R that couples the basis to the next
   block. It removes high frequencies, which A would amplify, and the residual of the result is known before any vector
   is formed: ‖A y − λ y‖ = ‖R s_last‖ / θ², where s_last are the rows of s that belong to the last block.
5. Let μ be a second shift, in a gap after the last wanted eigenvalue. There are as many eigenvalues below μ as negative
   pivots of A − μI (Sylvester's law of inertia). If fewer were found, the block is widened by random vectors and the
   iteration continues. In this way a multiplet larger than the block is found.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import ArpackError, eigsh

from igps._threads import one_thread
from igps.spectra._checks import ROUNDING, checked_mass, checked_stiffness
from igps.spectra._lanczos import ConvergenceError, gap_after, lanczos
from igps.spectra.multifrontal import SingularMatrixError, analyse

logger = logging.getLogger(__name__)

# Number of extra pairs that ARPACK computes, to find a gap after the last wanted pair.
N_GUARDS = 16
# Largest residual that is accepted because of rounding.
RESIDUAL_LIMIT = 1e-4
# Number of rows of the eigenvectors that are reordered at a time.
REORDERED_ROWS = 2**12
# Largest problems for the dense solver: for few vertices it is as fast, and for few vertices per eigenpair the Lanczos
# basis would span most of the space.
MAX_DENSE_VERTICES, MAX_DENSE_VERTICES_PER_EIGENPAIR = 1000, 4

Solver = Callable[[], tuple[np.ndarray, np.ndarray]]

_FAILURES = (
    ConvergenceError,
    SingularMatrixError,
    np.linalg.LinAlgError,
    torch.linalg.LinAlgError,
)


@dataclass(frozen=True)
class Spectrum:
    """Smallest non-zero eigenpairs of `L φ = λ M φ`, such as the Laplace–Beltrami spectrum of a shape.

    Attributes:
        eigenvalues: (K,) float64, ascending, 1/length².
        eigenfunctions: (V, K) float64, M-orthonormal, 1/length.
        mass: (V,) float64, vertex areas, length².
        residual: largest measured ‖L φ − λ M φ‖ / λ of the pairs, in the norm of M⁻¹.
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
    """Compute the ``n_eigenpairs`` smallest non-zero eigenpairs of ``L φ = λ M φ`` on a connected closed surface.

    None is missing: their number is proved by inertia. The residual of each pair, ‖L φ − λ M φ‖ / λ in the norm of M⁻¹,
    is at most the tolerance, or, if rounding does not allow this, at most RESIDUAL_LIMIT. A dense solver handles small
    matrices. ARPACK is the fallback, with a logged warning and the same proof. Within a multiplet the basis is
    arbitrary. The result depends only on the arguments, to the bit and with any number of threads.

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
        n_eigenpairs: number of eigenpairs K, without the zero mode.
        positions: (V, 3) vertex positions, any unit. They are used for a faster elimination order only.
        tolerance: largest residual, relative to the eigenvalue. An eigenvalue's error is about its square.
        seed: of the random start vectors.

    Raises:
        ValueError: the matrices are malformed or not finite, rows do not sum to zero, or the matrix has several
            components or too few rows.
        ConvergenceError: the tolerance was not reached.
    """
    mass = checked_mass(mass)
    stiffness = checked_stiffness(stiffness, mass, n_eigenpairs)
    shape = (len(mass), 3)
    if positions is not None and (positions.shape != shape or not np.isfinite(positions).all()):
        raise ValueError(
            f"positions: expected finite values of shape {shape}, got {positions.shape}."
        )

    area = mass.sum()
    scale = np.sqrt(area / mass)
    matrix = stiffness.copy()
    of_rows = scale.repeat(np.diff(matrix.indptr))
    matrix.data *= of_rows * scale[matrix.indices]

    def dense() -> tuple[np.ndarray, np.ndarray]:
        return eigh(matrix.toarray(), subset_by_index=(1, n_eigenpairs), overwrite_a=True)

    def krylov() -> tuple[np.ndarray, np.ndarray]:
        zero_mode = np.sqrt(mass / area)
        return lanczos(matrix, zero_mode, n_eigenpairs, positions, tolerance, seed)

    def arpack() -> tuple[np.ndarray, np.ndarray]:
        n_computed = min(n_eigenpairs + N_GUARDS, len(mass) - 2)
        eigenvalues, eigenfunctions = _arpack(stiffness, mass, n_computed, seed)
        eigenvalues *= area
        _prove_complete(matrix, eigenvalues, n_eigenpairs, positions)
        vectors = eigenfunctions[:, :n_eigenpairs] * np.sqrt(mass)[:, None]
        return eigenvalues[:n_eigenpairs], vectors

    max_dense = max(MAX_DENSE_VERTICES, MAX_DENSE_VERTICES_PER_EIGENPAIR * n_eigenpairs)
    solver = dense if len(mass) <= max_dense else krylov
    try:
        eigenvalues, vectors, residual = _refined(solver, matrix, tolerance)
    except _FAILURES as error:
        logger.warning("falling back to ARPACK: %s", error)
        try:
            eigenvalues, vectors, residual = _refined(arpack, matrix, tolerance)
        except _FAILURES as last:
            raise ConvergenceError(
                f"no solver reached the tolerance; the last error: {last}"
            ) from last
    vectors /= np.sqrt(mass)[:, None]
    return Spectrum(eigenvalues / area, vectors, mass, residual)


def _refined(
    solver: Solver, matrix: sparse.csr_array, tolerance: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the eigenvalues (K,) and orthonormal eigenvectors (V, K) of a solver, and their largest residual."""
    eigenvalues, vectors = solver()
    residual, correction = _residual(matrix, eigenvalues, vectors, tolerance)
    # Rayleigh quotients: unlike (A − σI)⁻¹ near an eigenvalue, A y has no large rounding errors.
    eigenvalues = eigenvalues + correction
    order = np.argsort(eigenvalues, kind="stable")
    if (order[1:] < order[:-1]).any():  # possible in a multiplet
        eigenvalues = eigenvalues[order]
        # In parts: a full copy may take gigabytes.
        for start in range(0, len(vectors), REORDERED_ROWS):
            rows = vectors[start : start + REORDERED_ROWS]
            rows[:] = rows[:, order]
    return eigenvalues, vectors, residual


def _arpack(
    stiffness: sparse.csr_array, mass: np.ndarray, n_eigenpairs: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    start = generator.standard_normal(len(mass))
    shift = -0.01 / mass.sum()
    try:
        eigenvalues, eigenfunctions = eigsh(
            stiffness.tocsc(),
            n_eigenpairs + 1,
            sparse.diags_array(mass, format="csc"),
            sigma=shift,
            v0=start,
        )
    except (ArpackError, RuntimeError) as error:
        raise ConvergenceError(
            f"ARPACK failed to compute {n_eigenpairs} eigenpairs: {error}"
        ) from error
    order = np.argsort(eigenvalues)[1:]
    return eigenvalues[order], eigenfunctions[:, order]


def _prove_complete(
    matrix: sparse.csr_array,
    eigenvalues: np.ndarray,
    n_eigenpairs: int,
    positions: np.ndarray | None,
) -> None:
    gap = gap_after(torch.from_numpy(eigenvalues), n_eigenpairs)
    if gap is None:
        raise ConvergenceError(
            f"no gap after eigenvalue {n_eigenpairs} for the proof. Use more or fewer eigenpairs."
        )
    n_found, bound = gap
    n_present = analyse(matrix, positions).inertia(matrix, bound) - 1
    if n_present != n_found:
        raise ConvergenceError(
            f"found {n_found} of {n_present} eigenvalues below {bound:.6g} / area"
        )


def _residual(
    matrix: sparse.csr_array, eigenvalues: np.ndarray, vectors: np.ndarray, tolerance: float
) -> tuple[float, np.ndarray]:
    """Return the largest relative residual, and corrections (K,) that turn the eigenvalues into Rayleigh quotients.

    A ConvergenceError is raised if a residual exceeds the tolerance by more than rounding, or exceeds RESIDUAL_LIMIT.
    """
    largest = 0.0
    corrections = np.empty_like(eigenvalues)
    for start in range(0, len(eigenvalues), 64):
        part = slice(start, start + 64)
        values = eigenvalues[part]
        y = np.ascontiguousarray(vectors[:, part])
        defects = matrix @ y - y * values
        corrections[part] = np.einsum("vk,vk->k", defects, y)
        residuals = np.linalg.norm(defects, axis=0) / np.abs(values)
        largest = max(largest, float(residuals.max()))
        if not (residuals <= tolerance).all():
            magnitudes = abs(matrix) @ np.abs(y)
            rounding = np.linalg.norm(magnitudes, axis=0) * ROUNDING / np.abs(values)
            allowed = np.minimum(tolerance + rounding, RESIDUAL_LIMIT)
            allowed = np.maximum(allowed, tolerance)
            failed = ~(residuals <= allowed)
            if failed.any():
                raise ConvergenceError(
                    f"{failed.sum()} of eigenpairs {start + 1} to {start + len(values)} have a relative residual above "
                    f"{allowed[failed].min():.1e}, up to {residuals[failed].max():.1e}. Raise the tolerance, or "
                    "repair thin triangles of the surface."
                )
    return largest, corrections

"""The K smallest non-zero eigenpairs of the generalised problem ``L φ = λ M φ``, with a proof that none is missing.

The algorithm is block Lanczos with a shift inside the wanted part of the spectrum (Ericsson & Ruhe 1980; Grimes,
Lewis & Simon 1994):

1. With y = M^½ φ the problem is A y = λ y, A = M^-½ L M^-½, and orthogonality is Euclidean. Lengths are measured in
   units of √area, so that nothing depends on the scale of the coordinates.
2. Weyl's law N(λ) ≈ λ · area / 4π places a shift σ where about SHIFT_RANK of the wanted eigenvalues lie below it.
   (A − σI)⁻¹ is applied by `factorization`. It maps λ to θ = 1/(λ − σ), so that the wanted eigenvalues lie at both ends
   of the spectrum, and those below σ have nothing unwanted on their side. The basis that is needed is a third smaller
   than with a shift below the spectrum. Bands with a shift each (manifold harmonics, Vallet & Lévy 2008) would shrink
   it further, but cost a factorization each and leave vectors of neighbouring bands to be made orthogonal.
3. The block Krylov basis Q follows the three-term recurrence, with one full reorthogonalisation a step. With
   T = Qᵀ (A − σI)⁻¹ Q and its eigenpairs (θ, s), the Ritz vectors are Q s.
4. One more application of (A − σI)⁻¹ to a Ritz vector takes only the block R that couples the basis to the next one. It
   removes the high frequencies, which A would amplify, and leaves a residual that is known before any vector is formed:
   ‖A y − λ y‖ = ‖R s_last‖ / θ², with s_last the rows of s that belong to the last block.
5. The eigenvalues below a second shift μ, in a gap behind the last wanted one, number as many as the negative pivots
   of A − μI (Sylvester's law of inertia). Where that is more than were found, the block is widened by random
   vectors and the iteration goes on: so a multiplet larger than the block is found.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from scipy import sparse
from scipy.linalg import eigh, qr
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackError, eigsh

from igps.geometry.factorization import Dissection, Factorization, SingularMatrixError, dissect, factorize

logger = logging.getLogger(__name__)

BLOCK_SIZE = 16
# Share of the wanted eigenvalues below the shift: here both ends of the spectrum converge at the same time.
SHIFT_RANK = 0.55
# The shift of the second try, in units of 1/area
SHIFT_BELOW = -1.0
# Basis size at which all pairs have converged, as measured: so many vectors a pair, and so many blocks besides
BASIS_PER_EIGENPAIR, BASIS_PER_EIGENPAIR_BELOW, BASIS_BLOCKS = 1.55, 2.55, 11
# The basis gives up at this multiple of that size
BASIS_LIMIT = 3
# How accurate the factorization must be, relative to the tolerance: the lowest modes see its error some 1000 times
DEFECT = 2e-4
# A gap this wide, relative to the eigenvalue, is taken at once; a multiplet has none, and the next gap is looked for
WIDE_GAP, NARROWEST_GAP = 1e-4, 1e-7
# Below these, relative to what it came from, a number is rounding, a Cholesky factor inaccurate, a matrix sloppy
ROUNDING, CHOLESKY_QR_PIVOT, SLOPPINESS = 1e-14, 1e-6, 1e-8
# Pairs computed beyond the last one, to find a gap behind it; the Lanczos basis holds some anyway
N_GUARDS = 16
# Up to here a dense solver is as fast, or the basis would fill most of the space
DENSE_VERTICES, DENSE_VERTICES_PER_EIGENPAIR = 1000, 4


class ConvergenceError(RuntimeError):
    """The eigenpairs asked for could not be computed, or not be proved complete, to the tolerance asked for."""


@dataclass(frozen=True)
class Spectrum:
    """The low end of a shape's Laplace–Beltrami spectrum, the constant eigenfunction left out.

    Attributes:
        eigenvalues: (K,) float64, ascending, 1/length².
        eigenfunctions: (V, K) float64, M-orthonormal, 1/length.
        mass: (V,) float64, the vertex areas, length².
    """

    eigenvalues: np.ndarray
    eigenfunctions: np.ndarray
    mass: np.ndarray


def eigenpairs(
    stiffness: sparse.sparray | sparse.spmatrix,
    mass: np.ndarray,
    n_eigenpairs: int,
    *,
    positions: np.ndarray | None = None,
    method: Literal["lanczos", "eigsh"] = "lanczos",
    tolerance: float = 1e-7,
    seed: int = 0,
) -> Spectrum:
    """The ``n_eigenpairs`` smallest non-zero eigenpairs of ``L φ = λ M φ`` on a connected closed surface.

    None is missing: their number is proved by inertia. The residual of each pair, ‖L φ − λ M φ‖ / λ in the norm of M⁻¹,
    is at most the tolerance, or as small as rounding allows. Within a multiplet the basis is arbitrary. The result is
    the same for the same seed and number of threads.

    Args:
        stiffness: (V, V) positive semi-definite, symmetric, rows summing to zero; no unit (cotangents).
        mass: (V,) lumped vertex areas, length².
        n_eigenpairs: how many, the zero mode not counted.
        positions: (V, 3) vertex positions, any unit. They only guide the elimination order; without them it is slower.
        method: "lanczos" as in the module's docstring, with a dense solver for small meshes; or "eigsh", ARPACK
            by `scipy.sparse.linalg.eigsh` without proof or check, to compare with. Where the former fails, it falls
            back, with a logged warning, to ARPACK with proof and check.
        tolerance: largest residual, relative to the eigenvalue. An eigenvalue's error is about its square.
        seed: of the random start vectors.

    Raises:
        ValueError: the matrices are malformed or not finite, rows do not sum to zero, the mesh has several
            components or too few vertices.
        ConvergenceError: the tolerance was not reached.
    """
    mass = np.array(mass, dtype=np.float64)
    stiffness = _checked_stiffness(stiffness, mass, n_eigenpairs)
    if positions is not None and (positions.shape != (len(mass), 3) or not np.isfinite(positions).all()):
        raise ValueError(f"positions must be finite and ({len(mass)}, 3), got {positions.shape}")
    if method not in ("lanczos", "eigsh"):
        raise ValueError(f"method must be 'lanczos' or 'eigsh', got {method!r}")

    if method == "eigsh":
        eigenvalues, eigenfunctions = _arpack(stiffness, mass, n_eigenpairs, seed)
        return Spectrum(eigenvalues, eigenfunctions, mass)

    area = mass.sum()
    scale = sparse.diags_array(np.sqrt(area / mass))
    matrix = sparse.csr_array(scale @ stiffness @ scale)
    matrix.sort_indices()
    eigenvalues, vectors = _solve(matrix, stiffness, mass, n_eigenpairs, positions, tolerance, seed)
    vectors /= np.sqrt(mass)[:, None]
    return Spectrum(eigenvalues / area, vectors, mass)


def _solve(
    matrix: sparse.csr_array,
    stiffness: sparse.csr_array,
    mass: np.ndarray,
    n_eigenpairs: int,
    positions: np.ndarray | None,
    tolerance: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (K,) and orthonormal eigenvectors (V, K) of the matrix by the first solver whose result passes."""
    area = mass.sum()

    def dense() -> tuple[np.ndarray, np.ndarray]:
        return eigh(matrix.toarray(), subset_by_index=(1, n_eigenpairs), overwrite_a=True)

    def lanczos(inside: bool) -> tuple[np.ndarray, np.ndarray]:
        zero_mode = np.sqrt(mass / area)
        return _lanczos(matrix, zero_mode, n_eigenpairs, positions, tolerance, seed, inside)

    def arpack() -> tuple[np.ndarray, np.ndarray]:
        n_guarded = min(n_eigenpairs + N_GUARDS, len(mass) - 2)
        eigenvalues, eigenfunctions = _arpack(stiffness, mass, n_guarded, seed)
        eigenvalues *= area
        _prove_complete(matrix, eigenvalues, n_eigenpairs, positions)
        return eigenvalues[:n_eigenpairs], eigenfunctions[:, :n_eigenpairs] * np.sqrt(mass)[:, None]

    small = len(mass) <= max(DENSE_VERTICES, DENSE_VERTICES_PER_EIGENPAIR * n_eigenpairs)
    solvers: list[Callable[[], tuple[np.ndarray, np.ndarray]]]
    solvers = [dense, arpack] if small else [partial(lanczos, True), partial(lanczos, False), arpack]
    for solver in solvers:
        try:
            eigenvalues, vectors = solver()
            _check_residuals(matrix, eigenvalues, vectors, tolerance)
            return eigenvalues, vectors
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
    gap = _gap_behind(torch.from_numpy(eigenvalues), n_eigenpairs)
    if gap is None:
        raise ConvergenceError(f"no gap behind eigenvalue {n_eigenpairs} to count at: ask for more or fewer eigenpairs")
    n_present = factorize(dissect(matrix, positions), matrix, gap[1]).n_negative - 1
    if n_present != gap[0]:
        raise ConvergenceError(f"found {gap[0]} of {n_present} eigenvalues below {gap[1]:.6g} / area")


def _lanczos(
    matrix: sparse.csr_array,
    zero_mode: np.ndarray,
    n_eigenpairs: int,
    positions: np.ndarray | None,
    tolerance: float,
    seed: int,
    inside: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (K,) and orthonormal eigenvectors (V, K) of a matrix with one zero mode, (V,) of length 1.

    With the shift inside the spectrum it is fast. With the shift below, A − σI is definite: its factors are accurate.
    """
    dissection = dissect(matrix, positions)
    if inside:
        shift, factors = _factorize_inside(dissection, matrix, zero_mode, n_eigenpairs, tolerance)
    else:
        shift, factors = SHIFT_BELOW, factorize(dissection, matrix, SHIFT_BELOW)
    per_eigenpair = BASIS_PER_EIGENPAIR if inside else BASIS_PER_EIGENPAIR_BELOW
    first_look = math.ceil(per_eigenpair * n_eigenpairs) + BASIS_BLOCKS * BLOCK_SIZE
    n_below = factors.n_negative - 1 if inside else 0  # without the zero mode
    krylov = _Krylov(factors, zero_mode, first_look + 4 * BLOCK_SIZE, np.random.default_rng(seed))
    limit = min(BASIS_LIMIT * first_look, len(zero_mode) - 2 * BLOCK_SIZE)
    while krylov.size < first_look:
        krylov.expand()
    while True:
        ritz = krylov.ritz_pairs(shift)
        found = ritz.leading(n_below, tolerance)
        gap = _gap_behind(ritz.eigenvalues[found], n_eigenpairs)
        missing = False
        if gap is not None:
            n_found, bound = gap
            n_present = factorize(dissection, matrix, bound).n_negative - 1
            if n_present == n_found:
                return krylov.eigenvectors(ritz, found[:n_eigenpairs])
            if n_present < n_found:
                raise ConvergenceError(
                    f"{n_found} eigenvalues found below {bound:.6g} / area, where there are {n_present}"
                )
            logger.debug("%d of %d eigenvalues found below %g", n_found, n_present, bound)
            missing = True
        if krylov.size > limit:
            raise ConvergenceError(f"{len(found)} of {n_eigenpairs} eigenpairs after {krylov.size} basis vectors")
        if missing or krylov.size > limit / 2:
            krylov.widen()
        for _ in range(2):
            krylov.expand()


def _factorize_inside(
    dissection: Dissection, matrix: sparse.csr_array, zero_mode: np.ndarray, n_eigenpairs: int, tolerance: float
) -> tuple[float, Factorization]:
    """A shift with about SHIFT_RANK of the wanted eigenvalues below it, at which the factorization is accurate.

    The known zero mode tells the accuracy: as A − σI is indefinite, a pivot block is close to singular now and then.
    """
    target = max(1.5, SHIFT_RANK * n_eigenpairs)
    shift = 4 * math.pi * target
    mode = torch.from_numpy(zero_mode)[:, None]
    best: tuple[float, float, float, Factorization] | None = None
    for _ in range(6):
        factors = factorize(dissection, matrix, shift)
        rank = factors.n_negative
        off_target = max(0.0, abs(rank - target) - 0.2 * target - 1)
        defect = float(torch.linalg.norm(shift * factors.solve(mode) + mode))
        logger.debug("shift %.6g: %d eigenvalues below, defect %.1e", shift, rank, defect)
        if best is None or (off_target, defect) < best[:2]:
            best = off_target, defect, shift, factors
        if off_target > 0:
            shift *= min(4.0, max(0.25, target / max(rank, 1)))
        elif defect > DEFECT * tolerance:
            shift *= 0.97
        else:
            break
    assert best is not None
    return best[2:]


def _gap_behind(eigenvalues: torch.Tensor, n_eigenpairs: int) -> tuple[int, float] | None:
    """Number of eigenvalues up to a gap that follows the ``n_eigenpairs``-th or a later one, and a value in the gap."""
    values = eigenvalues[n_eigenpairs - 1 :]
    if len(values) < 2:
        return None
    gaps = torch.diff(values) / values[1:]
    wide = torch.nonzero(gaps > WIDE_GAP).flatten()
    place = int(wide[0]) if len(wide) else int(gaps.argmax())
    if gaps[place] < NARROWEST_GAP:
        return None
    return n_eigenpairs + place, float(values[place] + values[place + 1]) / 2


@dataclass(frozen=True)
class _RitzPairs:
    """Eigenpairs of the projected problem, in the order of their eigenvalues.

    Attributes:
        eigenvalues: (m,) of A.
        residuals: (m,) ‖A y − λ y‖ of the Ritz vectors after one more application of the operator.
        coefficients: (m + b, m) of those Ritz vectors, not normalised, in the basis with its next block.
        below_shift: (m,) whether θ < 0.
    """

    eigenvalues: torch.Tensor
    residuals: torch.Tensor
    coefficients: torch.Tensor
    below_shift: torch.Tensor

    def leading(self, n_below: int, tolerance: float) -> torch.Tensor:
        """Indices of the pairs up to the first that has not converged; none if fewer than n_below lie below σ."""
        converged = (self.residuals <= tolerance * self.eigenvalues) & (self.eigenvalues > 0)
        below = torch.nonzero(converged & self.below_shift).flatten()
        if len(below) < n_below:
            return below[:0]
        above = torch.nonzero(~self.below_shift).flatten()
        n_above = int(torch.cumprod(converged[above].int(), 0).sum())
        return torch.cat([below, above[:n_above]])


class _Krylov:
    """Orthonormal basis of a block Krylov space of (A − σI)⁻¹, grown block by block, and the operator projected on it.

    Vectors are stored as rows, since products of the basis with a block are fastest so. The first row is the zero mode:
    the others stay orthogonal to it, and the projected problem leaves it out.
    """

    def __init__(
        self, factors: Factorization, zero_mode: np.ndarray, capacity: int, generator: np.random.Generator
    ) -> None:
        self._factors = factors
        self._generator = generator
        n_vertices = len(zero_mode)
        self._basis = torch.empty(capacity + 1, n_vertices, dtype=torch.float64)
        self._basis[0] = torch.from_numpy(zero_mode)
        self._projected = torch.zeros(capacity + 1, capacity + 1, dtype=torch.float64)
        # rows previous:current and current:stop of the basis are the last two blocks, the last not yet multiplied
        self._previous = self._current = self._stop = 1
        self._coupling = torch.empty(0, 0, dtype=torch.float64)
        # a random vector is mostly high frequencies: one application leaves what matters
        self._append(self._orthonormal(self._apply(self._random(BLOCK_SIZE)), near=1)[0])

    @property
    def size(self) -> int:
        """Dimension m of the projected problem."""
        return self._current - 1

    def expand(self) -> None:
        """Multiply the last block, and append what is new in the product as the next block."""
        last = slice(self._current, self._stop)
        product = self._apply(self._basis[last])
        projection = self._basis[last] @ product.T
        block, coupling = self._orthonormal(product, near=self._previous)
        self._projected[last, last] = (projection + projection.T) / 2
        self._previous, self._current = self._current, self._stop
        self._append(block)
        new = slice(self._current, self._stop)
        self._projected[new, last] = coupling
        self._projected[last, new] = coupling.T
        self._coupling = coupling

    def widen(self) -> None:
        """Enlarge the last block, and those that follow, by random vectors: they see what the start block did not."""
        block, _ = self._orthonormal(self._random(BLOCK_SIZE), near=self._previous)
        self._append(block)
        self._coupling = torch.cat([self._coupling, self._coupling.new_zeros(len(block), self._coupling.shape[1])])

    def ritz_pairs(self, shift: float) -> _RitzPairs:
        inside = slice(1, self._current)
        theta, coefficients = torch.linalg.eigh(self._projected[inside, inside])
        outside = self._coupling @ coefficients[-self._coupling.shape[1] :]
        eigenvalues = shift + 1 / theta
        order = torch.argsort(eigenvalues)
        return _RitzPairs(
            eigenvalues=eigenvalues[order],
            residuals=(torch.linalg.norm(outside, dim=0) / theta**2)[order],
            coefficients=torch.cat([coefficients, outside / theta])[:, order],
            below_shift=(theta < 0)[order],
        )

    def eigenvectors(self, ritz: _RitzPairs, index: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues (K,) and eigenvectors (V, K) of the Ritz pairs with these indices."""
        coefficients = ritz.coefficients[:, index]
        coefficients /= torch.linalg.norm(coefficients, dim=0)
        return ritz.eigenvalues[index].numpy(), (self._basis[1 : self._stop].T @ coefficients).numpy()

    def _random(self, n_rows: int) -> torch.Tensor:
        return torch.from_numpy(self._generator.standard_normal((n_rows, self._basis.shape[1])))

    def _apply(self, block: torch.Tensor) -> torch.Tensor:
        return self._factors.solve(block.T).T.contiguous()

    def _append(self, block: torch.Tensor) -> None:
        stop = self._stop + len(block)
        if stop > len(self._basis):
            capacity = len(self._basis) * 3 // 2 + len(block)
            basis, projected = self._basis, self._projected
            self._basis = basis.new_empty(capacity, basis.shape[1])
            self._basis[: self._stop] = basis[: self._stop]
            self._projected = projected.new_zeros(capacity, capacity)
            self._projected[: self._stop, : self._stop] = projected[: self._stop, : self._stop]
        self._basis[self._stop : stop] = block
        self._stop = stop

    def _orthonormal(self, block: torch.Tensor, near: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows Q orthonormal and orthogonal to the basis, and R with block = Qᵀ R + what the basis spans, by columns.

        The recurrence says that only the basis from row ``near`` on contributes, the full pass after it sweeps out
        what rounding has left. Together that costs one product with the basis and one back.
        """
        scale = float(torch.linalg.norm(block, dim=1).max())
        first: torch.Tensor | None = None
        for rows in (self._basis[near : self._stop], self._basis[: self._stop]):
            block = torch.addmm(block, (rows @ block.T).T, rows, alpha=-1)
            block, factor = self._factor_rows(block, scale)
            first, scale = (factor, 1.0) if first is None else (factor @ first, 1.0)
        assert first is not None
        return block, first

    def _factor_rows(self, block: torch.Tensor, scale: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Orthonormal rows Q and R with blockᵀ = Qᵀ R; for a direction lost in rounding a random row and no R."""
        factor, failed = torch.linalg.cholesky_ex(block @ block.T)
        pivots = torch.diagonal(factor)
        if not failed and pivots.min() > CHOLESKY_QR_PIVOT * scale:
            identity = torch.eye(len(factor), dtype=factor.dtype)
            return torch.linalg.solve_triangular(factor, identity, upper=False) @ block, factor.T
        q, r, order = qr(block.T.numpy(), mode="economic", pivoting=True)
        lost = np.abs(np.diag(r)) <= ROUNDING * scale
        r[lost] = 0
        rows = torch.from_numpy(np.ascontiguousarray(q.T))
        if lost.any():
            rows[torch.from_numpy(lost)] = self._random(int(lost.sum())) / math.sqrt(block.shape[1])
        return rows, torch.from_numpy(r[:, np.argsort(order)])


def _check_residuals(matrix: sparse.csr_array, eigenvalues: np.ndarray, vectors: np.ndarray, tolerance: float) -> None:
    """Raise ConvergenceError for a residual above the tolerance, unless rounding allows no better."""
    for start in range(0, len(eigenvalues), 64):  # in pieces, to keep the memory small
        part = slice(start, start + 64)
        values, y = eigenvalues[part], np.ascontiguousarray(vectors[:, part])
        residuals = np.linalg.norm(matrix @ y - y * values, axis=0) / np.abs(values)
        if not (residuals <= tolerance).all():
            rounding = ROUNDING * np.linalg.norm(abs(matrix) @ np.abs(y), axis=0) / np.abs(values)
            bad = ~(residuals <= tolerance + rounding)
            if bad.any():
                raise ConvergenceError(
                    f"{bad.sum()} of eigenpairs {start + 1} to {start + len(values)} have a relative residual above "
                    f"{tolerance:.1e}, up to {residuals[bad].max():.1e}: repair bad triangles or raise the tolerance"
                )


def _checked_stiffness(
    stiffness: sparse.sparray | sparse.spmatrix, mass: np.ndarray, n_eigenpairs: int
) -> sparse.csr_array:
    """The stiffness as an exactly symmetric csr array, after all checks on the arguments."""
    if not sparse.issparse(stiffness):
        raise ValueError(f"stiffness must be a scipy sparse matrix, got {type(stiffness).__name__}")
    n_vertices = len(mass)
    if mass.ndim != 1 or stiffness.shape != (n_vertices, n_vertices):
        raise ValueError(f"stiffness must be (V, V) and mass (V,), got {stiffness.shape} and {mass.shape}")
    if n_eigenpairs < 1:
        raise ValueError(f"n_eigenpairs must be at least 1, got {n_eigenpairs}")
    if n_eigenpairs + 1 >= n_vertices:
        raise ValueError(
            f"n_eigenpairs={n_eigenpairs} needs more than {n_eigenpairs + 1} vertices, the mesh has {n_vertices}: "
            "subdivide the mesh or ask for fewer eigenpairs"
        )
    stiffness = sparse.csr_array(stiffness, dtype=np.float64)
    if not np.isfinite(stiffness.data).all():
        raise ValueError("stiffness has entries that are not finite: repair the degenerate triangles first")
    if not np.isfinite(mass).all() or mass.min() <= 0:
        raise ValueError("mass must be finite and positive: remove unreferenced vertices and empty triangles")

    transpose = sparse.csr_array(stiffness.T)
    magnitude = abs(stiffness)
    if abs(stiffness - transpose).max() > SLOPPINESS * magnitude.max():
        raise ValueError("stiffness must be symmetric")
    # relative to each row: only this detects the zero mode at any scale and beside any sliver
    if (np.abs(stiffness.sum(axis=1)) > SLOPPINESS * magnitude.sum(axis=1)).any():
        raise ValueError(
            "the rows of stiffness must sum to zero, as on a closed surface the constant is an eigenfunction"
        )
    symmetric = sparse.csr_array((stiffness + transpose) / 2)
    n_components = connected_components(_significant(symmetric), directed=False, return_labels=False)
    if n_components > 1:
        raise ValueError(
            f"the mesh has {n_components} connected components and so {n_components} zero eigenvalues, expected 1: "
            "join the components or keep one of them"
        )
    return symmetric


def _significant(stiffness: sparse.csr_array) -> sparse.csr_array:
    """The matrix without entries that are zero but for rounding: these would tie components together in vain."""
    entries = stiffness.tocoo()
    diagonal = stiffness.diagonal()
    kept = np.abs(entries.data) > ROUNDING * np.minimum(diagonal[entries.row], diagonal[entries.col])
    return sparse.csr_array((entries.data[kept], (entries.row[kept], entries.col[kept])), shape=stiffness.shape)

"""A block Krylov basis that grows block by block, and the eigenpairs of the operator projected on it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.linalg import qr

from igps._threads import ALONE, Team
from igps.spectra._basis import Basis, pieces_of
from igps.spectra._checks import ROUNDING
from igps.spectra._multifrontal import Factors
from igps.spectra._products import overlaps, subtract

# Below this, relative to what it came from, a pivot makes a Cholesky factor inaccurate
CHOLESKY_QR_PIVOT = 1e-6
# Below this, dividing by a pivot makes too much of what rounding left of the basis to wait for the next sweep
QUICK_PIVOT = 1e-4
# Above this, relative to the largest pivot, a Cholesky factor makes rows orthonormal but for rounding
ROUND_PIVOT = 0.1
# So many blocks go by between two sweeps, or one where a sweep has found a larger loss of orthogonality; a smaller one
# may be taken out in single precision
SWEEP_EVERY, SWEEP_LOSS, SINGLE_LOSS = 2, 1e-7, 3e-8
# Columns of the basis that are turned into eigenvectors at once
COLUMNS_AT_ONCE = 8192


@dataclass(frozen=True)
class RitzPairs:
    """Eigenpairs of the projected problem, in the order of their eigenvalues."""

    eigenvalues: torch.Tensor  # (m,) of A
    residuals: torch.Tensor  # (m,) ‖A y − λ y‖ of the Ritz vectors after one more application of the operator
    coefficients: torch.Tensor  # (m + b, m) of those Ritz vectors, not normalised, in the basis with its next block
    below_shift: torch.Tensor  # (m,) whether θ < 0

    def leading(self, n_below: int, tolerance: float) -> torch.Tensor:
        """Indices of the pairs up to the first that has not converged; none if fewer than n_below lie below σ."""
        converged = (self.residuals <= tolerance * self.eigenvalues) & (self.eigenvalues > 0)
        below = torch.nonzero(converged & self.below_shift).flatten()
        if len(below) < n_below:
            return below[:0]
        above = torch.nonzero(~self.below_shift).flatten()
        n_above = int(torch.cumprod(converged[above].int(), 0).sum())
        return torch.cat([below, above[:n_above]])


class Krylov(Basis):
    """Orthonormal basis of a block Krylov space of (A − σI)⁻¹, grown block by block, and the operator projected on it.

    Vectors are stored as rows, since products of the basis with a block are fastest so. The first row is the zero mode:
    the others stay orthogonal to it, and the projected problem leaves it out.
    """

    def __init__(
        self,
        factors: Factors,
        zero_mode: np.ndarray,
        block_size: int,
        capacity: int,
        generator: np.random.Generator,
        team: Team = ALONE,
    ) -> None:
        super().__init__(zero_mode, capacity, team)
        self._factors = factors
        self._generator = generator
        self._block_size = block_size
        # rows previous:current and current:stop of the basis are the last two blocks, the last not yet multiplied
        self._previous = self._current = 1
        self._every = SWEEP_EVERY
        self._coupling = torch.empty(0, 0, dtype=torch.float64, device="cpu")
        # a random vector is mostly high frequencies: one application leaves what matters
        self._append(self._orthonormal(self._apply(self._random(block_size)), near=1)[0], swept=True)

    @property
    def size(self) -> int:
        """Dimension m of the projected problem."""
        return self._current - 1

    def expand(self) -> None:
        """Multiply the last block, and append what is new in the product as the next block."""
        last = slice(self._current, self._stop)
        near = self._basis[self._previous : self._stop]
        product = self._apply(self._basis[last])
        (projection,) = self._sums(lambda piece: (overlaps(product, near, piece),))
        diagonal = projection[:, self._current - self._previous :]

        def leave_new(piece: slice) -> tuple[torch.Tensor]:
            product[:, piece].addmm_(projection, near[:, piece], alpha=-1)
            return (overlaps(product, product, piece),)

        (remainder,) = self._sums(leave_new)
        # the longest row of the product, by Pythagoras: what the recurrence took from it, and what is left
        scale = math.sqrt(float((remainder.diagonal() + projection.square().sum(1)).max()))
        quick = self._factor_quickly(product, remainder, scale)
        if quick is None:
            self._sweep()
        block, coupling = quick or self._orthonormal(product, near=self._previous, scale=scale)
        self._projected[last, last] = (diagonal + diagonal.T) / 2
        self._previous, self._current = self._current, self._stop
        self._append(block, swept=quick is None)
        new = slice(self._current, self._stop)
        self._projected[new, last] = coupling
        self._projected[last, new] = coupling.T
        self._coupling = coupling
        if self._stop - self._swept >= self._every * len(block) and self._sweep() > SWEEP_LOSS:
            self._every = 1

    def widen(self) -> None:
        """Enlarge the last block, and those that follow, by random vectors: they see what the start block did not."""
        self._sweep()
        block, _ = self._orthonormal(self._random(self._block_size), near=self._previous)
        self._append(block, swept=True)
        self._coupling = torch.cat([self._coupling, self._coupling.new_zeros(len(block), self._coupling.shape[1])])

    def ritz_pairs(self, shift: float) -> RitzPairs:
        self._sweep()
        inside = slice(1, self._current)
        theta, coefficients = torch.linalg.eigh(self._projected[inside, inside])
        outside = self._coupling @ coefficients[-self._coupling.shape[1] :]
        eigenvalues = shift + 1 / theta
        order = torch.argsort(eigenvalues)
        return RitzPairs(
            eigenvalues=eigenvalues[order],
            residuals=(torch.linalg.norm(outside, dim=0) / theta**2)[order],
            coefficients=torch.cat([coefficients, outside / theta])[:, order],
            below_shift=(theta < 0)[order],
        )

    def eigenvectors(
        self, ritz: RitzPairs, index: torch.Tensor, order: np.ndarray
    ) -> tuple[np.ndarray, list[Callable[[], None]]]:
        """(V, K) for the eigenvectors of the Ritz pairs with these indices, and the steps that fill it, in any order.

        Entry i of a vector becomes row ``order[i]``.
        """
        coefficients = _coefficients(ritz, index).numpy()
        vectors = torch.empty(self._basis.shape[1], len(index), dtype=torch.float64, device="cpu").numpy()

        def combine(piece: slice) -> None:
            vectors[order[piece]] = self._basis[1 : self._stop, piece].numpy().T @ coefficients

        return vectors, [partial(combine, piece) for piece in self._small_pieces()]

    def eigenvectors_in_place(self, ritz: RitzPairs, index: torch.Tensor, order: np.ndarray) -> np.ndarray:
        """The same eigenvectors (V, K), never in memory beside the basis, which is lost; see `loses_basis`."""
        coefficients = _coefficients(ritz, index)
        n_vertices, n_vectors = self._basis.shape[1], coefficients.shape[1]
        for piece in self._small_pieces():
            self._basis[:n_vectors, piece] = coefficients.T @ self._basis[1 : self._stop, piece]
        rows = self._memory
        self._basis, self._memory = self._basis.new_empty(0, n_vertices), np.empty((0, n_vertices))
        # gives back what lies behind; no other array looks into it any more
        rows.resize((n_vectors, n_vertices), refcheck=False)
        vectors = np.empty((n_vertices, n_vectors))
        for piece in self._small_pieces():
            vectors[order[piece]] = rows[:, piece].T
        return vectors

    def _small_pieces(self) -> list[slice]:
        n_vertices = self._basis.shape[1]
        return pieces_of(n_vertices, -(-n_vertices // COLUMNS_AT_ONCE))

    def _random(self, n_rows: int) -> torch.Tensor:
        return torch.from_numpy(self._generator.standard_normal((n_rows, self._basis.shape[1])))

    def _apply(self, block: torch.Tensor) -> torch.Tensor:
        """The products (b, V) of the operator with b rows."""
        return self._factors.solve(block.T, self._team).T

    def _sweep(self) -> float:
        """Make the rows since the last sweep orthogonal to all before them, and orthonormal; how far they were from it.

        The recurrence leaves of older rows what rounding left in the last two blocks, times the ratio of the largest θ
        to the spread of the others: with each block some hundred times as much. Two blocks go by before it is swept
        out, in both at once, as products of the basis with twice as many columns take less than twice the time. The
        projection is then wrong by the square of what was lost (Simon 1984), which is below rounding. Single precision
        takes out exactly enough of what is that small; then the rows are mostly still orthonormal.
        """
        old, new = self._basis[: self._swept], self._basis[self._swept : self._stop]
        if not len(new):
            return 0.0
        (lost,) = self._sums(lambda piece: (overlaps(new, old, piece),))
        largest = float(lost.abs().max())
        if self._single is not None and largest <= SINGLE_LOSS:
            old, lost = self._single[: self._swept], lost.float()

        def take_out(piece: slice) -> tuple[torch.Tensor]:
            subtract(new, lost, old, piece)
            return (overlaps(new, new, piece),)

        (squares,) = self._sums(take_out)
        if float((squares - torch.eye(len(new), device="cpu")).abs().max()) > ROUNDING:
            self._multiply(_inverse(torch.linalg.cholesky(squares)), new, new)
        self._mark_swept()
        return largest

    def _orthonormal(
        self, block: torch.Tensor, near: int, scale: float | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows Q orthonormal and orthogonal to the basis, and R with block = Qᵀ R + what the basis spans, by columns.

        ``scale`` is how long the longest row was before something of the basis was taken from it.

        The recurrence says that only the basis from row ``near`` on contributes, the full pass after it sweeps out
        what rounding has left. Together that costs one product with the basis and one back.
        """
        scale = float(torch.linalg.norm(block, dim=1).max()) if scale is None else scale
        coupling = torch.eye(len(block), dtype=torch.float64, device="cpu")
        for rows in (self._basis[near : self._stop], self._basis[: self._stop]):
            block = torch.addmm(block, (rows @ block.T).T, rows, alpha=-1)
            block, factor = self._factor_rows(block, scale)
            coupling, scale = factor @ coupling, 1.0
        return block, coupling

    def _factor_rows(self, block: torch.Tensor, scale: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Orthonormal rows Q and R with blockᵀ = Qᵀ R; for a direction lost in rounding a random row and no R."""
        factor, failed = torch.linalg.cholesky_ex(block @ block.T)
        if not failed and torch.diagonal(factor).min() > CHOLESKY_QR_PIVOT * scale:
            return _inverse(factor) @ block, factor.T
        q, r, order = qr(block.T.numpy(), mode="economic", pivoting=True)
        lost = np.abs(np.diag(r)) <= ROUNDING * scale
        r[lost] = 0
        rows = torch.from_numpy(np.ascontiguousarray(q.T))
        if lost.any():
            rows[torch.from_numpy(lost)] = self._random(int(lost.sum())) / math.sqrt(block.shape[1])
        return rows, torch.from_numpy(r[:, np.argsort(order)])

    def _factor_quickly(
        self, block: torch.Tensor, squares: torch.Tensor, scale: float
    ) -> tuple[torch.Tensor, torch.Tensor] | None:
        """As `_factor_rows`, in the next rows of the basis, given the rows' products; again where rounding asks for it.

        None if a pivot is small.
        """
        first, failed = torch.linalg.cholesky_ex(squares)
        smallest, largest = torch.aminmax(torch.diagonal(first))
        if failed or not smallest > QUICK_PIVOT * scale:
            return None
        rows = self._next_rows(len(block))
        self._multiply(_inverse(first), block, rows)
        if smallest > ROUND_PIVOT * largest:
            return rows, first.T
        (squares,) = self._sums(lambda piece: (overlaps(rows, rows, piece),))
        second = torch.linalg.cholesky(squares)
        self._multiply(_inverse(second), rows, rows)
        return rows, second.T @ first.T


def _coefficients(ritz: RitzPairs, index: torch.Tensor) -> torch.Tensor:
    """(m + b, K) of the Ritz pairs with these indices, of length 1."""
    coefficients = ritz.coefficients[:, index]
    return coefficients / torch.linalg.norm(coefficients, dim=0)


def _inverse(factor: torch.Tensor) -> torch.Tensor:
    """Of a lower triangular matrix."""
    return torch.linalg.solve_triangular(factor, torch.eye(len(factor), dtype=factor.dtype, device="cpu"), upper=False)

"""A block Krylov basis, and the eigenpairs of the operator projected on it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.linalg import qr

from igps._threads import SERIAL, Team
from igps.spectra._basis import Basis, split
from igps.spectra._checks import ROUNDING
from igps.spectra._products import identity, overlaps, subtract
from igps.spectra.multifrontal import Factors

# Smallest pivot, relative to the longest row, for which a Cholesky factor is accurate.
MIN_CHOLESKY_PIVOT = 1e-6
# Smallest pivot, relative to the longest row, with which a block can wait for the next reorthogonalisation. Division by
# a smaller one magnifies rounding errors too much.
MIN_QUICK_PIVOT = 1e-4
# Smallest pivot, relative to the largest, for which one Cholesky factor makes rows orthonormal up to rounding.
MIN_ONE_PASS_PIVOT = 0.1
# Number of blocks between two reorthogonalisations; it becomes 1 after a loss of orthogonality above MAX_LOSS.
INTERVAL = 2
MAX_LOSS = 1e-7
# Largest loss of orthogonality that is removed in single precision.
MAX_SINGLE_LOSS = 3e-8
# Number of columns of the basis that are turned into eigenvectors at a time.
PIECE_COLUMNS = 8192


@dataclass(frozen=True)
class RitzPairs:
    """Eigenpairs of the projected problem, ordered by eigenvalue."""

    eigenvalues: torch.Tensor  # (m,) of A
    # (m,) ‖A y − λ y‖ of the Ritz vectors after one more application of the operator
    residuals: torch.Tensor
    # (m + b, m) of these vectors, not normalised, in the basis including its next block
    coefficients: torch.Tensor
    below_shift: torch.Tensor  # (m,) whether θ < 0

    def leading(self, n_below: int, tolerance: float) -> torch.Tensor:
        """Return the indices of the pairs before the first unconverged one; none unless n_below of them lie below σ."""
        is_converged = self.residuals <= tolerance * self.eigenvalues
        is_converged &= self.eigenvalues > 0
        below = torch.nonzero(is_converged & self.below_shift).flatten()
        if len(below) < n_below:
            return below[:0]
        above = torch.nonzero(~self.below_shift).flatten()
        n_above = int(is_converged[above].int().cumprod(0).sum())
        return torch.cat([below, above[:n_above]])


class Krylov(Basis):
    """Orthonormal basis of a block Krylov space of (A − σI)⁻¹, grown block by block, and the operator projected on it.

    Vectors are stored as rows, because products of the basis with a block are fastest in this layout. The first row is
    the zero mode: the others stay orthogonal to it, and it is left out of the projected problem.
    """

    def __init__(
        self,
        factors: Factors,
        zero_mode: np.ndarray,
        block_size: int,
        capacity: int,
        generator: np.random.Generator,
        team: Team = SERIAL,
    ) -> None:
        super().__init__(zero_mode, capacity, team)
        self._factors = factors
        self._generator = generator
        self._block_size = block_size
        # Rows _previous:_current and _current:_stop of the basis are the last two blocks; the last awaits `expand`.
        self._previous = self._current = 1
        self._interval = INTERVAL
        self._coupling = identity(0)
        # Random vectors consist mostly of high frequencies, which one application of the operator removes.
        start = self._apply(self._random(block_size))
        block, _ = self._orthonormal(start, near=1)
        self._append(block, is_orthogonal=True)

    @property
    def size(self) -> int:
        """Dimension m of the projected problem."""
        return self._current - 1

    def expand(self) -> None:
        """Multiply the last block, and append the new directions of the product as the next block."""
        last = slice(self._current, self._stop)
        near = self._basis[self._previous : self._stop]
        product = self._apply(self._basis[last])
        projection = self._sum_pieces(lambda piece: overlaps(product, near, piece))
        diagonal = projection[:, self._current - self._previous :]

        def project_out(piece: slice) -> torch.Tensor:
            product[:, piece].addmm_(projection, near[:, piece], alpha=-1)
            return overlaps(product, product, piece)

        remainder = self._sum_pieces(project_out)
        # Length of the longest row of the product, from its projection and its remainder, by Pythagoras' theorem.
        squares = remainder.diagonal() + projection.square().sum(1)
        scale = math.sqrt(float(squares.max()))
        quick = self._factor_quickly(product, remainder, scale)
        if quick is None:
            self._reorthogonalise()
        orthonormal = quick or self._orthonormal(product, near=self._previous, scale=scale)
        block, coupling = orthonormal
        self._projected[last, last] = (diagonal + diagonal.T) / 2
        self._previous = self._current
        self._current = self._stop
        self._append(block, is_orthogonal=quick is None)
        new = slice(self._current, self._stop)
        self._projected[new, last] = coupling
        self._projected[last, new] = coupling.T
        self._coupling = coupling
        n_waiting = self._stop - self._n_orthogonal
        if n_waiting >= self._interval * len(block):
            loss = self._reorthogonalise()
            if loss > MAX_LOSS:
                self._interval = 1

    def widen(self) -> None:
        """Enlarge the last block, and those after it, by random vectors, for directions that the start block lacked."""
        self._reorthogonalise()
        directions = self._random(self._block_size)
        block, _ = self._orthonormal(directions, near=self._previous)
        self._append(block, is_orthogonal=True)
        uncoupled = self._coupling.new_zeros(len(block), self._coupling.shape[1])
        self._coupling = torch.cat([self._coupling, uncoupled])

    def ritz_pairs(self, shift: float) -> RitzPairs:
        self._reorthogonalise()
        rows = slice(1, self._current)
        theta, coefficients = torch.linalg.eigh(self._projected[rows, rows])
        eigenvalues = shift + 1 / theta
        order = torch.argsort(eigenvalues)
        of_last_block = coefficients[-self._coupling.shape[1] :]
        of_next_block = self._coupling @ of_last_block
        residuals = torch.linalg.norm(of_next_block, dim=0) / theta**2
        coefficients = torch.cat([coefficients, of_next_block / theta])
        return RitzPairs(
            eigenvalues=eigenvalues[order],
            residuals=residuals[order],
            coefficients=coefficients[:, order],
            below_shift=(theta < 0)[order],
        )

    def eigenvectors(
        self, ritz: RitzPairs, index: torch.Tensor, order: np.ndarray
    ) -> tuple[np.ndarray, list[Callable[[], None]]]:
        """Return an array (V, K) for the eigenvectors of the Ritz pairs with these indices, and the steps that fill it.

        The steps may run in any order. Entry i of a vector becomes row ``order[i]``.
        """
        coefficients = _coefficients(ritz, index).numpy()
        shape = (self._basis.shape[1], len(index))
        vectors = torch.empty(shape, dtype=torch.float64, device="cpu").numpy()

        def combine(piece: slice) -> None:
            rows = self._basis[1 : self._stop, piece].numpy()
            vectors[order[piece]] = rows.T @ coefficients

        return vectors, [partial(combine, piece) for piece in self._small_pieces()]

    def eigenvectors_in_place(
        self, ritz: RitzPairs, index: torch.Tensor, order: np.ndarray
    ) -> np.ndarray:
        """Return the same eigenvectors (V, K), written over the basis, which is lost; see `overwrites_basis`."""
        coefficients = _coefficients(ritz, index)
        n_vertices = self._basis.shape[1]
        n_vectors = coefficients.shape[1]
        for piece in self._small_pieces():
            combined = coefficients.T @ self._basis[1 : self._stop, piece]
            self._basis[:n_vectors, piece] = combined
        rows = self._memory
        self._basis = self._basis.new_empty(0, n_vertices)
        self._memory = np.empty((0, n_vertices))
        # Release the rest of the memory; no other array refers to it any more.
        rows.resize((n_vectors, n_vertices), refcheck=False)
        vectors = np.empty((n_vertices, n_vectors))
        for piece in self._small_pieces():
            vectors[order[piece]] = rows[:, piece].T
        return vectors

    def _small_pieces(self) -> list[slice]:
        n_vertices = self._basis.shape[1]
        return split(n_vertices, math.ceil(n_vertices / PIECE_COLUMNS))

    def _random(self, n_rows: int) -> torch.Tensor:
        shape = (n_rows, self._basis.shape[1])
        return torch.from_numpy(self._generator.standard_normal(shape))

    def _apply(self, block: torch.Tensor) -> torch.Tensor:
        """Return the products (b, V) of the operator with b rows."""
        return self._factors.solve(block.T, self._team).T

    def _reorthogonalise(self) -> float:
        """Make the new rows orthonormal and orthogonal to all before them; return their loss of orthogonality.

        The recurrence leaves components along older rows: the rounding errors in the last two blocks, times the ratio
        of the largest θ to the spread of the others. They grow by a factor of some hundred with each block. They are
        removed from two blocks at a time, because products of the basis with twice as many columns take less than twice
        the time. The error of the projection is then the square of the loss (Simon 1984), which is below rounding. A
        loss up to MAX_SINGLE_LOSS is removed in single precision; the rows are mostly still orthonormal afterwards.
        """
        old = self._basis[: self._n_orthogonal]
        new = self._basis[self._n_orthogonal : self._stop]
        if not len(new):
            return 0.0
        overlap = self._sum_pieces(lambda piece: overlaps(new, old, piece))
        loss = float(overlap.abs().max())
        if self._single is not None and loss <= MAX_SINGLE_LOSS:
            old = self._single[: self._n_orthogonal]
            overlap = overlap.float()

        def remove(piece: slice) -> torch.Tensor:
            subtract(new, overlap, old, piece)
            return overlaps(new, new, piece)

        squares = self._sum_pieces(remove)
        error = (squares - identity(len(new))).abs().max()
        if error > ROUNDING:
            factor = torch.linalg.cholesky(squares)
            self._multiply(_inverse(factor), new, new)
        self._mark_orthogonal()
        return loss

    def _orthonormal(
        self, block: torch.Tensor, near: int, scale: float | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows Q, orthonormal and orthogonal to the basis, and R: blockᵀ − Qᵀ R is in the span of the basis.

        According to the recurrence, only rows of the basis from ``near`` on contribute. A second pass, over all rows,
        removes rounding errors. ``scale`` is the length of the longest row before anything was subtracted from it.
        """
        if scale is None:
            scale = float(torch.linalg.norm(block, dim=1).max())
        coupling = identity(len(block))
        for first in (near, 0):
            rows = self._basis[first : self._stop]
            projection = (rows @ block.T).T
            block = torch.addmm(block, projection, rows, alpha=-1)
            block, factor = self._factor_rows(block, scale)
            coupling = factor @ coupling
            scale = 1.0
        return block, coupling

    def _factor_rows(self, block: torch.Tensor, scale: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return orthonormal rows Q and R with blockᵀ = Qᵀ R; directions lost in rounding get random rows and no R."""
        factor, failed = torch.linalg.cholesky_ex(block @ block.T)
        smallest = torch.diagonal(factor).min()
        if not failed and smallest > MIN_CHOLESKY_PIVOT * scale:
            return _inverse(factor) @ block, factor.T
        q, r, order = qr(block.T.numpy(), mode="economic", pivoting=True)
        is_lost = np.abs(np.diag(r)) <= ROUNDING * scale
        r[is_lost] = 0
        rows = torch.from_numpy(np.ascontiguousarray(q.T))
        if is_lost.any():
            substitutes = self._random(int(is_lost.sum()))
            substitutes /= math.sqrt(block.shape[1])
            rows[torch.from_numpy(is_lost)] = substitutes
        unsorted = r[:, np.argsort(order)]
        return rows, torch.from_numpy(unsorted)

    def _factor_quickly(
        self, block: torch.Tensor, squares: torch.Tensor, scale: float
    ) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Factor rows as `_factor_rows`, given their products with each other; return None if a pivot is too small.

        Q is written to the next rows of the basis. The factorization is repeated if rounding requires it.
        """
        first, failed = torch.linalg.cholesky_ex(squares)
        smallest, largest = torch.aminmax(torch.diagonal(first))
        if failed or not smallest > MIN_QUICK_PIVOT * scale:
            return None
        rows = self._next_rows(len(block))
        self._multiply(_inverse(first), block, rows)
        if smallest > MIN_ONE_PASS_PIVOT * largest:
            return rows, first.T
        squares = self._sum_pieces(lambda piece: overlaps(rows, rows, piece))
        second = torch.linalg.cholesky(squares)
        self._multiply(_inverse(second), rows, rows)
        return rows, second.T @ first.T


def _coefficients(ritz: RitzPairs, index: torch.Tensor) -> torch.Tensor:
    """Return the normalised coefficients (m + b, K) of the Ritz pairs with these indices."""
    coefficients = ritz.coefficients[:, index]
    return coefficients / torch.linalg.norm(coefficients, dim=0)


def _inverse(factor: torch.Tensor) -> torch.Tensor:
    """Return the inverse of a lower triangular matrix."""
    return torch.linalg.solve_triangular(factor, identity(len(factor)), upper=False)

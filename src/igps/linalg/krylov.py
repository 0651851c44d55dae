"""A block Krylov basis that grows block by block, and the eigenpairs of the operator projected on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import qr

from igps.linalg.checks import ROUNDING
from igps.linalg.factorization import Factorization

BLOCK_SIZE = 16
# Below this, relative to what it came from, a pivot makes a Cholesky factor inaccurate
CHOLESKY_QR_PIVOT = 1e-6


@dataclass(frozen=True)
class RitzPairs:
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


class Krylov:
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

    def ritz_pairs(self, shift: float) -> RitzPairs:
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

    def eigenvectors(self, ritz: RitzPairs, index: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
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

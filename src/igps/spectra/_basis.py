"""A growing basis, stored as rows in memory, and sums over its columns that several threads compute in pieces."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch

from igps._threads import SERIAL, Team

# Entries of the largest basis that has a copy in single precision, of 1 GiB.
MAX_SINGLE_ENTRIES = 2**28
# Entries of the largest basis, 128 MiB, that NumPy allocates with huge pages. They make products faster, but for a
# larger basis it costs more to wait for them.
MAX_HUGE_PAGE_ENTRIES = 2**24
# Smallest piece of the columns, and largest number of pieces; a thread works on one piece at a time.
MIN_PIECE_COLUMNS = 2**12
MAX_PIECES = 8


class Basis:
    """Rows of a basis, a copy of them in single precision, and the matrix of the problem projected on them.

    The columns are split into pieces, on which the threads of a team work in parallel. Their number depends only on the
    number of columns, so that every team gives the same bits. If `overwrites_basis` is true, the basis is so large that
    the eigenvectors must be written over it.
    """

    def __init__(self, first_row: np.ndarray, capacity: int, team: Team = SERIAL) -> None:
        self._team = team
        n_columns = len(first_row)
        n_pieces = min(MAX_PIECES, n_columns // MIN_PIECE_COLUMNS)
        self._pieces = split(n_columns, max(1, n_pieces))
        self.overwrites_basis = (capacity + 1) * n_columns > MAX_SINGLE_ENTRIES
        # Reading single precision takes half the time.
        self._single: torch.Tensor | None
        self._allocate(capacity + 1, n_columns)
        self._basis[0] = torch.from_numpy(first_row)
        if self._single is not None:
            self._single[0] = self._basis[0]
        shape = (capacity + 1, capacity + 1)
        self._projected = torch.zeros(shape, dtype=torch.float64, device="cpu")
        # Rows before _stop are filled. Rows before _n_orthogonal are orthogonal to all rows before them, later rows
        # only to the neighbouring blocks.
        self._stop = self._n_orthogonal = 1

    def _allocate(self, n_rows: int, n_columns: int) -> None:
        """Allocate a new basis. Memory of NumPy, unlike that of PyTorch, can be released in part later."""
        shape = n_rows, n_columns
        self._memory = np.empty(shape if self.overwrites_basis else (0, n_columns))
        if self.overwrites_basis:
            self._basis = torch.from_numpy(self._memory)
            self._single = None
        elif n_rows * n_columns <= MAX_HUGE_PAGE_ENTRIES:
            self._basis = torch.from_numpy(np.empty(shape, np.float64))
            self._single = torch.from_numpy(np.empty(shape, np.float32))
        else:
            self._basis = torch.empty(shape, dtype=torch.float64, device="cpu")
            self._single = torch.empty(shape, dtype=torch.float32, device="cpu")

    def _sum_pieces(self, function: Callable[[slice], torch.Tensor]) -> torch.Tensor:
        """Call a function for each piece of the columns, and add its results in the order of the pieces."""
        total, *others = self._team.each(function, self._pieces)
        for part in others:
            total.add_(part)
        return total

    def _next_rows(self, n_rows: int) -> torch.Tensor:
        """Return the free rows to which the next block is written; the basis is enlarged if necessary."""
        stop = self._stop + n_rows
        if stop > len(self._basis):
            capacity = len(self._basis) * 3 // 2 + n_rows
            filled = slice(self._stop)
            basis = self._basis
            single = self._single
            projected = self._projected
            self._allocate(capacity, basis.shape[1])
            self._basis[filled] = basis[filled]
            if self._single is not None and single is not None:
                self._single[: self._n_orthogonal] = single[: self._n_orthogonal]
            self._projected = projected.new_zeros(capacity, capacity)
            self._projected[filled, filled] = projected[filled, filled]
        return self._basis[self._stop : stop]

    def _append(self, block: torch.Tensor, *, is_orthogonal: bool) -> None:
        rows = self._next_rows(len(block))
        if block.data_ptr() != rows.data_ptr():
            rows.copy_(block)
        self._stop += len(block)
        if is_orthogonal:
            self._mark_orthogonal()

    def _mark_orthogonal(self) -> None:
        rows = slice(self._n_orthogonal, self._stop)

        def copy(piece: slice) -> None:
            if self._single is not None:
                self._single[rows, piece] = self._basis[rows, piece]

        self._team.each(copy, self._pieces)
        self._n_orthogonal = self._stop

    def _multiply(self, factor: torch.Tensor, rows: torch.Tensor, out: torch.Tensor) -> None:
        """Write the product of a matrix (b, b) with rows (b, V) to ``out``, which may be ``rows``."""

        def multiply(piece: slice) -> None:
            if out is rows:
                rows[:, piece] = factor @ rows[:, piece]
            else:
                torch.mm(factor, rows[:, piece], out=out[:, piece])

        self._team.each(multiply, self._pieces)


def split(size: int, number: int) -> list[slice]:
    cuts = np.linspace(0, size, number + 1).astype(int)
    return [slice(begin, end) for begin, end in pairwise(cuts.tolist())]

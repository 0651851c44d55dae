"""The rows of a basis that grows, in memory, and the sums over their columns that a team makes piece by piece."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch

from igps._threads import ALONE, Team

# Of a larger basis there is no copy in single precision, to save memory: 1 GiB
MOST_SINGLE_ENTRIES = 2**28
# Up to 128 MiB a basis gains by the huge pages that NumPy asks the system for; for larger ones the wait costs more
MOST_HUGE_ENTRIES = 2**24
# Columns of a piece of the basis, of which a thread computes with one at a time, and the most pieces
PIECE, MOST_PIECES = 2**12, 8


class Basis:
    """Rows of a basis, a copy of them in single precision, and the matrix of the problem projected on them.

    The columns are cut into pieces, which a team works on side by side; how many depends on their number alone, so that
    a team changes no bit. Where `loses_basis` is true, it is so large that the eigenvectors must take its place.
    """

    def __init__(self, first_row: np.ndarray, capacity: int, team: Team = ALONE) -> None:
        self._team = team
        n_columns = len(first_row)
        self._pieces = pieces_of(n_columns, max(1, min(MOST_PIECES, n_columns // PIECE)))
        self.loses_basis = (capacity + 1) * n_columns > MOST_SINGLE_ENTRIES
        # to be read in half the time
        self._single: torch.Tensor | None
        self._allocate(capacity + 1, n_columns)
        self._basis[0] = torch.from_numpy(first_row)
        if self._single is not None:
            self._single[0] = self._basis[0]
        self._projected = torch.zeros(capacity + 1, capacity + 1, dtype=torch.float64, device="cpu")
        # rows before stop are filled; those before swept are orthogonal to all before them, those behind it to their
        # neighbours
        self._stop = self._swept = 1

    def _allocate(self, n_rows: int, n_columns: int) -> None:
        """A new basis. Of NumPy's memory a part can be given back."""
        shape = n_rows, n_columns
        self._memory = np.empty(shape if self.loses_basis else (0, n_columns))
        if self.loses_basis:
            self._basis, self._single = torch.from_numpy(self._memory), None
        elif n_rows * n_columns <= MOST_HUGE_ENTRIES:
            self._basis, self._single = (torch.from_numpy(np.empty(shape, kind)) for kind in (np.float64, np.float32))
        else:
            self._basis = torch.empty(shape, dtype=torch.float64, device="cpu")
            self._single = torch.empty(shape, dtype=torch.float32, device="cpu")

    def _sums(self, parts: Callable[[slice], tuple[torch.Tensor, ...]]) -> tuple[torch.Tensor, ...]:
        """What each piece of the columns contributes, added in the order of the pieces."""
        first, *others = self._team.each(parts, self._pieces)
        for other in others:
            for total, part in zip(first, other, strict=True):
                total.add_(part)
        return first

    def _next_rows(self, n_rows: int) -> torch.Tensor:
        """The rows of the basis behind the last, which a block is written to before it is appended."""
        stop = self._stop + n_rows
        if stop > len(self._basis):
            capacity = len(self._basis) * 3 // 2 + n_rows
            basis, single, projected = self._basis, self._single, self._projected
            self._allocate(capacity, basis.shape[1])
            self._basis[: self._stop] = basis[: self._stop]
            if self._single is not None and single is not None:
                self._single[: self._swept] = single[: self._swept]
            self._projected = projected.new_zeros(capacity, capacity)
            self._projected[: self._stop, : self._stop] = projected[: self._stop, : self._stop]
        return self._basis[self._stop : stop]

    def _append(self, block: torch.Tensor, *, swept: bool) -> None:
        rows = self._next_rows(len(block))
        if block.data_ptr() != rows.data_ptr():
            rows.copy_(block)
        self._stop += len(block)
        if swept:
            self._mark_swept()

    def _mark_swept(self) -> None:
        rows = slice(self._swept, self._stop)

        def copy(piece: slice) -> None:
            if self._single is not None:
                self._single[rows, piece] = self._basis[rows, piece]

        self._team.each(copy, self._pieces)
        self._swept = self._stop

    def _multiply(self, factor: torch.Tensor, rows: torch.Tensor, out: torch.Tensor) -> None:
        """The product of a matrix (b, b) with rows (b, V), which ``out`` may be."""

        def multiply(piece: slice) -> None:
            if out is rows:
                rows[:, piece] = factor @ rows[:, piece]
            else:
                torch.mm(factor, rows[:, piece], out=out[:, piece])

        self._team.each(multiply, self._pieces)


def pieces_of(size: int, number: int) -> list[slice]:
    cuts = np.linspace(0, size, number + 1).astype(int).tolist()
    return [slice(begin, end) for begin, end in pairwise(cuts)]

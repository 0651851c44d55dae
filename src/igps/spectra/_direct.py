"""Factorizations: by compiled loops where there is a compiler, by PyTorch's batches of products where there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from scipy import sparse

from igps._compiled import is_available
from igps._threads import ALONE, Team
from igps.spectra import _multifrontal as multifrontal
from igps.spectra._factorization import factorize
from igps.spectra._ordering import LEAF_SIZE
from igps.spectra._symbolic import Dissection, dissect


class Factors(Protocol):
    """The factors of a symmetric matrix."""

    @property
    def n_negative(self) -> int:
        """Its number of negative eigenvalues."""

    def solve(self, right_hand_sides: torch.Tensor, team: Team = ALONE) -> torch.Tensor:
        """The solutions (V, b) for right-hand sides (V, b), float64; their bits do not depend on the team."""


class Structure(Protocol):
    """Elimination order and block structure for one sparsity pattern; serves any number of values and shifts."""

    def factorize(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> Factors:
        """The factors of ``matrix − shift · I``; their bits do not depend on the team."""

    def inertia(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> int:
        """The number of negative eigenvalues of ``matrix − shift · I``."""

    def arranged(self, matrix: sparse.csr_array) -> tuple[Structure, sparse.csr_array, np.ndarray]:
        """The structure for unknowns that lie in memory as it uses them, such a matrix, and where each was (V,)."""


@dataclass(frozen=True)
class Batched:
    """The structure of a factorization by batches."""

    dissection: Dissection

    def factorize(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> Factors:
        return factorize(self.dissection, matrix, shift)

    def inertia(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> int:
        return factorize(self.dissection, matrix, shift).n_negative

    def arranged(self, matrix: sparse.csr_array) -> tuple[Structure, sparse.csr_array, np.ndarray]:
        return self, matrix, np.arange(matrix.shape[0])


def analyse(
    matrix: sparse.csr_array, coordinates: np.ndarray | None = None, *, leaf_size: int = LEAF_SIZE
) -> Structure:
    """The structure for all matrices with one symmetric pattern; arguments and errors are those of `dissect`."""
    if is_available():
        return multifrontal.analyse(matrix, coordinates, leaf_size=leaf_size)
    return Batched(dissect(matrix, coordinates, leaf_size=leaf_size))

"""Sparse symmetric factorization as a short sequence of batched dense products.

Solvers such as SuperLU walk a sparse factor column by column and reach a few per cent of the machine's speed. Here
the matrix is cut into a binary tree of small dense blocks, and the blocks of a tree level are eliminated as batches:

1. *Nested dissection* (George 1973; `ordering`). A vertex separator splits the graph of the matrix in two halves, each
   half is split again, down to leaves of some tens of vertices. On a surface the first separator has O(√V) vertices.
   All nodes of one level are split together: the loops run over levels, not over nodes.
2. *Multifrontal elimination* (Duff & Reid 1983), leaves first. A node owns the vertices of its separator, a leaf all
   that is left to it; its *boundary* are the vertices of its ancestors that its subtree touches. Of its dense *front*

       F = [F₁₁ F₁₂]   own rows
           [F₂₁ F₂₂]   boundary rows

   the own unknowns are eliminated, and the Schur complement F₂₂ − F₂₁ F₁₁⁻¹ F₁₂ is added into the parent's front.
3. *Solve*. Each node keeps D = F₁₁⁻¹ and E = −F₁₁⁻¹ F₁₂. On the way up, Eᵀ b_own is added to the right-hand sides of
   the boundary; on the way down, x_own = D b_own + E x_boundary. Both are batched products for all right-hand sides.

The negative eigenvalues of all pivot blocks F₁₁ together number as many as those of the matrix (Sylvester's law of
inertia). For A − σI that is the number of eigenvalues of A below σ, and proves that an eigensolver missed none.

No pivot moves from one block to another. That is stable for a positive definite matrix. For an indefinite A − σI it is
so unless σ lies close to an eigenvalue of a leading block, which is rare but does happen: check a residual.

`multifrontal` does the same by compiled loops, in a quarter of the time. This is for where there is no compiler, and
for other devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from igps._threads import ALONE, Team
from igps.spectra._checks import canonical, check_entries
from igps.spectra._symbolic import Batch, Dissection

# Fronts are added to their parents in chunks of so many matrix entries, to bound the memory for their indices.
CHUNK_ENTRIES = 2**22
SINGULAR = "a pivot block of the shifted matrix is singular: use a slightly different shift"


class SingularMatrixError(ValueError):
    """A pivot block of the shifted matrix is singular: the shift hits an eigenvalue of it."""


@dataclass(frozen=True)
class Factorization:
    """The factors of one matrix: solves with it, and its number of negative eigenvalues.

    Attributes:
        dissection: the structure it was made with.
        blocks: per level and batch (N, S, S + B), [D E] of the module docstring.
        n_negative: number of negative eigenvalues of the matrix.
    """

    dissection: Dissection
    blocks: tuple[tuple[torch.Tensor, ...], ...]
    n_negative: int

    def solve(self, right_hand_sides: torch.Tensor, team: Team = ALONE) -> torch.Tensor:
        """The solutions (V, b) for right-hand sides (V, b), float64 on the device of the dissection.

        PyTorch does not release the interpreter's lock between its many small products: a team would not help.
        """
        n_vertices, n_columns = right_hand_sides.shape
        vectors = right_hand_sides.new_zeros(n_vertices + 1, n_columns)  # the last row stands for padding and stays 0
        vectors[:n_vertices] = right_hand_sides
        levels = list(zip(self.dissection.levels, self.blocks, strict=True))
        for level, blocks in levels[:-1]:
            own = vectors.index_select(0, level.own)
            update = vectors.new_empty(len(level.boundary), n_columns)
            eliminations = [
                block[:, :, batch.shape[1] :].mT for batch, block in zip(level.batches, blocks, strict=True)
            ]
            _multiply(eliminations, own, update)
            vectors.index_put_((level.boundary,), update, accumulate=True)
        for level, blocks in reversed(levels):
            known = vectors.index_select(0, level.rows)
            own = vectors.new_empty(len(level.own), n_columns)
            _multiply(blocks, known, own)
            vectors.index_copy_(0, level.own, own)
        return vectors[:n_vertices]


def _multiply(matrices: Sequence[torch.Tensor], vectors: torch.Tensor, products: torch.Tensor) -> None:
    """Products of batches (N, r, c) with (N, c, b); the vectors of all batches lie end to end, so do the products."""
    n_columns = vectors.shape[1]
    first_vector = first_product = 0
    for matrix in matrices:
        n_fronts, n_rows, n_inner = matrix.shape
        last_vector, last_product = first_vector + n_fronts * n_inner, first_product + n_fronts * n_rows
        torch.bmm(
            matrix,
            vectors[first_vector:last_vector].view(n_fronts, n_inner, n_columns),
            out=products[first_product:last_product].view(n_fronts, n_rows, n_columns),
        )
        first_vector, first_product = last_vector, last_product


def factorize(dissection: Dissection, matrix: sparse.csr_array, shift: float = 0.0) -> Factorization:
    """Factorize ``matrix − shift · I``, float64.

    Args:
        dissection: structure from `dissect` for a matrix with the same stored entries.
        matrix: (V, V) symmetric; both triangles are read.
        shift: any number that is not an eigenvalue.

    Raises:
        ValueError: the stored entries of matrix are not those of the dissection.
        SingularMatrixError: a pivot block is singular.
    """
    matrix = canonical(matrix)
    check_entries(matrix, dissection.indptr, dissection.indices)
    values = torch.from_numpy(matrix.data.astype(np.float64)).to(dissection.device)
    all_blocks = []
    n_negative = 0
    updates: list[tuple[Batch, torch.Tensor]] = []
    for level in dissection.levels:
        fronts = values.new_zeros(level.buffer_size)
        fronts[level.slot] = values[level.entry]
        fronts[level.diagonal] -= shift
        fronts[level.padding] = 1.0
        while updates:
            _extend_add(fronts, *updates.pop())
        blocks = []
        for batch in level.batches:
            n_fronts, n_own, n_boundary = batch.shape
            width = n_own + n_boundary
            front = fronts[batch.offset : batch.offset + n_fronts * width**2].view(n_fronts, width, width)
            inverse, n_negative_pivots = invert(front[:, :n_own, :n_own])
            coupling = front[:, :n_own, n_own:]
            elimination = -torch.bmm(inverse, coupling)
            blocks.append(torch.cat([inverse, elimination], 2))
            n_negative += n_negative_pivots
            updates.append((batch, torch.baddbmm(front[:, n_own:, n_own:], coupling.mT, elimination)))
        all_blocks.append(tuple(blocks))
    return Factorization(dissection, tuple(all_blocks), n_negative)


def _extend_add(fronts: torch.Tensor, batch: Batch, update: torch.Tensor) -> None:
    """Add the Schur complements (N, B, B) of a batch into the fronts of the parents, in place."""
    row_start = batch.parent_offset[:, None] + batch.parent_row * batch.parent_width[:, None]
    chunk = max(1, CHUNK_ENTRIES // max(1, update[0].numel()))
    for starts, columns, values in zip(
        row_start.split(chunk), batch.parent_row.split(chunk), update.split(chunk), strict=True
    ):
        fronts.index_add_(0, (starts[:, :, None] + columns[:, None, :]).flatten(), values.flatten())


def invert(pivots: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Inverses of symmetric blocks (N, S, S), and how many negative eigenvalues the blocks have together."""
    factors, failed = torch.linalg.cholesky_ex(pivots)
    indefinite = failed > 0
    if not indefinite.any():
        return torch.cholesky_inverse(factors), 0
    inverses = torch.empty_like(pivots)
    inverses[~indefinite] = torch.cholesky_inverse(factors[~indefinite])
    factors, order, failed = torch.linalg.ldl_factor_ex(pivots[indefinite])
    if failed.any():
        raise SingularMatrixError(SINGULAR)
    identity = torch.eye(pivots.shape[-1], dtype=pivots.dtype, device=pivots.device).expand_as(factors)
    inverse = torch.linalg.ldl_solve(factors, order, identity)
    inverses[indefinite] = (inverse + inverse.mT) / 2
    # Bunch & Kaufman's pivots: a 1×1 one counts by its sign, a 2×2 one (marked by a negative index) has one eigenvalue
    # of either sign
    diagonal = torch.diagonal(factors, dim1=-2, dim2=-1)
    n_negative = ((order > 0) & (diagonal < 0)).sum() + (order < 0).sum() // 2
    return inverses, int(n_negative)

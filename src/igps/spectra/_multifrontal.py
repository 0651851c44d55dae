"""Sparse symmetric factorization as a sequence of dense eliminations, compiled.

Solvers such as SuperLU walk a sparse factor column by column and reach a few per cent of the machine's speed. Here
the matrix is cut into a binary tree of small dense blocks:

1. *Nested dissection* (George 1973; `_ordering`). A vertex separator splits the graph of the matrix in two halves, each
   half is split again, down to leaves of some tens of vertices. On a surface the first separator has O(√V) vertices.
2. *Multifrontal elimination* (Duff & Reid 1983), children first. A node owns the vertices of its separator, a leaf all
   that is left to it; its *boundary* are the vertices of its ancestors that its subtree touches. Of its dense *front*

       F = [F₁₁ F₁₂]   own rows
           [F₂₁ F₂₂]   boundary rows

   the own unknowns are eliminated, and the Schur complement F₂₂ − F₂₁ F₁₁⁻¹ F₁₂ is added into the parent's front. As
   the nodes come depth first, that is soon, while the processor's cache still holds it, and only the complements along
   one branch are kept.
3. *Solve*. Each node keeps D = F₁₁⁻¹ and E = −F₁₁⁻¹ F₁₂. On the way up, Eᵀ b_own is added to the right-hand sides of
   the boundary; on the way down, x_own = D b_own + E x_boundary.

The negative eigenvalues of all pivot blocks F₁₁ together number as many as those of the matrix (Sylvester's law of
inertia). For A − σI that is the number of eigenvalues of A below σ, and proves that an eigensolver missed none.

No pivot moves from one block to another. That is stable for a positive definite matrix. For an indefinite A − σI it is
so unless σ lies close to an eigenvalue of a leading block, which is rare but does happen: check a residual.

`_fronts` has the compiled loops. Pivot blocks of more than LARGE unknowns are PyTorch's, and so are those that are
indefinite and need pivots in another order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse

from igps._arrays import Floats
from igps._threads import ALONE, Team
from igps.spectra import _fronts as loops
from igps.spectra._checks import checked_entries
from igps.spectra._ordering import LEAF_SIZE, checked_graph, nested_dissection
from igps.spectra._pivots import Scratch
from igps.spectra._tree import Nodes, Structure, tree_structure

# Own unknowns of a node above which its dense algebra is PyTorch's, for which a team can work
LARGE = 127
# Rows or columns of such a node that are multiplied at once
AT_ONCE = 256


class SingularMatrixError(ValueError):
    """A pivot block of the shifted matrix is singular: the shift hits an eigenvalue of it."""


@dataclass(frozen=True)
class Tree:
    """Elimination order and fronts for one sparsity pattern; serves any number of values and shifts."""

    structure: Structure
    subtrees: list[Nodes]  # may be eliminated, and solved, side by side
    above: list[Nodes]  # the other nodes, each behind its children

    def factorize(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> Factors:
        """The factors of ``matrix − shift · I``, of which both triangles are read; a team changes none of their bits.

        A ValueError if the matrix stores other entries than the one that was analysed, a SingularMatrixError if a pivot
        block is singular, as at an eigenvalue.
        """
        blocks = np.empty(self.structure.block_start[-1])
        return Factors(self, blocks, self._eliminate(matrix, shift, team, blocks))

    def inertia(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> int:
        """The number of negative eigenvalues of ``matrix − shift · I``; arguments and errors as of `factorize`."""
        return self._eliminate(matrix, shift, team, None)

    def arranged(self, matrix: sparse.csr_array) -> tuple[Tree, sparse.csr_array, np.ndarray]:
        """The structure for unknowns in the order of elimination, such a matrix, and which each was before (V,)."""
        order = self.structure.order
        matrix = checked_entries(matrix, self.structure.indptr, self.structure.indices)[order][:, order]
        matrix.sort_indices()
        indptr, indices = (array.astype(np.int32, copy=False) for array in (matrix.indptr, matrix.indices))
        same = np.arange(len(order))
        structure = self.structure._replace(indptr=indptr, indices=indices, order=same, number=same)
        return replace(self, structure=structure), matrix, order

    def _eliminate(self, matrix: sparse.csr_array, shift: float, team: Team, blocks: np.ndarray | None) -> int:
        """Write the blocks, if they are to be kept; the number of negative eigenvalues."""
        matrix = checked_entries(matrix, self.structure.indptr, self.structure.indices)
        n_updates = (self.structure.update_start + np.diff(self.structure.start) ** 2).max()
        values, updates = matrix.data.astype(np.float64, copy=False), np.empty(n_updates)

        def eliminate(nodes: Nodes) -> int:
            return self._eliminate_range(nodes, values, float(shift), updates, blocks, team)

        return sum(team.each(eliminate, self.subtrees)) + sum(map(eliminate, self.above))

    def _eliminate_range(
        self, nodes: Nodes, values: Floats, shift: float, updates: Floats, blocks: Floats | None, team: Team
    ) -> int:
        """Write the blocks of a range of nodes, and what they leave to nodes behind it; their negative pivots."""
        (begin, end), structure = nodes, self.structure
        n_own, n_boundary = np.diff(structure.first[begin : end + 1]), np.diff(structure.start[begin : end + 1])
        front = np.empty(int((n_own + n_boundary).max()) ** 2)
        if blocks is None:  # each takes the place of the last
            blocks = np.empty(int((n_own * (n_own + n_boundary)).max()))
            structure = structure._replace(block_start=np.zeros_like(structure.block_start))
        padded = min(LARGE, int(n_own.max())) + loops.AT_ONCE
        squares = [np.empty(padded**2) for _ in range(3)]
        strips = [np.empty(loops.AT_ONCE * (padded + loops.AT_ONCE)) for _ in range(2)]
        scratch = Scratch(np.empty(len(structure.order), dtype=np.int64), front, *squares, *strips)
        n_negative, node = 0, begin
        while True:
            n_more, node = loops.eliminate((node, end), LARGE, structure, values, shift, updates, blocks, scratch)
            n_negative += n_more
            if node == end:
                return n_negative
            size, n_bound = int(n_own[node - begin]), int(n_boundary[node - begin])
            n_negative += _eliminate_alone(
                torch.from_numpy(front[: (size + n_bound) ** 2].reshape(size + n_bound, size + n_bound)),
                torch.from_numpy(blocks[structure.block_start[node] :][: size * (size + n_bound)].reshape(size, -1)),
                torch.from_numpy(updates[structure.update_start[node] :][: n_bound**2].reshape(n_bound, n_bound)),
                team,
            )
            node += 1


@dataclass(frozen=True)
class Factors:
    """The factors of one matrix: solves with it, and its number of negative eigenvalues."""

    tree: Tree  # the structure they were made with
    blocks: np.ndarray  # each node's (S, S + B) block [D E], end to end
    n_negative: int

    def solve(self, right_hand_sides: torch.Tensor, team: Team = ALONE) -> torch.Tensor:
        """The solutions (V, b) for right-hand sides (V, b), float64, both best stored by columns."""
        tree, structure = self.tree, self.tree.structure
        n_vertices, b = right_hand_sides.shape
        right = right_hand_sides.T.contiguous().numpy()
        solution = torch.empty(b, n_vertices, dtype=torch.float64, device="cpu")
        n_boundary = np.diff(structure.start)
        x, carried = np.empty(n_vertices * b), np.empty((structure.carried_start + n_boundary).max() * b)
        largest = int((np.diff(structure.first) + n_boundary).max())

        def forward(nodes: Nodes) -> None:
            loops.forward(nodes, right, structure, self.blocks, x, carried, largest)

        def backward(nodes: Nodes) -> None:
            loops.backward(nodes, structure, self.blocks, x, largest, solution.numpy())

        team.each(forward, tree.subtrees)
        for nodes in tree.above:
            forward(nodes)
        for nodes in reversed(tree.above):
            backward(nodes)
        team.each(backward, tree.subtrees)
        return solution.T


def analyse(matrix: sparse.csr_array, coordinates: np.ndarray | None = None, *, leaf_size: int = LEAF_SIZE) -> Tree:
    """Elimination order and fronts for all matrices with one symmetric sparsity pattern.

    Args:
        matrix: (V, V) with a symmetric pattern that holds the whole diagonal; only the pattern is read.
        coordinates: (V, d) places along which the graph is cut, any unit; short edges make good cuts. Without
            them hop distances to a few far-apart vertices serve, with somewhat larger blocks.
        leaf_size: a part of about so many vertices is not split any more.

    Raises:
        ValueError: the pattern is not symmetric or lacks diagonal entries, or coordinates do not fit it.
    """
    matrix, coordinates = checked_graph(matrix, coordinates)
    node, n_levels = nested_dissection(matrix, coordinates, leaf_size)
    indptr, indices = (array.astype(np.int32, copy=False) for array in (matrix.indptr, matrix.indices))
    return Tree(*tree_structure(node, n_levels, indptr, indices))


def _eliminate_alone(front: torch.Tensor, block: torch.Tensor, update: torch.Tensor, team: Team) -> int:
    """Write D, E and the complement of a front; of both only the upper triangle counts. Its negative pivots."""
    n_own, n_bound = len(block), len(update)
    pivot, coupling = front[:n_own, :n_own].triu(), front[:n_own, n_own:]
    inverse, n_negative = _invert(pivot + pivot.triu(1).T)
    block[:, :n_own] = inverse
    elimination, below = block[:, n_own:], front[n_own:, n_own:]
    pieces = [slice(begin, begin + AT_ONCE) for begin in range(0, n_bound, AT_ONCE)]

    def eliminate(piece: slice) -> None:
        elimination[:, piece] = -(inverse @ coupling[:, piece])

    def complement(piece: slice) -> None:
        behind = slice(piece.start, None)
        torch.addmm(below[piece, behind], coupling[:, piece].T, elimination[:, behind], out=update[piece, behind])

    team.each(eliminate, pieces)
    team.each(complement, pieces)
    return n_negative


def _invert(pivot: torch.Tensor) -> tuple[torch.Tensor, int]:
    """The inverse of a symmetric block (S, S), and its number of negative eigenvalues."""
    factor, failed = torch.linalg.cholesky_ex(pivot)
    if not failed:
        return torch.cholesky_inverse(factor), 0
    factor, order, failed = torch.linalg.ldl_factor_ex(pivot)
    if failed:
        raise SingularMatrixError("a pivot block of the shifted matrix is singular: use a slightly different shift")
    inverse = torch.linalg.ldl_solve(factor, order, torch.eye(len(pivot), dtype=pivot.dtype, device="cpu"))
    # Bunch & Kaufman's pivots: a 1×1 one counts by its sign, a 2×2 one (marked by a negative index) has one eigenvalue
    # of either sign
    n_negative = ((order > 0) & (factor.diagonal() < 0)).sum() + (order < 0).sum() // 2
    return (inverse + inverse.T) / 2, int(n_negative)

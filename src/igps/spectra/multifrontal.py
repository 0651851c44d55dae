"""Sparse symmetric factorization as a sequence of dense eliminations, compiled.

Solvers such as SuperLU process a sparse factor column by column, at a few per cent of the machine's peak speed. Here
the matrix is split into a binary tree of small dense blocks:

1. *Nested dissection* (George 1973; `_ordering`). A vertex separator splits the graph of the matrix into two halves,
   which are split again, down to leaves of some tens of vertices. On a surface the first separator has O(√V) vertices.
2. *Multifrontal elimination* (Duff & Reid 1983), children first. A node owns the vertices of its separator, and a leaf
   owns its remaining vertices. The *boundary* of a node consists of the vertices of its ancestors that its subtree
   touches. Each node has a dense *front*

       F = [F₁₁ F₁₂]   own rows
           [F₂₁ F₂₂]   boundary rows

   from which the own unknowns are eliminated. The Schur complement F₂₂ − F₂₁ F₁₁⁻¹ F₁₂ is added to the parent's front.
   Since nodes are processed depth first, this happens while the complement is still in the processor's cache, and only
   the complements along one branch are stored.
3. *Solve*. Each node stores D = F₁₁⁻¹ and E = −F₁₁⁻¹ F₁₂. On the way up, Eᵀ b_own is added to the right-hand sides of
   the boundary; on the way down, x_own = D b_own + E x_boundary.

The pivot blocks F₁₁ together have as many negative eigenvalues as the matrix (Sylvester's law of inertia). For A − σI
this is the number of eigenvalues of A below σ, which proves that an eigensolver has missed none.

Pivots stay in their blocks. This is stable for a positive definite matrix. It is also stable for an indefinite A − σI,
unless σ is close to an eigenvalue of a leading block. That is rare but possible: check a residual.

`_fronts` contains the compiled loops. PyTorch handles pivot blocks of more than MAX_COMPILED unknowns, and
indefinite ones that need another order of pivots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse

from igps._arrays import Floats
from igps._threads import SERIAL, Team
from igps.spectra import _fronts as loops
from igps.spectra._checks import checked_entries, pattern
from igps.spectra._ordering import LEAF_SIZE, checked_graph, nested_dissection
from igps.spectra._pivots import Scratch
from igps.spectra._products import identity
from igps.spectra.tree import BLOCK, CARRIED, UPDATE, Nodes, Structure, tree_structure

# Largest number of own unknowns of a node that compiled loops handle. PyTorch handles larger nodes, with a team.
MAX_COMPILED = 127
# Number of rows or columns of a larger node that are multiplied at a time.
PIECE_SIZE = 256


class SingularMatrixError(ValueError):
    """A pivot block of the shifted matrix is singular: the shift is an eigenvalue of the block."""


@dataclass(frozen=True)
class Tree:
    """Elimination order and fronts for one sparsity pattern, usable with any values and shifts."""

    structure: Structure
    subtrees: list[Nodes]  # can be eliminated and solved in parallel
    above: list[Nodes]  # the other nodes, each after its children

    def factorize(
        self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = SERIAL
    ) -> Factors:
        """Factorize ``matrix − shift · I``, of which both triangles are read; every team gives the same bits.

        A ValueError is raised if the matrix stores other entries than the analysed one, a SingularMatrixError if a
        pivot block is singular, as for a shift at an eigenvalue.
        """
        blocks = np.empty(self.structure.nodes[BLOCK, -1])
        n_negative = self._eliminate(matrix, shift, team, blocks)
        return Factors(self, blocks, n_negative)

    def inertia(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = SERIAL) -> int:
        """Return the number of negative eigenvalues of ``matrix − shift · I``, with the errors of `factorize`."""
        return self._eliminate(matrix, shift, team, None)

    def arranged(self, matrix: sparse.csr_array) -> tuple[Tree, sparse.csr_array, np.ndarray]:
        """Return the tree and the matrix with unknowns in elimination order, and the former index (V,) of each."""
        order = self.structure.order
        matrix = self._checked(matrix)[order][:, order]
        matrix.sort_indices()
        indptr, indices = pattern(matrix)
        same = np.arange(len(order))
        structure = self.structure._replace(
            indptr=indptr, indices=indices, order=same, position=same
        )
        return replace(self, structure=structure), matrix, order

    def _checked(self, matrix: sparse.csr_array) -> sparse.csr_array:
        return checked_entries(matrix, self.structure.indptr, self.structure.indices)

    def _eliminate(
        self, matrix: sparse.csr_array, shift: float, team: Team, blocks: np.ndarray | None
    ) -> int:
        """Eliminate all nodes, write to `blocks` if given, and return the number of negative eigenvalues."""
        values = self._checked(matrix).data.astype(np.float64, copy=False)
        ends = self.structure.nodes[UPDATE, :-1] + self.structure.n_boundary**2
        updates = np.empty(ends.max())

        def eliminate(nodes: Nodes) -> int:
            return self._eliminate_range(nodes, values, float(shift), updates, blocks, team)

        n_negative = sum(team.each(eliminate, self.subtrees))
        return n_negative + sum(map(eliminate, self.above))

    def _eliminate_range(
        self,
        nodes: Nodes,
        values: Floats,
        shift: float,
        updates: Floats,
        blocks: Floats | None,
        team: Team,
    ) -> int:
        """Eliminate a range of nodes as `_eliminate`, and write the complements for later nodes to `updates`."""
        node, end = nodes
        structure = self.structure
        own_sizes = structure.n_own[node:end]
        widths = own_sizes + structure.n_boundary[node:end]
        if blocks is None:  # each block overwrites the previous one
            blocks = np.empty((own_sizes * widths).max())
            table = structure.nodes.copy()
            table[BLOCK] = 0
            structure = structure._replace(nodes=table)
        padded = min(MAX_COMPILED, int(own_sizes.max())) + loops.STEP
        strip_size = loops.STEP * (padded + loops.STEP)
        scratch = Scratch(
            boundary_row=np.empty(len(structure.order), dtype=np.int64),
            front=np.empty(widths.max() ** 2),
            inverse=np.empty(padded**2),
            pivot_copy=np.empty(padded**2),
            residual=np.empty(padded**2),
            rows=np.empty(strip_size),
            columns=np.empty(strip_size),
        )
        n_negative = 0
        while True:
            n_new, node = loops.eliminate(
                (node, end), MAX_COMPILED, structure, values, shift, updates, blocks, scratch
            )
            n_negative += n_new
            if node == end:
                return n_negative
            n_own = int(structure.n_own[node])
            n_boundary = int(structure.n_boundary[node])
            width = n_own + n_boundary
            n_negative += _eliminate_node(
                _matrix(scratch.front, 0, (width, width)),
                _matrix(blocks, structure.nodes[BLOCK, node], (n_own, width)),
                _matrix(updates, structure.nodes[UPDATE, node], (n_boundary, n_boundary)),
                team,
            )
            node += 1


@dataclass(frozen=True)
class Factors:
    """Factors of one matrix, for solves, and its number of negative eigenvalues."""

    tree: Tree
    blocks: np.ndarray  # (S, S + B) block [D E] of each node, end to end
    n_negative: int

    def solve(self, right_hand_sides: torch.Tensor, team: Team = SERIAL) -> torch.Tensor:
        """Return the solutions (V, b) for right-hand sides (V, b), float64, both preferably stored by columns."""
        tree = self.tree
        structure = self.tree.structure
        n_vertices, b = right_hand_sides.shape
        right = right_hand_sides.T.contiguous().numpy()
        solution = torch.empty(b, n_vertices, dtype=torch.float64, device="cpu")
        x = np.empty(n_vertices * b)
        ends = structure.nodes[CARRIED, :-1] + structure.n_boundary
        carried = np.empty(ends.max() * b)
        widths = structure.n_own + structure.n_boundary
        size = int(widths.max()) * b

        def forward(nodes: Nodes) -> None:
            rows = np.empty(size)
            loops.forward(nodes, right, structure, self.blocks, x, carried, rows)

        def backward(nodes: Nodes) -> None:
            rows, boundary_x = np.empty((2, size))
            loops.backward(nodes, structure, self.blocks, x, rows, boundary_x, solution.numpy())

        team.each(forward, tree.subtrees)
        for nodes in tree.above:
            forward(nodes)
        for nodes in reversed(tree.above):
            backward(nodes)
        team.each(backward, tree.subtrees)
        return solution.T


def analyse(
    matrix: sparse.csr_array, coordinates: np.ndarray | None = None, *, leaf_size: int = LEAF_SIZE
) -> Tree:
    """Compute elimination order and fronts for all matrices with one symmetric sparsity pattern.

    Args:
        matrix: (V, V) with a symmetric pattern that contains the whole diagonal; only the pattern is read.
        coordinates: (V, d) positions for cutting the graph, any unit; short edges make good cuts. Without them hop
            distances from a few vertices far apart are used, which lead to somewhat larger blocks.
        leaf_size: approximate number of vertices of a part that is not split further.

    Raises:
        ValueError: the pattern is not symmetric or lacks diagonal entries, or coordinates have the wrong shape.
    """
    matrix, coordinates = checked_graph(matrix, coordinates)
    node, n_levels = nested_dissection(matrix, coordinates, leaf_size)
    return Tree(*tree_structure(node, n_levels, *pattern(matrix)))


def _matrix(array: Floats, start: int, shape: tuple[int, int]) -> torch.Tensor:
    """Return a view of the matrix that starts at an index of a flat array."""
    n_rows, n_columns = shape
    entries = array[start : start + n_rows * n_columns]
    return torch.from_numpy(entries.reshape(shape))


def _eliminate_node(
    front: torch.Tensor, block: torch.Tensor, update: torch.Tensor, team: Team
) -> int:
    """Write D, E and the complement, from a front: both upper triangles. Return the number of negative pivots."""
    n_own = len(block)
    n_boundary = len(update)
    upper = front[:n_own, :n_own].triu()
    coupling = front[:n_own, n_own:]
    inverse, n_negative = _invert(upper + upper.triu(1).T)
    block[:, :n_own] = inverse
    elimination = block[:, n_own:]
    trailing = front[n_own:, n_own:]
    begins = range(0, n_boundary, PIECE_SIZE)
    pieces = [slice(begin, begin + PIECE_SIZE) for begin in begins]

    def eliminate(piece: slice) -> None:
        elimination[:, piece] = -(inverse @ coupling[:, piece])

    def complement(piece: slice) -> None:
        columns = slice(piece.start, None)
        torch.addmm(
            trailing[piece, columns],
            coupling[:, piece].T,
            elimination[:, columns],
            out=update[piece, columns],
        )

    team.each(eliminate, pieces)
    team.each(complement, pieces)
    return n_negative


def _invert(pivot: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Return the inverse of a symmetric block (S, S), and its number of negative eigenvalues."""
    factor, failed = torch.linalg.cholesky_ex(pivot)
    if not failed:
        return torch.cholesky_inverse(factor), 0
    factor, order, failed = torch.linalg.ldl_factor_ex(pivot)
    if failed:
        raise SingularMatrixError(
            "shift: expected regular pivot blocks, got a singular one. Change it slightly."
        )
    inverse = torch.linalg.ldl_solve(factor, order, identity(len(pivot)))
    # Bunch–Kaufman: a 1×1 pivot counts by its sign; a 2×2 pivot, of negative indices, has an eigenvalue of each sign.
    is_negative = (order > 0) & (factor.diagonal() < 0)
    n_pairs = int((order < 0).sum()) // 2
    return (inverse + inverse.T) / 2, int(is_negative.sum()) + n_pairs

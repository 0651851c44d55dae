"""The factorization of `factorization` by compiled loops: node by node, depth first, without padding.

A node's Schur complement is added to its parent's front soon after it was made, while the processor's cache still holds
it, and only the complements along one branch are kept. Pivot blocks of more than LARGE unknowns go to PyTorch, and so
do those that are indefinite and ask for pivots in another order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse

from igps._threads import ALONE, Team
from igps.spectra._checks import canonical, check_entries
from igps.spectra._factorization import invert
from igps.spectra._ordering import LEAF_SIZE, checked_graph, nested_dissection

# Unknowns from which a subtree is worth a thread of its own, and the most subtrees, as a power of two
SUBTREE, MOST_SUBTREES = 2**13, 3
# Own unknowns of a node above which its dense algebra is PyTorch's, for which a team can work
LARGE = 127
# Rows or columns of such a node that are multiplied at once
AT_ONCE = 256


@dataclass(frozen=True)
class Tree:
    """Elimination order and fronts for one sparsity pattern. Nodes and unknowns are numbered depth first.

    Attributes:
        indptr, indices: (V + 1,), (E,) int32, of the csr matrix.
        order, number: (V,) the vertex of each number, the number of each vertex.
        first: (N + 1,) where each node's own numbers start.
        children: (N, 2) nodes, or -1.
        start, boundary: (N + 1,) where each node's boundary starts among all boundaries, sorted numbers each.
        parent_row: the row of each vertex of a boundary in the front of the node's parent.
        block_start: (N + 1,) where each node's block [D E] starts among all blocks.
        update_start: (N,) where its complement starts among those that wait to be added.
        n_updates: entries of all complements that wait at the same time, at most.
        subtrees: ranges of nodes that may be eliminated, and solved, side by side.
        above: the other nodes, as ranges, each behind its children.
        carried_start: (N,) where the rows that a node adds to its boundary start among those that wait to be added.
        n_carried: rows that wait at the same time, at most.
    """

    indptr: np.ndarray
    indices: np.ndarray
    order: np.ndarray
    number: np.ndarray
    first: np.ndarray
    children: np.ndarray
    start: np.ndarray
    boundary: np.ndarray
    parent_row: np.ndarray
    block_start: np.ndarray
    update_start: np.ndarray
    n_updates: int
    subtrees: list[tuple[int, int]]
    above: list[tuple[int, int]]
    carried_start: np.ndarray
    n_carried: int

    def factorize(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> Factors:
        """Factorize ``matrix − shift · I``; arguments and errors are those of `factorization.factorize`."""
        blocks = np.empty(self.block_start[-1])
        return Factors(self, blocks, self._eliminate(matrix, shift, team, blocks))

    def inertia(self, matrix: sparse.csr_array, shift: float = 0.0, team: Team = ALONE) -> int:
        """The number of negative eigenvalues of ``matrix − shift · I``."""
        return self._eliminate(matrix, shift, team, None)

    def arranged(self, matrix: sparse.csr_array) -> tuple[Tree, sparse.csr_array, np.ndarray]:
        """The structure for unknowns in the order of elimination, such a matrix, and which each was before (V,)."""
        from igps.spectra import _loops as loops

        matrix = canonical(matrix)
        check_entries(matrix, self.indptr, self.indices)
        indptr, indices, data = loops.arranged(self.indptr, self.indices, matrix.data, self.order, self.number)
        same = np.arange(len(self.order))
        structure = replace(self, indptr=indptr, indices=indices, order=same, number=same)
        return structure, sparse.csr_array((data, indices, indptr), shape=matrix.shape), self.order

    def _eliminate(self, matrix: sparse.csr_array, shift: float, team: Team, blocks: np.ndarray | None) -> int:
        """Write the blocks, if they are to be kept; the number of negative eigenvalues."""
        matrix = canonical(matrix)
        check_entries(matrix, self.indptr, self.indices)
        values, updates = matrix.data.astype(np.float64, copy=False), np.empty(self.n_updates)

        def eliminate(nodes: tuple[int, int]) -> int:
            return self._eliminate_range(nodes, values, float(shift), updates, blocks, team)

        return sum(team.each(eliminate, self.subtrees)) + sum(map(eliminate, self.above))

    def _eliminate_range(
        self,
        nodes: tuple[int, int],
        values: np.ndarray,
        shift: float,
        updates: np.ndarray,
        blocks: np.ndarray | None,
        team: Team,
    ) -> int:
        """Write the blocks of a range of nodes, and what they leave to nodes behind it; their negative pivots."""
        from igps.spectra import _loops as loops

        begin, end = nodes
        n_own, n_boundary = np.diff(self.first[begin : end + 1]), np.diff(self.start[begin : end + 1])
        front = np.empty(int((n_own + n_boundary).max()) ** 2)
        block_start = self.block_start
        if blocks is None:
            blocks, block_start = np.empty(int((n_own * (n_own + n_boundary)).max())), np.zeros_like(block_start)
        place = np.empty(len(self.order), dtype=np.int64)
        problem = (
            values, shift, self.indptr, self.indices, self.order, self.number, self.first, self.children, self.start,
            self.boundary, self.parent_row, updates, self.update_start, place, front,
        )  # fmt: skip
        padded = min(LARGE, int(n_own.max())) + loops.AT_ONCE
        squares = [np.empty(padded**2) for _ in range(3)]
        strips = [np.empty(loops.AT_ONCE * (padded + loops.AT_ONCE)) for _ in range(2)]
        n_negative, node = 0, begin
        while True:
            n_more, node = loops.eliminate((node, end), LARGE, *problem, blocks, block_start, *squares, *strips)
            n_negative += n_more
            if node == end:
                return n_negative
            size, n_bound = int(n_own[node - begin]), int(n_boundary[node - begin])
            n_negative += _eliminate_alone(
                torch.from_numpy(front[: (size + n_bound) ** 2].reshape(size + n_bound, size + n_bound)),
                torch.from_numpy(blocks[block_start[node] :][: size * (size + n_bound)].reshape(size, -1)),
                torch.from_numpy(updates[self.update_start[node] :][: n_bound**2].reshape(n_bound, n_bound)),
                team,
            )
            node += 1


@dataclass(frozen=True)
class Factors:
    """The factors of one matrix: solves with it, and its number of negative eigenvalues.

    Attributes:
        tree: the structure they were made with.
        blocks: each node's (S, S + B) block [D E], end to end.
        n_negative: number of negative eigenvalues of the matrix.
    """

    tree: Tree
    blocks: np.ndarray
    n_negative: int

    def solve(self, right_hand_sides: torch.Tensor, team: Team = ALONE) -> torch.Tensor:
        """The solutions (V, b) for right-hand sides (V, b), float64, stored by columns."""
        from igps.spectra import _loops as loops

        tree = self.tree
        n_vertices, b = right_hand_sides.shape
        right, solution = right_hand_sides.numpy(), torch.empty(b, n_vertices, dtype=torch.float64)
        x, carried = (torch.empty(n * b, dtype=torch.float64).numpy() for n in (n_vertices, tree.n_carried))
        largest = int((np.diff(tree.first) + np.diff(tree.start)).max())

        def forward(nodes: tuple[int, int]) -> None:
            loops.forward(
                nodes, right, tree.order, tree.first, tree.children, tree.start, tree.parent_row, self.blocks,
                tree.block_start, x, carried, tree.carried_start, largest,
            )  # fmt: skip

        def backward(nodes: tuple[int, int]) -> None:
            loops.backward(
                nodes, tree.order, tree.first, tree.start, tree.boundary, self.blocks, tree.block_start, x, largest,
                solution.numpy(),
            )  # fmt: skip

        team.each(forward, tree.subtrees)
        for nodes in tree.above:
            forward(nodes)
        for nodes in reversed(tree.above):
            backward(nodes)
        team.each(backward, tree.subtrees)
        return solution.T


def analyse(matrix: sparse.csr_array, coordinates: np.ndarray | None = None, *, leaf_size: int = LEAF_SIZE) -> Tree:
    """Elimination order and fronts; arguments and errors are those of `symbolic.dissect`."""
    from igps.spectra import _loops as loops

    matrix, coordinates = checked_graph(matrix, coordinates)
    node, n_levels = nested_dissection(matrix, coordinates, leaf_size)
    indptr, indices = (array.astype(np.int32, copy=False) for array in (matrix.indptr, matrix.indices))
    order, number, first, children, start, boundary, parent_row = loops.tree(node, 2**n_levels - 1, indptr, indices)
    n_own, n_boundary = np.diff(first), np.diff(start)
    subtrees = _subtrees(n_levels, len(order))
    inside = {node for begin, end in subtrees for node in range(begin, end)}
    above = [(node, node + 1) for node in range(len(n_own)) if node not in inside]
    update_start, n_updates = _stacks(children, n_boundary**2, [*subtrees, *above])
    carried_start, n_carried = _stacks(children, n_boundary, [*subtrees, *above])
    return Tree(
        indptr=indptr,
        indices=indices,
        order=order,
        number=number,
        first=first,
        children=children,
        start=start,
        boundary=boundary,
        parent_row=parent_row,
        block_start=np.append(0, np.cumsum(n_own * (n_own + n_boundary))),
        update_start=update_start,
        n_updates=n_updates,
        subtrees=subtrees,
        above=above,
        carried_start=carried_start,
        n_carried=n_carried,
    )


def _subtrees(n_levels: int, n_unknowns: int) -> list[tuple[int, int]]:
    """The ranges of nodes of a few large subtrees, in the order in which a full tree is numbered depth first.

    They depend on the matrix alone, not on the threads that there are: neither do rounding errors.
    """
    depth = min(MOST_SUBTREES, n_levels - 1, max(0, int(n_unknowns / SUBTREE).bit_length()))
    subtrees, begin = [], 0
    for number in range(1, 2**depth + 1):
        subtrees.append((begin, begin + 2 ** (n_levels - depth) - 1))
        begin = subtrees[-1][1] + (number & -number).bit_length() - 1  # behind it come the nodes that it completes
    return subtrees


def _stacks(children: np.ndarray, sizes: np.ndarray, ranges: list[tuple[int, int]]) -> tuple[np.ndarray, int]:
    """Where the result of each node starts, of these sizes, and the size of all; each range of nodes has its own place.

    In a range, a node's result waits until its parent takes it: when a node is done, its children's results are the
    last two that wait, and its own takes their place.
    """
    place, length, left = np.zeros(len(sizes), dtype=np.int64), sizes.tolist(), children[:, 0].tolist()
    end = 0
    for first, last in ranges:
        top = end
        for n in range(first, last):
            place[n] = top if left[n] < first else place[left[n]]
            top = int(place[n]) + length[n]
            end = max(end, top)
    return place, end


def _eliminate_alone(front: torch.Tensor, block: torch.Tensor, update: torch.Tensor, team: Team) -> int:
    """Write D, E and the complement of a front; of both only the upper triangle counts. Its negative pivots."""
    n_own, n_bound = len(block), len(update)
    pivot, coupling = front[:n_own, :n_own].triu(), front[:n_own, n_own:]
    inverse, n_negative = invert((pivot + pivot.triu(1).T)[None])
    block[:, :n_own] = inverse[0]
    elimination, below = block[:, n_own:], front[n_own:, n_own:]
    pieces = [slice(begin, begin + AT_ONCE) for begin in range(0, n_bound, AT_ONCE)]

    def eliminate(piece: slice) -> None:
        elimination[:, piece] = -(inverse[0] @ coupling[:, piece])

    def complement(piece: slice) -> None:
        behind = slice(piece.start, None)
        torch.addmm(below[piece, behind], coupling[:, piece].T, elimination[:, behind], out=update[piece, behind])

    team.each(eliminate, pieces)
    team.each(complement, pieces)
    return n_negative

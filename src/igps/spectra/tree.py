"""The elimination tree of a dissected matrix: own unknowns, boundary and children of each node.

Nodes and unknowns are numbered depth first, each node after its children, which is the order of elimination.
"""

from typing import NamedTuple

import numpy as np

from igps._arrays import Integers

# Smallest number of unknowns that are worth a thread of their own, and log₂ of the largest number of subtrees.
MIN_SUBTREE = 2**13
MAX_SUBTREE_DEPTH = 3

Nodes = tuple[int, int]
"""A range of nodes: the first, and the one after the last."""


# Rows of `Structure.nodes`. Compiled functions take longer to compile the more arrays they are given.
OWN, BOUNDARY, LEFT, RIGHT, BLOCK, UPDATE, CARRIED = range(7)


class Structure(NamedTuple):
    """The symbolic factorization of a matrix: its pattern, and the N nodes of its elimination tree.

    The rows of `nodes` are, for each node: the first position that it owns, the start of its boundary in `boundary`,
    its two children or -1, the start of its block [D E] in the array of blocks, that of its Schur complement on the
    stack of complements, and that of its contribution to the right-hand sides on their stack. Starts have an end, too.
    """

    indptr: np.ndarray  # (V + 1,) int32, of the csr matrix
    indices: np.ndarray  # (E,) int32
    order: np.ndarray  # (V,) vertex at each position of the elimination order
    position: np.ndarray  # (V,) position of each vertex in the elimination order
    nodes: Integers  # (7, N + 1)
    boundary: np.ndarray  # positions, ascending for each node
    parent_row: np.ndarray  # row of each boundary entry in the front of the node's parent

    @property
    def n_own(self) -> Integers:
        """(N,) number of unknowns that each node owns."""
        return np.diff(self.nodes[OWN])

    @property
    def n_boundary(self) -> Integers:
        """(N,) size of the boundary of each node."""
        return np.diff(self.nodes[BOUNDARY])


def tree_structure(
    node: np.ndarray, n_levels: int, indptr: np.ndarray, indices: np.ndarray
) -> tuple[Structure, list[Nodes], list[Nodes]]:
    """Return the structure of a full binary tree, its `parallel_subtrees`, and the nodes above these, each a range.

    The tree is given by the node (V,) of each vertex, numbered as in a heap.
    """
    n_nodes = 2**n_levels - 1
    node_at = np.full(n_nodes, n_nodes - 1)  # node at each place of the heap
    children = np.full((n_nodes, 2), -1)
    parent = np.full(n_nodes, -1)
    for level in range(n_levels - 1):
        parents = np.arange(2**level - 1, 2 ** (level + 1) - 1)
        right = node_at[parents] - 1
        left = right - (2 ** (n_levels - level - 1) - 1)  # the whole right subtree lies between
        node_at[2 * parents + 1] = left
        node_at[2 * parents + 2] = right
        children[node_at[parents]] = np.stack([left, right], axis=1)
        parent[left] = parent[right] = node_at[parents]
    node_of = node_at[node]
    order = np.argsort(node_of, kind="stable")
    position = np.empty_like(order)
    position[order] = np.arange(len(node))
    own_start = np.append(0, np.cumsum(np.bincount(node_of, minlength=n_nodes)))
    depth = np.empty(n_nodes, np.int64)
    depth[node_at] = np.log2(np.arange(1, n_nodes + 1))
    boundary_start, boundary, rows = _boundaries(
        own_start, parent, depth, position, indptr, indices
    )
    n_own = np.diff(own_start)
    n_boundary = np.diff(boundary_start)
    subtrees = parallel_subtrees(n_levels, len(node))
    in_subtrees = {n for begin, end in subtrees for n in range(begin, end)}
    above = [(n, n + 1) for n in range(n_nodes) if n not in in_subtrees]
    nodes = np.zeros((7, n_nodes + 1), np.int64)
    nodes[OWN] = own_start
    nodes[BOUNDARY] = boundary_start
    nodes[[LEFT, RIGHT], :-1] = children.T
    nodes[BLOCK, 1:] = np.cumsum(n_own * (n_own + n_boundary))
    nodes[UPDATE, :-1] = stack_starts(children, n_boundary**2, [*subtrees, *above])
    nodes[CARRIED, :-1] = stack_starts(children, n_boundary, [*subtrees, *above])
    structure = Structure(indptr, indices, order, position, nodes, boundary, rows)
    return structure, subtrees, above


def _boundaries(
    own_start: Integers,
    parent: Integers,
    depth: Integers,
    position: Integers,
    indptr: np.ndarray,
    indices: np.ndarray,
) -> tuple[Integers, Integers, Integers]:
    """Return the start of each node's boundary, the boundaries, and the row of each entry in the parent's front.

    The boundary of a node consists of the unknowns that its edges reach and of its children's boundaries, without the
    unknowns that it owns.
    """
    n_nodes = len(parent)
    n_vertices = len(position)

    def after(node: Integers, reached: Integers) -> Integers:
        """Return the pairs whose unknown comes after those of the node, as numbers that sort by node."""
        is_after = reached >= own_start[node + 1]
        return node[is_after] * n_vertices + reached[is_after]

    owner = np.repeat(np.arange(n_nodes), np.diff(own_start))
    from_edges = after(owner[position].repeat(np.diff(indptr)), position[indices])
    level_of_edge = depth[from_edges // n_vertices]
    inherited = from_edges[:0]
    levels = []
    for level in reversed(range(depth.max() + 1)):
        levels.append(np.union1d(inherited, from_edges[level_of_edge == level]))
        node, reached = np.divmod(levels[-1], n_vertices)
        inherited = after(parent[node], reached)
    pairs = np.sort(np.concatenate(levels))
    node, boundary = np.divmod(pairs, n_vertices)
    start = np.append(0, np.cumsum(np.bincount(node, minlength=n_nodes)))
    parents = parent[node]
    on_boundary = (
        np.diff(own_start)[parents]
        + np.searchsorted(pairs, parents * n_vertices + boundary)
        - start[parents]
    )
    return (
        start,
        boundary,
        np.where(boundary < own_start[parents + 1], boundary - own_start[parents], on_boundary),
    )


def parallel_subtrees(n_levels: int, n_unknowns: int) -> list[Nodes]:
    """Return the ranges of nodes of a few large subtrees of a full tree that is numbered depth first.

    They depend only on the matrix and not on the number of threads, and so do rounding errors.
    """
    depth = min(MAX_SUBTREE_DEPTH, n_levels - 1, max(0, int(n_unknowns / MIN_SUBTREE).bit_length()))
    subtrees = []
    begin = 0
    for number in range(1, 2**depth + 1):
        subtrees.append((begin, begin + 2 ** (n_levels - depth) - 1))
        # Skips the parents that it completes
        begin = subtrees[-1][1] + (number & -number).bit_length() - 1
    return subtrees


def stack_starts(children: np.ndarray, sizes: np.ndarray, ranges: list[Nodes]) -> np.ndarray:
    """Return the start of each node's result on a stack, from the sizes of the results.

    Each range of nodes has its own stack. A result stays there until its parent is computed: the results of both
    children are then on top, and the parent's result replaces them.
    """
    starts = np.zeros(len(sizes), dtype=np.int64)
    lengths = sizes.tolist()
    left_child = children[:, 0].tolist()
    end = 0
    for first, last in ranges:
        top = end
        for n in range(first, last):
            starts[n] = top if left_child[n] < first else starts[left_child[n]]
            top = int(starts[n]) + lengths[n]
            end = max(end, top)
    return starts

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
    node_at, children = _full_tree(n_levels)
    n_nodes = len(node_at)
    node_of = node_at[node]
    order = np.argsort(node_of, kind="stable")
    position = np.argsort(order)
    parent = np.full(n_nodes, -1)
    for side in children.T:
        has_child = side >= 0
        parent[side[has_child]] = np.flatnonzero(has_child)
    depth = np.empty(n_nodes, np.int64)
    places = np.arange(n_nodes)
    depth[node_at] = np.log2(places + 1)
    own_start = _starts(node_of, n_nodes)
    pairs = _boundaries(own_start, parent, depth, position, indptr, indices)
    owner, boundary = np.divmod(pairs, len(node))
    boundary_start = _starts(owner, n_nodes)
    n_own = np.diff(own_start)
    n_boundary = np.diff(boundary_start)

    # A boundary entry is among the own unknowns of the parent, or behind these on the parent's boundary.
    parents = parent[owner]
    place = np.searchsorted(pairs, parents * len(node) + boundary)
    on_boundary = n_own[parents] + place - boundary_start[parents]
    is_owned = boundary < own_start[parents + 1]
    parent_row = np.where(is_owned, boundary - own_start[parents], on_boundary)

    subtrees = parallel_subtrees(n_levels, len(node))
    is_above = np.ones(n_nodes, dtype=bool)
    for begin, end in subtrees:
        is_above[begin:end] = False
    others = np.flatnonzero(is_above).tolist()
    above = [(n, n + 1) for n in others]
    nodes = np.zeros((7, n_nodes + 1), np.int64)
    nodes[OWN] = own_start
    nodes[BOUNDARY] = boundary_start
    nodes[[LEFT, RIGHT], :-1] = children.T
    nodes[BLOCK, 1:] = np.cumsum(n_own * (n_own + n_boundary))
    ranges = [*subtrees, *above]
    nodes[UPDATE, :-1] = stack_starts(children, n_boundary**2, ranges)
    nodes[CARRIED, :-1] = stack_starts(children, n_boundary, ranges)
    structure = Structure(indptr, indices, order, position, nodes, boundary, parent_row)
    return structure, subtrees, above


def _full_tree(n_levels: int) -> tuple[Integers, Integers]:
    """Return the node at each place of a heap (N,), and the children (N, 2) of each node, -1 for those of leaves."""
    n_nodes = 2**n_levels - 1
    node_at = np.full(n_nodes, n_nodes - 1)
    children = np.full((n_nodes, 2), -1)
    for level in range(n_levels - 1):
        n_places = 2**level
        places = n_places - 1 + np.arange(n_places)
        parents = node_at[places]
        right = parents - 1
        left = right - (2 ** (n_levels - level - 1) - 1)  # the whole right subtree lies between
        node_at[2 * places + 1] = left
        node_at[2 * places + 2] = right
        children[parents] = np.column_stack([left, right])
    return node_at, children


def _starts(owner: Integers, n_nodes: int) -> Integers:
    """Return where the items of each node start, and where the last end: (N + 1,), from the node of each item."""
    counts = np.bincount(owner, minlength=n_nodes)
    return np.append(0, np.cumsum(counts))


def _boundaries(
    own_start: Integers,
    parent: Integers,
    depth: Integers,
    position: Integers,
    indptr: np.ndarray,
    indices: np.ndarray,
) -> Integers:
    """Return the pairs of a node and an unknown on its boundary, sorted, as numbers: node · V + unknown.

    The boundary of a node consists of the unknowns that its edges reach and of its children's boundaries, without the
    unknowns that it owns.
    """
    n_vertices = len(position)

    def after(node: Integers, reached: Integers) -> Integers:
        """Return the pairs whose unknown comes after those of the node."""
        is_after = reached >= own_start[node + 1]
        return node[is_after] * n_vertices + reached[is_after]

    n_own = np.diff(own_start)
    n_edges = np.diff(indptr)
    owner = np.repeat(np.arange(len(n_own)), n_own)
    node_of_edge = np.repeat(owner[position], n_edges)
    from_edges = after(node_of_edge, position[indices])
    depth_of_edge = depth[from_edges // n_vertices]
    inherited = from_edges[:0]
    levels = []
    for level in reversed(range(depth.max() + 1)):
        pairs = np.union1d(inherited, from_edges[depth_of_edge == level])
        levels.append(pairs)
        node, reached = np.divmod(pairs, n_vertices)
        inherited = after(parent[node], reached)
    return np.sort(np.concatenate(levels))


def parallel_subtrees(n_levels: int, n_unknowns: int) -> list[Nodes]:
    """Return the ranges of nodes of a few large subtrees of a full tree that is numbered depth first.

    They depend only on the matrix and not on the number of threads, and so do rounding errors.
    """
    n_worthwhile = n_unknowns // MIN_SUBTREE
    depth = min(MAX_SUBTREE_DEPTH, n_levels - 1, n_worthwhile.bit_length())
    size = 2 ** (n_levels - depth) - 1
    subtrees = []
    begin = 0
    for number in range(1, 2**depth + 1):
        subtrees.append((begin, begin + size))
        # Skips the parents that it completes
        n_completed = (number & -number).bit_length() - 1
        begin += size + n_completed
    return subtrees


def stack_starts(children: np.ndarray, sizes: np.ndarray, ranges: list[Nodes]) -> np.ndarray:
    """Return the start of each node's result on a stack, from the sizes of the results.

    Each range of nodes has its own stack. A result stays there until its parent is computed: the results of both
    children are then on top, and the parent's result replaces them.
    """
    lengths = sizes.tolist()
    left_child = children[:, 0].tolist()
    starts = [0] * len(lengths)
    end = 0
    for first, last in ranges:
        top = end
        for n in range(first, last):
            left = left_child[n]
            starts[n] = top if left < first else starts[left]
            top = starts[n] + lengths[n]
            end = max(end, top)
    return np.array(starts, dtype=np.int64)

"""The elimination tree of a dissected matrix: which unknowns each node owns, which it touches, and where fronts meet.

Nodes and unknowns are numbered depth first, each node behind its children: in the order of their elimination.
"""

from typing import NamedTuple

import numpy as np

from igps._arrays import Integers

# Unknowns from which a subtree is worth a thread of its own, and the most subtrees, as a power of two
SUBTREE, MOST_SUBTREES = 2**13, 3

Nodes = tuple[int, int]
"""A range of nodes: the first, and the one behind the last."""


class Structure(NamedTuple):
    """What is known of a matrix before its values: its pattern, and the nodes of the tree, N in number."""

    indptr: np.ndarray  # (V + 1,) int32, of the csr matrix
    indices: np.ndarray  # (E,) int32
    order: np.ndarray  # (V,) the vertex of each number
    number: np.ndarray  # (V,) the number of each vertex
    first: np.ndarray  # (N + 1,) where each node's own numbers start
    children: np.ndarray  # (N, 2) nodes, or -1
    start: np.ndarray  # (N + 1,) where each node's boundary starts among all boundaries
    boundary: np.ndarray  # sorted numbers each
    parent_row: np.ndarray  # the row of each vertex of a boundary in the front of the node's parent
    block_start: np.ndarray  # (N + 1,) where each node's block [D E] starts among all blocks
    update_start: np.ndarray  # (N,) where its complement starts among those that wait to be added
    carried_start: np.ndarray  # (N,) where the rows that it adds to its boundary start among those that wait


def tree_structure(
    node: np.ndarray, n_levels: int, indptr: np.ndarray, indices: np.ndarray
) -> tuple[Structure, list[Nodes], list[Nodes]]:
    """Of a full binary tree for vertices (V,) assigned to the places of a heap, with its `side_by_side` subtrees.

    The third result are the nodes above these, as ranges, each behind its children.
    """
    n_nodes = 2**n_levels - 1
    post = np.full(n_nodes, n_nodes - 1)  # the number of each place in the heap
    children, parent = np.full((n_nodes, 2), -1), np.full(n_nodes, -1)
    for level in range(n_levels - 1):
        above = np.arange(2**level - 1, 2 ** (level + 1) - 1)
        right = post[above] - 1
        left = right - (2 ** (n_levels - level - 1) - 1)  # before it comes all of the right one's subtree
        post[2 * above + 1], post[2 * above + 2] = left, right
        children[post[above]] = np.stack([left, right], axis=1)
        parent[left] = parent[right] = post[above]
    of_vertex = post[node]
    order = np.argsort(of_vertex, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(node))
    first = np.append(0, np.cumsum(np.bincount(of_vertex, minlength=n_nodes)))
    level_of = np.empty(n_nodes, np.int64)
    level_of[post] = np.log2(np.arange(1, n_nodes + 1))
    start, boundary, rows = _boundaries(first, parent, level_of, number, indptr, indices)
    n_own, n_boundary = np.diff(first), np.diff(start)
    subtrees = side_by_side(n_levels, len(node))
    inside = {n for begin, end in subtrees for n in range(begin, end)}
    alone = [(n, n + 1) for n in range(n_nodes) if n not in inside]
    blocks = np.append(0, np.cumsum(n_own * (n_own + n_boundary)))
    updates, carried = (stacked_places(children, sizes, [*subtrees, *alone]) for sizes in (n_boundary**2, n_boundary))
    structure = Structure(
        indptr, indices, order, number, first, children, start, boundary, rows, blocks, updates, carried
    )
    return structure, subtrees, alone


def _boundaries(
    first: Integers, parent: Integers, level_of: Integers, number: Integers, indptr: np.ndarray, indices: np.ndarray
) -> tuple[Integers, Integers, Integers]:
    """Where each node's boundary starts, the boundaries, sorted, and the row of each entry in the parent's front.

    A node's boundary is what its own edges reach, and its children's boundaries, less what it owns.
    """
    n_nodes, n_vertices = len(parent), len(number)

    def behind(node: Integers, reached: Integers) -> Integers:
        """Of pairs of a node and an unknown those where that lies behind the node, as numbers that sort by node."""
        kept = reached >= first[node + 1]
        return node[kept] * n_vertices + reached[kept]

    owner = np.repeat(np.arange(n_nodes), np.diff(first))
    by_edges = behind(owner[number].repeat(np.diff(indptr)), number[indices])
    level_of_edge = level_of[by_edges // n_vertices]
    inherited, found = by_edges[:0], []
    for level in reversed(range(level_of.max() + 1)):
        found.append(np.union1d(inherited, by_edges[level_of_edge == level]))
        node, reached = np.divmod(found[-1], n_vertices)
        inherited = behind(parent[node], reached)
    every = np.sort(np.concatenate(found))
    node, boundary = np.divmod(every, n_vertices)
    start = np.append(0, np.cumsum(np.bincount(node, minlength=n_nodes)))
    above = parent[node]
    on_boundary = np.diff(first)[above] + np.searchsorted(every, above * n_vertices + boundary) - start[above]
    return start, boundary, np.where(boundary < first[above + 1], boundary - first[above], on_boundary)


def side_by_side(n_levels: int, n_unknowns: int) -> list[Nodes]:
    """The ranges of nodes of a few large subtrees, in the order in which a full tree is numbered depth first.

    They depend on the matrix alone, not on the threads that there are: neither do rounding errors.
    """
    depth = min(MOST_SUBTREES, n_levels - 1, max(0, int(n_unknowns / SUBTREE).bit_length()))
    subtrees, begin = [], 0
    for number in range(1, 2**depth + 1):
        subtrees.append((begin, begin + 2 ** (n_levels - depth) - 1))
        begin = subtrees[-1][1] + (number & -number).bit_length() - 1  # behind it come the nodes that it completes
    return subtrees


def stacked_places(children: np.ndarray, sizes: np.ndarray, ranges: list[Nodes]) -> np.ndarray:
    """Where the result of each node starts, of these sizes; each range of nodes has its own place.

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
    return place

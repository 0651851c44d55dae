"""The elimination tree of a dissected matrix: which unknowns each node owns, which it touches, and where fronts meet.

Nodes and unknowns are numbered depth first, each node behind its children: in the order of their elimination.
"""

from typing import NamedTuple

import numpy as np

from igps._arrays import Integers
from igps._compiled import compiled

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
    start, boundary = _boundaries(first, children, order, number, indptr, indices)
    owner = np.repeat(np.arange(n_nodes), np.diff(start))
    boundary = np.sort(owner * len(node) + boundary) - owner * len(node)
    rows = _parent_rows(first, parent, start, boundary)
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


@compiled()
def _boundaries(
    first: Integers, children: Integers, order: Integers, number: Integers, indptr: Integers, indices: Integers
) -> tuple[np.ndarray, np.ndarray]:
    """Where each node's boundary starts, and the boundaries, not sorted.

    A node's boundary is what its own edges reach, and its children's boundaries, less what it owns.
    """
    n_nodes = len(children)
    seen = np.full(len(order), -1, np.int64)
    start = np.zeros(n_nodes + 1, np.int64)
    boundary = np.empty(4 * len(order), np.int64)
    for n in range(n_nodes):
        stop, end = first[n + 1], start[n]
        need = end
        for side in range(2):
            child = children[n, side]
            if child >= 0:
                need += start[child + 1] - start[child]
        for i in range(first[n], stop):
            need += indptr[order[i] + 1] - indptr[order[i]]
        if need > len(boundary):
            larger = np.empty(2 * need, np.int64)
            for k in range(end):  # a slice set to a slice takes Numba two seconds to compile
                larger[k] = boundary[k]
            boundary = larger
        for side in range(2):
            child = children[n, side]
            if child >= 0:
                for k in range(start[child], start[child + 1]):
                    j = boundary[k]
                    if j >= stop and seen[j] != n:
                        seen[j] = n
                        boundary[end] = j
                        end += 1
        for i in range(first[n], stop):
            for k in range(indptr[order[i]], indptr[order[i] + 1]):
                j = number[indices[k]]
                if j >= stop and seen[j] != n:
                    seen[j] = n
                    boundary[end] = j
                    end += 1
        start[n + 1] = end
    return start, boundary[: start[n_nodes]]


@compiled()
def _parent_rows(first: np.ndarray, parent: np.ndarray, start: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """The row of each vertex of a boundary in the front of the node's parent, whose boundary is sorted as well."""
    rows = np.empty(len(boundary), np.int64)
    for n in range(len(parent) - 1):
        p = parent[n]
        n_own, place = first[p + 1] - first[p], start[p]
        for k in range(start[n], start[n + 1]):
            if boundary[k] < first[p + 1]:
                rows[k] = boundary[k] - first[p]
                continue
            while boundary[place] < boundary[k]:
                place += 1
            rows[k] = n_own + place - start[p]
    return rows


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

"""The elimination order of the unknowns of a sparse symmetric matrix: nested dissection (George 1973).

This is the first step of a factorization, see `multifrontal`. Only the pattern of the matrix is read.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from igps._compiled import compiled
from igps.spectra._checks import canonical, pattern

# Approximate number of vertices of a part that is not split further. Smaller leaves lead to more and smaller products,
# larger leaves to more fill-in.
LEAF_SIZE = 48
# Largest distance of a cut from the middle, relative to the size of the part. Wider windows find smaller separators,
# but the unbalanced trees cost more than they save.
CUT_WINDOW = 0.05


def hop_coordinates(graph: sparse.csr_array, n_landmarks: int = 3) -> np.ndarray:
    """Return hop distances (V, n_landmarks) to vertices far apart, as coordinates for a graph that has none."""
    ones = np.ones(graph.nnz)
    unweighted = sparse.csr_array((ones, graph.indices, graph.indptr), shape=graph.shape)
    columns: list[np.ndarray] = []
    landmark = 0
    for _ in range(n_landmarks + 1):
        hops = dijkstra(unweighted, directed=False, indices=landmark, unweighted=True)
        hops = np.where(np.isfinite(hops), hops, -1.0)
        # The first landmark is arbitrary. It is dropped once it has led to one at the far end.
        columns = [*columns, hops][-n_landmarks:]
        nearest = np.min(columns, axis=0)
        landmark = int(nearest.argmax())
    return np.stack(columns, axis=1)


def checked_graph(
    matrix: sparse.csr_array, coordinates: np.ndarray | None
) -> tuple[sparse.csr_array, np.ndarray]:
    """Return the matrix with sorted entries, and coordinates of its vertices, with the errors of `analyse`."""
    matrix = canonical(matrix)
    n_vertices = matrix.shape[0]
    transpose = matrix.tocsc()
    is_symmetric = np.array_equal(transpose.indptr, matrix.indptr)
    is_symmetric &= np.array_equal(transpose.indices, matrix.indices)
    if not is_symmetric:
        raise ValueError(
            "matrix: expected entry (j, i) wherever (i, j) is stored, got an asymmetric pattern."
        )
    n_entries = np.diff(matrix.indptr)
    rows = np.repeat(np.arange(n_vertices), n_entries)
    if np.count_nonzero(rows == matrix.indices) != n_vertices:
        raise ValueError(
            "matrix: expected all diagonal entries to be stored, got fewer. Store zeros explicitly."
        )
    if coordinates is None:
        coordinates = hop_coordinates(matrix)
    if coordinates.ndim != 2 or len(coordinates) != n_vertices:
        raise ValueError(f"coordinates: expected shape ({n_vertices}, d), got {coordinates.shape}.")
    return matrix, coordinates


def nested_dissection(
    graph: sparse.csr_array, coordinates: np.ndarray, leaf_size: int
) -> tuple[np.ndarray, int]:
    """Return the tree node of each vertex, numbered as in a heap (children 2i+1 and 2i+2), and the number of levels.

    Each part is cut across one coordinate, at a position in a window around the median. Coordinate and position are
    those of the smallest separator. For a cut along the sorted vertices, the separator on its left side consists of the
    vertices before the cut with a neighbour behind it. Their number is a difference of two cumulative counts, so that
    one pass gives it for all positions.
    """
    n_vertices = graph.shape[0]
    depth = max(0, math.ceil(math.log2(n_vertices / leaf_size)))
    orders = [np.argsort(column, kind="stable") for column in coordinates.T]
    indptr, indices = pattern(graph)
    scratch = _Scratch(
        rank=np.full(n_vertices, -1, np.int32),
        low=np.empty(n_vertices, np.int32),
        high=np.empty(n_vertices, np.int32),
        n_lowest=np.empty(n_vertices + 1, np.int32),
        n_highest=np.empty(n_vertices + 1, np.int32),
        side=np.empty(n_vertices, np.int32),
        right=np.empty(n_vertices, np.int64),
        begin=np.zeros(2**depth, np.int64),
        end=np.full(2**depth, n_vertices, np.int64),
        node=np.empty(n_vertices, np.int64),
    )
    _dissect(np.stack(orders), indptr, indices, depth, CUT_WINDOW, scratch)
    return scratch.node, depth + 1


class _Scratch(NamedTuple):
    """Arrays that every part uses again.

    Args:
        rank: (V,) position of each vertex in the order of the part, or −1 outside the part.
        low: (V,) lowest rank among a vertex and its neighbours, by the vertex's rank.
        high: (V,) highest such rank.
        n_lowest: (V + 1,) number of vertices whose lowest rank is one less than the index.
        n_highest: (V + 1,) the same of the highest rank.
        side: (V,) of each vertex: 0 left, 1 right, 2 separator.
        right: (V,) vertices of the right side, in order.
        begin, end: (2^depth,) where the vertices of each part of a level are in the orders; at first, one part has all.
        node: (V,) the result.
    """

    rank: np.ndarray
    low: np.ndarray
    high: np.ndarray
    n_lowest: np.ndarray
    n_highest: np.ndarray
    side: np.ndarray
    right: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    node: np.ndarray


class _Cut(NamedTuple):
    """A cut before position `at` of an order, with a separator of `size` vertices on one of its sides."""

    at: int
    size: int
    is_left: bool


@compiled()
def _dissect(
    orders: np.ndarray,
    indptr: np.ndarray,
    indices: np.ndarray,
    depth: int,
    window: float,
    scratch: _Scratch,
) -> None:
    """Fill in the node of each vertex. The orders (d, V), vertices sorted by each coordinate, are overwritten."""
    n_coordinates, n_vertices = orders.shape
    begin = scratch.begin
    end = scratch.end
    node = scratch.node
    for level in range(depth):
        # The halves of a part take the places of itself and of a part behind it, which was divided before.
        for part in range((1 << level) - 1, -1, -1):
            first = begin[part]
            last = end[part]
            if last == first:
                begin[2 * part] = end[2 * part] = first
                begin[2 * part + 1] = end[2 * part + 1] = first
                continue
            min_size = n_vertices + 1
            for c in range(n_coordinates):
                order = orders[c, first:last]
                _rank_neighbours(order, indptr, indices, scratch)
                cut = _smallest_cut(scratch, len(order), n_vertices, window)
                if cut.size < min_size:
                    min_size = cut.size
                    _mark_sides(order, cut, scratch)
            for i in range(first, last):
                scratch.rank[orders[0, i]] = -1
                if scratch.side[orders[0, i]] == 2:
                    node[orders[0, i]] = (1 << level) - 1 + part
            n_left = 0
            n_right = 0
            for c in range(n_coordinates):
                n_left, n_right = _separate(orders[c, first:last], scratch)
            begin[2 * part] = first
            end[2 * part] = first + n_left
            begin[2 * part + 1] = first + n_left
            end[2 * part + 1] = first + n_left + n_right
    for part in range(1 << depth):
        for i in range(begin[part], end[part]):
            node[orders[0, i]] = (1 << depth) - 1 + part


@compiled(inline="always")
def _rank_neighbours(
    order: np.ndarray, indptr: np.ndarray, indices: np.ndarray, scratch: _Scratch
) -> None:
    """Fill the ranks of the vertices of a part, and the lowest and highest among their neighbours."""
    size = len(order)
    for i in range(size):
        scratch.rank[order[i]] = i
    for i in range(size + 1):
        scratch.n_highest[i] = 0
        scratch.n_lowest[i] = 0
    for i in range(size):
        lowest = highest = i
        for k in range(indptr[order[i]], indptr[order[i] + 1]):
            neighbour_rank = scratch.rank[indices[k]]
            if neighbour_rank > highest:
                highest = neighbour_rank
            elif 0 <= neighbour_rank < lowest:
                lowest = neighbour_rank
        scratch.low[i] = lowest
        scratch.high[i] = highest
        scratch.n_highest[highest + 1] += 1
        scratch.n_lowest[lowest + 1] += 1


@compiled(inline="always")
def _smallest_cut(scratch: _Scratch, size: int, n_vertices: int, window: float) -> _Cut:
    """Return the cut with the smallest separator in a window around the median of a part."""
    half_window = window * size if window * size > 1.0 else 1.0
    at = 0
    cut_size = n_vertices
    is_left = True
    # Vertices with all neighbours before the cut, and with at least one; a vertex is its own neighbour.
    n_closed = 0
    n_opened = 0
    for i in range(size):
        n_closed += scratch.n_highest[i]
        n_opened += scratch.n_lowest[i]
        if i == 0 or abs(i - size / 2) > half_window:
            continue
        left_size = i - n_closed
        right_size = n_opened - i
        smaller_size = left_size if left_size <= right_size else right_size
        if smaller_size < cut_size:
            at = i
            cut_size = smaller_size
            is_left = left_size <= right_size
    return _Cut(at, cut_size, is_left)


@compiled(inline="always")
def _mark_sides(order: np.ndarray, cut: _Cut, scratch: _Scratch) -> None:
    """Write the side of each vertex of a part."""
    for i in range(len(order)):
        if i < cut.at:
            scratch.side[order[i]] = 2 if cut.is_left and scratch.high[i] >= cut.at else 0
        else:
            scratch.side[order[i]] = 2 if not cut.is_left and scratch.low[i] < cut.at else 1


@compiled(inline="always")
def _separate(order: np.ndarray, scratch: _Scratch) -> tuple[int, int]:
    """Move the vertices of the left side to the front and those of the right side behind them; return their numbers."""
    n_left = 0
    n_right = 0
    for i in range(len(order)):
        vertex = order[i]
        if scratch.side[vertex] == 0:
            order[n_left] = vertex
            n_left += 1
        elif scratch.side[vertex] == 1:
            scratch.right[n_right] = vertex
            n_right += 1
    for i in range(n_right):
        order[n_left + i] = scratch.right[i]
    return n_left, n_right

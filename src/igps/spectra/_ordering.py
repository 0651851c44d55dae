"""The order in which the unknowns of a sparse symmetric matrix are eliminated: nested dissection (George 1973).

It is the first step of a factorization, see `_multifrontal`. Only the pattern of the matrix is read.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from igps._compiled import compiled
from igps.spectra._checks import canonical

# A part of about so many vertices is not split any more: fewer make more and smaller products, more make fuller fronts
LEAF_SIZE = 48
# Of the part's vertices, how far from the middle a cut may lie. Wider windows find smaller separators, but the lopsided
# trees that follow cost more than they save.
CUT_WINDOW = 0.05


def hop_coordinates(graph: sparse.csr_array, n_landmarks: int = 3) -> np.ndarray:
    """(V, n_landmarks) hop distances to far-apart vertices: coordinates for a graph that comes without."""
    pattern = sparse.csr_array((np.ones(graph.nnz), graph.indices, graph.indptr), shape=graph.shape)
    columns: list[np.ndarray] = []
    landmark = 0
    for _ in range(n_landmarks + 1):
        hops = dijkstra(pattern, directed=False, indices=landmark, unweighted=True)
        columns.append(np.where(np.isfinite(hops), hops, -1.0))
        # the first landmark is arbitrary: it only serves to find one at the far end
        columns = columns[-n_landmarks:]
        landmark = int(np.min(columns, axis=0).argmax())
    return np.stack(columns, axis=1)


def checked_graph(matrix: sparse.csr_array, coordinates: np.ndarray | None) -> tuple[sparse.csr_array, np.ndarray]:
    """The matrix with sorted entries, and coordinates for its vertices; arguments and errors are those of `analyse`."""
    matrix = canonical(matrix)
    n_vertices = matrix.shape[0]
    transpose = matrix.tocsc()
    if not (np.array_equal(transpose.indptr, matrix.indptr) and np.array_equal(transpose.indices, matrix.indices)):
        raise ValueError(f"matrix must store entry (j, i) where it stores (i, j), shape is {matrix.shape}")
    rows = np.repeat(np.arange(n_vertices), np.diff(matrix.indptr))
    if np.count_nonzero(rows == matrix.indices) != n_vertices:
        raise ValueError("matrix must store every diagonal entry: store zeros explicitly")
    if coordinates is None:
        coordinates = hop_coordinates(matrix)
    if coordinates.ndim != 2 or len(coordinates) != n_vertices:
        raise ValueError(f"coordinates must be ({n_vertices}, d) for this matrix, got {coordinates.shape}")
    return matrix, coordinates


def nested_dissection(graph: sparse.csr_array, coordinates: np.ndarray, leaf_size: int) -> tuple[np.ndarray, int]:
    """The tree node of each vertex, numbered as in a heap (root 0, children 2i+1 and 2i+2), and the number of levels.

    Each part is cut across the coordinate, and at the place within a window around the median, where the separator is
    smallest. As the cut moves along the sorted vertices, the separator on its left are the vertices before it with a
    neighbour behind it. Their number is a difference of two counts, known at all places after one pass.
    """
    n_vertices = graph.shape[0]
    depth = max(0, int(np.ceil(np.log2(n_vertices / leaf_size))))
    orders = [np.argsort(column, kind="stable") for column in coordinates.T]
    indptr, indices = (array.astype(np.int32, copy=False) for array in (graph.indptr, graph.indices))
    return _dissect(np.stack(orders), indptr, indices, depth, CUT_WINDOW), depth + 1


@compiled()
def _dissect(orders: np.ndarray, indptr: np.ndarray, indices: np.ndarray, depth: int, window: float) -> np.ndarray:
    """The node of each vertex, part by part. The orders (d, V), vertices sorted by each coordinate, are overwritten.

    Outside of the part at hand a vertex has rank −1: the largest as an unsigned number, so that neither the highest
    rank among neighbours nor the lowest asks where they are.
    """
    n_coordinates, n_vertices = orders.shape
    node = np.empty(n_vertices, np.int64)
    rank = np.full(n_vertices, -1, np.int32)
    low, high = np.empty(n_vertices, np.int32), np.empty(n_vertices, np.int32)
    whole_before, touched_before = np.empty(n_vertices + 1, np.int32), np.empty(n_vertices + 1, np.int32)
    side = np.empty(n_vertices, np.int8)
    behind = np.empty(n_vertices, orders.dtype)
    begin, end = np.zeros(1, np.int64), np.full(1, n_vertices, np.int64)
    for level in range(depth):
        next_begin, next_end = np.zeros(2 ** (level + 1), np.int64), np.zeros(2 ** (level + 1), np.int64)
        for part in range(2**level):
            first, size = begin[part], end[part] - begin[part]
            if size == 0:
                continue
            here = 2**level - 1 + part
            fewest = n_vertices + 1
            for c in range(n_coordinates):
                order = orders[c, first : first + size]
                for i in range(size):
                    rank[order[i]] = i
                whole_before[: size + 1] = 0
                touched_before[: size + 1] = 0
                for i in range(size):
                    lowest, highest = np.uint32(i), np.int32(i)
                    for k in range(np.uint64(indptr[order[i]]), np.uint64(indptr[order[i] + 1])):
                        of_neighbour = rank[np.uint32(indices[k])]
                        lowest, highest = min(lowest, np.uint32(of_neighbour)), max(highest, of_neighbour)
                    low[i], high[i] = lowest, highest
                    whole_before[highest + 1] += 1
                    touched_before[lowest + 1] += 1
                cut, cut_size, cut_before = 0, n_vertices, True
                before = after = 0
                for i in range(size):
                    before += whole_before[i]
                    after += touched_before[i]
                    if i > 0 and abs(i - size / 2) <= max(window * size, 1.0):
                        n_before, n_behind = i - before, after - i
                        if min(n_before, n_behind) < cut_size:
                            cut, cut_size, cut_before = i, min(n_before, n_behind), n_before <= n_behind
                if cut_size >= fewest:
                    continue
                fewest = cut_size
                for i in range(size):
                    if i < cut:
                        side[order[i]] = 2 if cut_before and high[i] >= cut else 0
                    else:
                        side[order[i]] = 2 if not cut_before and low[i] < cut else 1
            for i in range(first, first + size):
                rank[orders[0, i]] = -1
            for c in range(n_coordinates):
                order = orders[c, first : first + size]
                n_before = n_behind = 0
                for i in range(size):
                    vertex = order[i]
                    if side[vertex] == 0:
                        order[n_before] = vertex
                        n_before += 1
                    elif side[vertex] == 1:
                        behind[n_behind] = vertex
                        n_behind += 1
                    elif c == 0:
                        node[vertex] = here
                for i in range(n_behind):
                    order[n_before + i] = behind[i]
                if c == 0:
                    next_begin[2 * part], next_end[2 * part] = first, first + n_before
                    next_begin[2 * part + 1], next_end[2 * part + 1] = first + n_before, first + n_before + n_behind
        begin, end = next_begin, next_end
    for part in range(2**depth):
        for i in range(begin[part], end[part]):
            node[orders[0, i]] = 2**depth - 1 + part
    return node

"""The elimination order of the unknowns of a sparse symmetric matrix: nested dissection (George 1973).

This is the first step of a factorization, see `_multifrontal`. Only the pattern of the matrix is read.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from igps._compiled import compiled
from igps.spectra._checks import canonical

# Approximate number of vertices of a part that is not split further. Smaller leaves lead to more and smaller products,
# larger leaves to more fill-in.
LEAF_SIZE = 48
# Largest distance of a cut from the middle, relative to the size of the part. Wider windows find smaller separators,
# but the unbalanced trees cost more than they save.
CUT_WINDOW = 0.05


def hop_coordinates(graph: sparse.csr_array, n_landmarks: int = 3) -> np.ndarray:
    """Return hop distances (V, n_landmarks) to vertices far apart, as coordinates for a graph that has none."""
    pattern = sparse.csr_array((np.ones(graph.nnz), graph.indices, graph.indptr), shape=graph.shape)
    columns: list[np.ndarray] = []
    landmark = 0
    for _ in range(n_landmarks + 1):
        hops = dijkstra(pattern, directed=False, indices=landmark, unweighted=True)
        columns.append(np.where(np.isfinite(hops), hops, -1.0))
        # The first landmark is arbitrary. It is dropped once it has led to one at the far end.
        columns = columns[-n_landmarks:]
        landmark = int(np.min(columns, axis=0).argmax())
    return np.stack(columns, axis=1)


def checked_graph(
    matrix: sparse.csr_array, coordinates: np.ndarray | None
) -> tuple[sparse.csr_array, np.ndarray]:
    """Return the matrix with sorted entries, and coordinates of its vertices, with the errors of `analyse`."""
    matrix = canonical(matrix)
    n_vertices = matrix.shape[0]
    transpose = matrix.tocsc()
    if not (
        np.array_equal(transpose.indptr, matrix.indptr)
        and np.array_equal(transpose.indices, matrix.indices)
    ):
        raise ValueError(
            "matrix: expected entry (j, i) wherever (i, j) is stored, got an asymmetric pattern."
        )
    rows = np.repeat(np.arange(n_vertices), np.diff(matrix.indptr))
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
    depth = max(0, int(np.ceil(np.log2(n_vertices / leaf_size))))
    orders = [np.argsort(column, kind="stable") for column in coordinates.T]
    indptr, indices = (
        array.astype(np.int32, copy=False) for array in (graph.indptr, graph.indices)
    )
    return _dissect(np.stack(orders), indptr, indices, depth, CUT_WINDOW), depth + 1


@compiled()
def _dissect(
    orders: np.ndarray, indptr: np.ndarray, indices: np.ndarray, depth: int, window: float
) -> np.ndarray:
    """Return the node of each vertex. The orders (d, V), vertices sorted by each coordinate, are overwritten.

    Vertices outside the current part have rank −1, which is the largest unsigned number. The highest (signed) and the
    lowest (unsigned) rank among neighbours are therefore found without checking whether these are in the part.
    """
    n_coordinates, n_vertices = orders.shape
    node = np.empty(n_vertices, np.int64)
    rank = np.full(n_vertices, -1, np.int32)
    low, high = np.empty(n_vertices, np.int32), np.empty(n_vertices, np.int32)
    n_highest, n_lowest = np.empty(n_vertices + 1, np.int32), np.empty(n_vertices + 1, np.int32)
    side = np.empty(n_vertices, np.int8)  # 0 left, 1 right, 2 separator
    right = np.empty(n_vertices, orders.dtype)
    begin, end = np.zeros(1, np.int64), np.full(1, n_vertices, np.int64)
    for level in range(depth):
        next_begin, next_end = (
            np.zeros(2 ** (level + 1), np.int64),
            np.zeros(2 ** (level + 1), np.int64),
        )
        for part in range(2**level):
            first, size = begin[part], end[part] - begin[part]
            if size == 0:
                continue
            separator = 2**level - 1 + part
            min_size = n_vertices + 1
            for c in range(n_coordinates):
                order = orders[c, first : first + size]
                for i in range(size):
                    rank[order[i]] = i
                n_highest[: size + 1] = 0
                n_lowest[: size + 1] = 0
                for i in range(size):
                    lowest, highest = np.uint32(i), np.int32(i)
                    for k in range(np.uint64(indptr[order[i]]), np.uint64(indptr[order[i] + 1])):
                        neighbour_rank = rank[np.uint32(indices[k])]
                        lowest, highest = (
                            min(lowest, np.uint32(neighbour_rank)),
                            max(highest, neighbour_rank),
                        )
                    low[i], high[i] = lowest, highest
                    n_highest[highest + 1] += 1
                    n_lowest[lowest + 1] += 1
                cut, cut_size, is_left = 0, n_vertices, True
                # Vertices with all neighbours before the cut, and with at least one; a vertex is its own neighbour.
                n_closed = n_opened = 0
                for i in range(size):
                    n_closed += n_highest[i]
                    n_opened += n_lowest[i]
                    if i > 0 and abs(i - size / 2) <= max(window * size, 1.0):
                        left_size, right_size = i - n_closed, n_opened - i
                        if min(left_size, right_size) < cut_size:
                            cut, cut_size, is_left = (
                                i,
                                min(left_size, right_size),
                                left_size <= right_size,
                            )
                if cut_size >= min_size:
                    continue
                min_size = cut_size
                for i in range(size):
                    if i < cut:
                        side[order[i]] = 2 if is_left and high[i] >= cut else 0
                    else:
                        side[order[i]] = 2 if not is_left and low[i] < cut else 1
            for i in range(first, first + size):
                rank[orders[0, i]] = -1
            for c in range(n_coordinates):
                order = orders[c, first : first + size]
                n_left = n_right = 0
                for i in range(size):
                    vertex = order[i]
                    if side[vertex] == 0:
                        order[n_left] = vertex
                        n_left += 1
                    elif side[vertex] == 1:
                        right[n_right] = vertex
                        n_right += 1
                    elif c == 0:
                        node[vertex] = separator
                for i in range(n_right):
                    order[n_left + i] = right[i]
                if c == 0:
                    next_begin[2 * part], next_end[2 * part] = first, first + n_left
                    next_begin[2 * part + 1], next_end[2 * part + 1] = (
                        first + n_left,
                        first + n_left + n_right,
                    )
        begin, end = next_begin, next_end
    for part in range(2**depth):
        for i in range(begin[part], end[part]):
            node[orders[0, i]] = 2**depth - 1 + part
    return node

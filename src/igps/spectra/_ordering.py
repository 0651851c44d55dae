"""The order in which the unknowns of a sparse symmetric matrix are eliminated: nested dissection (George 1973).

It is the first step of `factorization`. Only the pattern of the matrix is read.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from igps._compiled import is_available
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
    """The matrix with sorted entries, and coordinates for its vertices; the arguments are those of `symbolic.dissect`.

    Raises:
        ValueError: the pattern is not symmetric or lacks diagonal entries, or coordinates do not fit it.
    """
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

    Each part is cut across the coordinate, and at the place within a window around the median, where the
    separator is smallest. Sweeping the cut along the sorted vertices, the separator on the left are the
    vertices before the cut with a neighbour behind it. Their number at all places is a difference of two counts, so
    that a level costs a few sorts, whatever its number of parts.
    """
    n_vertices = graph.shape[0]
    depth = max(0, int(np.ceil(np.log2(n_vertices / leaf_size))))
    orders = [np.argsort(column, kind="stable") for column in coordinates.T]
    if is_available():
        from igps.spectra import _loops as loops

        indptr, indices = (array.astype(np.int32, copy=False) for array in (graph.indptr, graph.indices))
        return loops.dissect(np.stack(orders), indptr, indices, depth, CUT_WINDOW), depth + 1
    node = np.full(n_vertices, -1)
    part = np.zeros(n_vertices, dtype=np.int32)
    rows = np.repeat(np.arange(n_vertices), np.diff(graph.indptr))
    columns = graph.indices
    for level in range(depth):
        inside = node < 0
        orders = [_sorted_by_part(order[inside[order]], part) for order in orders]
        behind, separator = _best_cuts(orders, part, rows, columns, 2**level)
        node[separator] = 2**level - 1 + part[separator]
        part = 2 * part + behind
        kept = (part[rows] == part[columns]) & (node[rows] < 0) & (node[columns] < 0)
        rows, columns = rows[kept], columns[kept]
    return np.where(node < 0, 2**depth - 1 + part, node), depth + 1


def _sorted_by_part(order: np.ndarray, part: np.ndarray) -> np.ndarray:
    keys = part[order]
    # a stable sort of 16-bit integers is a radix sort
    return order[np.argsort(keys.astype(np.int16) if keys.max(initial=0) < 2**15 else keys, kind="stable")]


def _best_cuts(
    orders: list[np.ndarray], part: np.ndarray, rows: np.ndarray, columns: np.ndarray, n_parts: int
) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices lie behind the cut of their part, and which form its separator: two (V,) masks.

    Args:
        orders: the vertices still to be placed, sorted by part and then by one coordinate; one array per coordinate.
        part: (V,) part of each vertex.
        rows, columns: edges within the parts, sorted by row, both directions.
        n_parts: number of parts, some of which may be empty.
    """
    size = np.bincount(part[orders[0]], minlength=n_parts)
    filled = np.flatnonzero(size)
    start = np.cumsum(size) - size
    place = np.arange(len(orders[0]))
    off_centre = np.abs(place - np.repeat(start + size / 2, size))
    # a cut at place t has t − start vertices before it; the window always holds a cut with some vertex on both sides
    allowed = (off_centre <= np.maximum(CUT_WINDOW * size, 1).repeat(size)) & (place > np.repeat(start, size))
    first_edge = np.flatnonzero(np.diff(rows, prepend=-1))
    with_edges = rows[first_edge]

    behind = np.zeros(len(part), dtype=bool)
    separator = np.zeros(len(part), dtype=bool)
    fewest = np.full(n_parts, len(place) + 1)
    for order in orders:
        rank = np.zeros(len(part), dtype=np.int64)
        rank[order] = place
        foremost, rearmost = rank.copy(), rank.copy()  # place of the first and the last of a vertex and its neighbours
        if len(rows):
            neighbours = rank[columns]
            foremost[with_edges] = np.minimum(foremost[with_edges], np.minimum.reduceat(neighbours, first_edge))
            rearmost[with_edges] = np.maximum(rearmost[with_edges], np.maximum.reduceat(neighbours, first_edge))
        n_before = place - _count_below(rearmost[order])  # before the cut, less those wholly before it
        n_behind = _count_below(foremost[order]) - place
        n_cut = np.where(allowed, np.minimum(n_before, n_behind), len(place))
        cut = np.zeros(n_parts, dtype=np.int64)
        cut[filled] = np.minimum.reduceat(n_cut * len(place) + place, start[filled]) % len(place)
        better = n_cut[cut] < fewest
        better[size == 0] = False
        fewest = np.where(better, n_cut[cut], fewest)

        vertices = order[np.repeat(better, size)]
        cuts = cut[part[vertices]]
        behind[vertices] = rank[vertices] >= cuts
        separator[vertices] = np.where(
            (n_before <= n_behind)[cuts],
            (rank[vertices] < cuts) & (rearmost[vertices] >= cuts),
            (rank[vertices] >= cuts) & (foremost[vertices] < cuts),
        )
    return behind, separator


def _count_below(values: np.ndarray) -> np.ndarray:
    """How many of the values, integers in [0, len), are below 0, 1, …, len − 1."""
    counts = np.bincount(values, minlength=len(values))
    return np.cumsum(counts) - counts

"""Sparse symmetric factorization as a short sequence of batched dense products.

Solvers such as SuperLU walk a sparse factor column by column and reach a few per cent of the machine's speed. Here
the matrix is cut into a binary tree of small dense blocks, and the blocks of a tree level are eliminated as batches:

1. *Nested dissection* (George 1973). A vertex separator splits the graph of the matrix in two halves, each half is
   split again, down to leaves of some tens of vertices. On a surface the first separator has O(√V) vertices.
   All nodes of one level are split together: the loops run over levels, not over nodes.
2. *Multifrontal elimination* (Duff & Reid 1983), leaves first. A node owns the vertices of its separator, a leaf all
   that is left to it; its *boundary* are the vertices of its ancestors that its subtree touches. Of its dense *front*

       F = [F₁₁ F₁₂]   own rows
           [F₂₁ F₂₂]   boundary rows

   the own unknowns are eliminated, and the Schur complement F₂₂ − F₂₁ F₁₁⁻¹ F₁₂ is added into the parent's front.
3. *Solve*. Each node keeps D = F₁₁⁻¹ and E = −F₁₁⁻¹ F₁₂. On the way up, Eᵀ b_own is added to the right-hand sides of
   the boundary; on the way down, x_own = D b_own + E x_boundary. Both are batched products for all right-hand sides.

The negative eigenvalues of all pivot blocks F₁₁ together number as many as those of the matrix (Sylvester's law of
inertia). For A − σI that is the number of eigenvalues of A below σ, and proves that an eigensolver missed none.

No pivot moves from one block to another. That is stable for a positive definite matrix. For an indefinite A − σI it is
so unless σ lies close to an eigenvalue of a leading block, which is rare but does happen: check a residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

# Of the part's vertices, how far from the middle a cut may lie. Wider windows find smaller separators, but the lopsided
# trees that follow cost more than they save.
CUT_WINDOW = 0.05
# Largest ratio of front sizes within a batch: many small batches lose time between them, few large ones in padding.
BATCH_SPREAD = 1.2
# Fronts are added to their parents in chunks of so many matrix entries, to bound the memory for their indices.
CHUNK_ENTRIES = 2**22


class SingularMatrixError(ValueError):
    """A pivot block of the shifted matrix is singular: the shift hits an eigenvalue of it."""


@dataclass(frozen=True)
class _Batch:
    """N fronts of one tree level, padded to one shape (S own rows, then B boundary rows) and eliminated together.

    Attributes:
        shape: N, S, B.
        offset: where the fronts, (S + B, S + B) each, start in the buffer of their level.
        parent_offset: (N,) where the parent's front starts in the buffer of its level.
        parent_width: (N,) row length S + B of the parent's front.
        parent_row: (N, B) row of each boundary vertex in the parent's front. Padding is 0: only zeros are added there.
    """

    shape: tuple[int, int, int]
    offset: int
    parent_offset: torch.Tensor
    parent_width: torch.Tensor
    parent_row: torch.Tensor


@dataclass(frozen=True)
class _Level:
    """The nodes of one tree level, their vertices, and where the matrix goes in the buffer that holds their fronts.

    The vertices are listed batch by batch, node by node. Padding is vertex V.

    Attributes:
        batches: the fronts, grouped by similar size so that little padding is needed.
        own: (ΣNS,) vertices eliminated here.
        boundary: (ΣNB,) ancestors' vertices that are updated.
        rows: (ΣN(S+B),) both, node by node.
        buffer_size: number of entries of all fronts.
        entry: (E,) indices of the matrix's stored entries that belong to this level.
        slot: (E,) their places in the buffer.
        diagonal: places of the owned diagonal entries.
        padding: places of the diagonal entries of padding rows.
    """

    batches: tuple[_Batch, ...]
    own: torch.Tensor
    boundary: torch.Tensor
    rows: torch.Tensor
    buffer_size: int
    entry: torch.Tensor
    slot: torch.Tensor
    diagonal: torch.Tensor
    padding: torch.Tensor


@dataclass(frozen=True)
class Dissection:
    """Elimination order and block structure for one sparsity pattern; serves any number of values and shifts.

    Attributes:
        levels: from the leaves to the root.
        indptr: (V + 1,) of the csr matrix.
        indices: column of each of its stored entries.
        device: where the index tensors live, and the factors will.
    """

    levels: tuple[_Level, ...]
    indptr: np.ndarray
    indices: np.ndarray
    device: torch.device


# ------------------------------------------------------------------------------------------------------ ordering


def _graph_coordinates(graph: sparse.csr_array, n_landmarks: int = 3) -> np.ndarray:
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


def _dissect_graph(graph: sparse.csr_array, coordinates: np.ndarray, leaf_size: int) -> tuple[np.ndarray, int]:
    """The tree node of each vertex, numbered as in a heap (root 0, children 2i+1 and 2i+2), and the number of levels.

    Each part is cut across the coordinate, and at the place within a window around the median, where the
    separator is smallest. Sweeping the cut along the sorted vertices, the separator on the left are the
    vertices before the cut with a neighbour behind it. Their number at all places is a difference of two counts, so
    that a level costs a few sorts, whatever its number of parts.
    """
    n_vertices = graph.shape[0]
    depth = max(0, int(np.ceil(np.log2(n_vertices / leaf_size))))
    orders = [np.argsort(column, kind="stable") for column in coordinates.T]
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


# ------------------------------------------------------------------------------------------------------ symbolic


@dataclass(frozen=True)
class _Tree:
    """Nodes of the elimination tree and their fronts.

    Vertices are numbered in the order of their elimination, so that those a node owns are a range of numbers. A
    key, node · V + number, stands for a vertex in the boundary of a node.

    Attributes:
        vertices: (V,) vertex of each number.
        level: per node, 0 for the root.
        n_own, first_own: per node, the range of numbers it owns.
        keys: all boundaries, sorted.
        n_boundary, first_boundary: per node, its range of the keys.
    """

    vertices: np.ndarray
    level: np.ndarray
    n_own: np.ndarray
    first_own: np.ndarray
    keys: np.ndarray
    n_boundary: np.ndarray
    first_boundary: np.ndarray


@dataclass(frozen=True)
class _Layout:
    """How the padded fronts lie in the buffers of their levels.

    Attributes:
        batches: per level from the root, the nodes of each batch.
        n_own_padded: S, per node.
        width: S + B, per node.
        offset: per node, where its front starts.
        buffer_size: per level.
    """

    batches: list[list[np.ndarray]]
    n_own_padded: np.ndarray
    width: np.ndarray
    offset: np.ndarray
    buffer_size: np.ndarray


def dissect(
    matrix: sparse.csr_array,
    coordinates: np.ndarray | None = None,
    *,
    leaf_size: int = 32,
    device: torch.device | str = "cpu",
) -> Dissection:
    """Elimination order and block structure for all matrices with one symmetric sparsity pattern.

    Args:
        matrix: (V, V) with a symmetric pattern that holds the whole diagonal; only the pattern is read.
        coordinates: (V, d) places along which the graph is cut, any unit; short edges make good cuts. Without
            them hop distances to a few far-apart vertices serve, with somewhat larger blocks.
        leaf_size: a part of about so many vertices is not split any more.
        device: where factors will live.

    Raises:
        ValueError: the pattern is not symmetric or lacks diagonal entries, or coordinates do not fit it.
    """
    matrix = _canonical(matrix)
    n_vertices = matrix.shape[0]
    rows = np.repeat(np.arange(n_vertices), np.diff(matrix.indptr))
    columns = matrix.indices.astype(np.int64)
    transpose = matrix.tocsc()
    if not (np.array_equal(transpose.indptr, matrix.indptr) and np.array_equal(transpose.indices, matrix.indices)):
        raise ValueError(f"matrix must store entry (j, i) where it stores (i, j), shape is {matrix.shape}")
    if np.count_nonzero(rows == columns) != n_vertices:
        raise ValueError("matrix must store every diagonal entry: store zeros explicitly")
    if coordinates is None:
        coordinates = _graph_coordinates(matrix)
    if coordinates.ndim != 2 or len(coordinates) != n_vertices:
        raise ValueError(f"coordinates must be ({n_vertices}, d) for this matrix, got {coordinates.shape}")

    node, n_levels = _dissect_graph(matrix, coordinates, leaf_size)
    tree, number = _elimination_tree(node, n_levels, rows, columns)
    layout = _batch_fronts(tree)

    # the front of an entry's row holds it if its column is eliminated together with the row or later
    entry = np.flatnonzero((node[rows] == node[columns]) | (number[columns] > number[rows]))
    nodes, entry_row, entry_column = node[rows[entry]], number[rows[entry]], number[columns[entry]]
    slot = layout.offset[nodes] + (entry_row - tree.first_own[nodes]) * layout.width[nodes]
    slot += _rows_in_front(tree, layout, nodes, entry_column)
    parents = np.maximum(tree.keys // n_vertices - 1, 0) // 2
    parent_row = _rows_in_front(tree, layout, parents, tree.keys % n_vertices)
    levels = []
    for level in range(n_levels - 1, -1, -1):
        here = tree.level[nodes] == level
        levels.append(_make_level(tree, layout, level, parent_row, entry[here], slot[here], torch.device(device)))
    return Dissection(tuple(levels), matrix.indptr, matrix.indices, torch.device(device))


def _canonical(matrix: sparse.csr_array) -> sparse.csr_array:
    """The matrix with sorted indices and no duplicates; the argument is not touched."""
    matrix = sparse.csr_array(matrix)
    if not matrix.has_canonical_format:
        matrix = matrix.copy()
        matrix.sum_duplicates()
    return matrix


def _elimination_tree(
    node: np.ndarray, n_levels: int, rows: np.ndarray, columns: np.ndarray
) -> tuple[_Tree, np.ndarray]:
    """The tree for vertices assigned to nodes, and the number of each vertex in the order of elimination."""
    n_vertices, n_nodes = len(node), 2**n_levels - 1
    level = np.repeat(np.arange(n_levels), 2 ** np.arange(n_levels))
    vertices = np.lexsort((node, -level[node]))  # deepest level first, node by node
    number = np.empty(n_vertices, dtype=np.int64)
    number[vertices] = np.arange(n_vertices)
    n_own = np.bincount(node, minlength=n_nodes)
    order = np.argsort(-level, kind="stable")
    first_own = np.empty(n_nodes, dtype=np.int64)
    first_own[order] = np.cumsum(n_own[order]) - n_own[order]

    # a node's boundary: what its own edges reach, and its children's boundaries, less what it owns
    upward = level[node[columns]] < level[node[rows]]
    edge_level = level[node[rows[upward]]]
    edge_keys = node[rows[upward]] * n_vertices + number[columns[upward]]
    inherited = np.empty(0, dtype=np.int64)
    keys_of_level = []
    for depth in range(n_levels - 1, -1, -1):
        keys = np.unique(np.concatenate([inherited, edge_keys[edge_level == depth]]))
        keys_of_level.append(keys)
        parents, numbers = (keys // n_vertices - 1) // 2, keys % n_vertices
        beyond = node[vertices[numbers]] != parents
        inherited = (parents * n_vertices + numbers)[beyond]
    keys = np.concatenate(keys_of_level[::-1])
    first_boundary = np.searchsorted(keys, np.arange(n_nodes + 1) * n_vertices)
    tree = _Tree(vertices, level, n_own, first_own, keys, np.diff(first_boundary), first_boundary[:-1])
    return tree, number


def _batch_fronts(tree: _Tree) -> _Layout:
    """Group the nodes of each level by front size, and lay out the fronts."""
    n_levels = int(tree.level[-1]) + 1
    width, n_own_padded, offset = (np.zeros(len(tree.level), dtype=np.int64) for _ in range(3))
    buffer_size = np.zeros(n_levels, dtype=np.int64)
    batches = []
    for level in range(n_levels):
        nodes = np.flatnonzero(tree.level == level)
        size = tree.n_own[nodes] + tree.n_boundary[nodes]
        by_size = np.argsort(size, kind="stable")
        size_class = np.floor(np.log(size[by_size] + 1) / np.log(BATCH_SPREAD))
        groups = np.split(nodes[by_size], np.flatnonzero(np.diff(size_class)) + 1)
        batches.append(groups)
        for group in groups:
            n_own_padded[group] = tree.n_own[group].max()
            width[group] = n_own_padded[group] + tree.n_boundary[group].max()
            offset[group] = buffer_size[level] + np.arange(len(group)) * width[group] ** 2
            buffer_size[level] += len(group) * width[group[0]] ** 2
    return _Layout(batches, n_own_padded, width, offset, buffer_size)


def _rows_in_front(tree: _Tree, layout: _Layout, nodes: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """The row of each vertex, given by its number, in the front of the node beside it."""
    inside = numbers - tree.first_own[nodes]
    outside = np.searchsorted(tree.keys, nodes * len(tree.vertices) + numbers) - tree.first_boundary[nodes]
    owned = (inside >= 0) & (inside < tree.n_own[nodes])
    return np.where(owned, inside, layout.n_own_padded[nodes] + outside)


def _make_level(
    tree: _Tree,
    layout: _Layout,
    level: int,
    parent_row: np.ndarray,
    entry: np.ndarray,
    slot: np.ndarray,
    device: torch.device,
) -> _Level:
    """One level's index tensors; parent_row belongs to tree.keys, entry and slot are those of this level."""

    def tensor(arrays: np.ndarray | list[np.ndarray]) -> torch.Tensor:
        joined = np.concatenate([array.ravel() for array in arrays]) if isinstance(arrays, list) else arrays
        return torch.from_numpy(joined).to(device)

    n_vertices = len(tree.vertices)
    vertices = np.append(tree.vertices, n_vertices)
    boundary_vertices = np.append(tree.vertices[tree.keys % n_vertices], n_vertices)
    padded_parent_row = np.append(parent_row, 0)
    batches, own, boundary, rows, diagonal, padding = [], [], [], [], [], []
    for nodes in layout.batches[level]:
        own_index, owned = _padded_ranges(tree.first_own[nodes], tree.n_own[nodes], n_vertices)
        key_index, _ = _padded_ranges(tree.first_boundary[nodes], tree.n_boundary[nodes], len(tree.keys))
        own.append(vertices[own_index])
        boundary.append(boundary_vertices[key_index])
        rows.append(np.concatenate([own[-1], boundary[-1]], axis=1))
        places = layout.offset[nodes, None] + np.arange(owned.shape[1]) * (layout.width[nodes, None] + 1)
        diagonal.append(places[owned])
        padding.append(places[~owned])
        parents = np.maximum(nodes - 1, 0) // 2
        batches.append(
            _Batch(
                shape=(len(nodes), own_index.shape[1], key_index.shape[1]),
                offset=int(layout.offset[nodes[0]]),
                parent_offset=tensor(layout.offset[parents]),
                parent_width=tensor(layout.width[parents]),
                parent_row=tensor(padded_parent_row[key_index]),
            )
        )
    return _Level(
        batches=tuple(batches),
        own=tensor(own),
        boundary=tensor(boundary),
        rows=tensor(rows),
        buffer_size=int(layout.buffer_size[level]),
        entry=tensor(entry),
        slot=tensor(slot),
        diagonal=tensor(diagonal),
        padding=tensor(padding),
    )


def _padded_ranges(first: np.ndarray, count: np.ndarray, padding: int) -> tuple[np.ndarray, np.ndarray]:
    """Ranges first … first + count − 1 as rows of one array filled up with padding, and the mask of what is real."""
    place = np.arange(count.max())
    real = place < count[:, None]
    return np.where(real, first[:, None] + place, padding), real


# ------------------------------------------------------------------------------------------------------- numeric


@dataclass(frozen=True)
class Factorization:
    """The factors of one matrix: solves with it, and its number of negative eigenvalues.

    Attributes:
        dissection: the structure it was made with.
        blocks: per level and batch (N, S, S + B), [D E] of the module docstring.
        n_negative: number of negative eigenvalues of the matrix.
    """

    dissection: Dissection
    blocks: tuple[tuple[torch.Tensor, ...], ...]
    n_negative: int

    def solve(self, right_hand_sides: torch.Tensor) -> torch.Tensor:
        """The solutions (V, b) for right-hand sides (V, b), float64 on the device of the dissection."""
        n_vertices, n_columns = right_hand_sides.shape
        vectors = right_hand_sides.new_zeros(n_vertices + 1, n_columns)  # the last row stands for padding and stays 0
        vectors[:n_vertices] = right_hand_sides
        levels = list(zip(self.dissection.levels, self.blocks, strict=True))
        for level, blocks in levels[:-1]:
            own = vectors.index_select(0, level.own)
            update = vectors.new_empty(len(level.boundary), n_columns)
            eliminations = [
                block[:, :, batch.shape[1] :].mT for batch, block in zip(level.batches, blocks, strict=True)
            ]
            _multiply(eliminations, own, update)
            vectors.index_put_((level.boundary,), update, accumulate=True)
        for level, blocks in reversed(levels):
            known = vectors.index_select(0, level.rows)
            own = vectors.new_empty(len(level.own), n_columns)
            _multiply(blocks, known, own)
            vectors.index_copy_(0, level.own, own)
        return vectors[:n_vertices]


def _multiply(matrices: Sequence[torch.Tensor], vectors: torch.Tensor, products: torch.Tensor) -> None:
    """Products of batches (N, r, c) with (N, c, b); the vectors of all batches lie end to end, so do the products."""
    n_columns = vectors.shape[1]
    first_vector = first_product = 0
    for matrix in matrices:
        n_fronts, n_rows, n_inner = matrix.shape
        last_vector, last_product = first_vector + n_fronts * n_inner, first_product + n_fronts * n_rows
        torch.bmm(
            matrix,
            vectors[first_vector:last_vector].view(n_fronts, n_inner, n_columns),
            out=products[first_product:last_product].view(n_fronts, n_rows, n_columns),
        )
        first_vector, first_product = last_vector, last_product


def factorize(dissection: Dissection, matrix: sparse.csr_array, shift: float = 0.0) -> Factorization:
    """Factorize ``matrix − shift · I``, float64.

    Args:
        dissection: structure from `dissect` for a matrix with the same stored entries.
        matrix: (V, V) symmetric; both triangles are read.
        shift: any number that is not an eigenvalue.

    Raises:
        ValueError: the stored entries of matrix are not those of the dissection.
        SingularMatrixError: a pivot block is singular.
    """
    matrix = _canonical(matrix)
    if not (np.array_equal(matrix.indptr, dissection.indptr) and np.array_equal(matrix.indices, dissection.indices)):
        raise ValueError("matrix must store the same entries as the one that was dissected: dissect it anew")
    values = torch.from_numpy(matrix.data.astype(np.float64)).to(dissection.device)
    all_blocks = []
    n_negative = 0
    updates: list[tuple[_Batch, torch.Tensor]] = []
    for level in dissection.levels:
        fronts = values.new_zeros(level.buffer_size)
        fronts[level.slot] = values[level.entry]
        fronts[level.diagonal] -= shift
        fronts[level.padding] = 1.0
        while updates:
            _extend_add(fronts, *updates.pop())
        blocks = []
        for batch in level.batches:
            n_fronts, n_own, n_boundary = batch.shape
            width = n_own + n_boundary
            front = fronts[batch.offset : batch.offset + n_fronts * width**2].view(n_fronts, width, width)
            inverse, n_negative_pivots = _invert(front[:, :n_own, :n_own])
            coupling = front[:, :n_own, n_own:]
            elimination = -torch.bmm(inverse, coupling)
            blocks.append(torch.cat([inverse, elimination], 2))
            n_negative += n_negative_pivots
            updates.append((batch, torch.baddbmm(front[:, n_own:, n_own:], coupling.mT, elimination)))
        all_blocks.append(tuple(blocks))
    return Factorization(dissection, tuple(all_blocks), n_negative)


def _extend_add(fronts: torch.Tensor, batch: _Batch, update: torch.Tensor) -> None:
    """Add the Schur complements (N, B, B) of a batch into the fronts of the parents, in place."""
    row_start = batch.parent_offset[:, None] + batch.parent_row * batch.parent_width[:, None]
    chunk = max(1, CHUNK_ENTRIES // max(1, update[0].numel()))
    for starts, columns, values in zip(
        row_start.split(chunk), batch.parent_row.split(chunk), update.split(chunk), strict=True
    ):
        fronts.index_add_(0, (starts[:, :, None] + columns[:, None, :]).flatten(), values.flatten())


def _invert(pivots: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Inverses of symmetric blocks (N, S, S), and how many negative eigenvalues the blocks have together."""
    factors, failed = torch.linalg.cholesky_ex(pivots)
    indefinite = failed > 0
    if not indefinite.any():
        return torch.cholesky_inverse(factors), 0
    inverses = torch.empty_like(pivots)
    inverses[~indefinite] = torch.cholesky_inverse(factors[~indefinite])
    factors, order, failed = torch.linalg.ldl_factor_ex(pivots[indefinite])
    if failed.any():
        raise SingularMatrixError("a pivot block of the shifted matrix is singular: use a slightly different shift")
    identity = torch.eye(pivots.shape[-1], dtype=pivots.dtype, device=pivots.device).expand_as(factors)
    inverse = torch.linalg.ldl_solve(factors, order, identity)
    inverses[indefinite] = (inverse + inverse.mT) / 2
    # Bunch & Kaufman's pivots: a 1×1 one counts by its sign, a 2×2 one (marked by a negative index) has one eigenvalue
    # of either sign
    diagonal = torch.diagonal(factors, dim1=-2, dim2=-1)
    n_negative = ((order > 0) & (diagonal < 0)).sum() + (order < 0).sum() // 2
    return inverses, int(n_negative)

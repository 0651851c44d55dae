"""The block structure of a sparse factorization, for one sparsity pattern: which front takes which entry.

`factorization` says what fronts are. Here the nodes of the tree of `ordering` get their boundaries, the fronts of a
level are batched by size, and every stored entry of the matrix gets its place in the buffer of its level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from igps.spectra._ordering import LEAF_SIZE, checked_graph, nested_dissection

# Largest ratio of front sizes within a batch: many small batches lose time between them, few large ones in padding.
BATCH_SPREAD = 1.2


@dataclass(frozen=True)
class Batch:
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
class Level:
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

    batches: tuple[Batch, ...]
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

    levels: tuple[Level, ...]
    indptr: np.ndarray
    indices: np.ndarray
    device: torch.device


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
    leaf_size: int = LEAF_SIZE,
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
    matrix, coordinates = checked_graph(matrix, coordinates)
    n_vertices = matrix.shape[0]
    rows = np.repeat(np.arange(n_vertices), np.diff(matrix.indptr))
    columns = matrix.indices.astype(np.int64)
    node, n_levels = nested_dissection(matrix, coordinates, leaf_size)
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
) -> Level:
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
            Batch(
                shape=(len(nodes), own_index.shape[1], key_index.shape[1]),
                offset=int(layout.offset[nodes[0]]),
                parent_offset=tensor(layout.offset[parents]),
                parent_width=tensor(layout.width[parents]),
                parent_row=tensor(padded_parent_row[key_index]),
            )
        )
    return Level(
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

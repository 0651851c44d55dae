"""The loops of `multifrontal`, compiled. Importing this imports Numba: ask `igps._compiled.is_available` first."""

from __future__ import annotations

import numpy as np

from igps._compiled import compiled
from igps.spectra._tiles import COLUMNS, ROWS, product

# Unknowns that are eliminated at once inside of a pivot block
AT_ONCE = COLUMNS
# What may be missing of an indefinite block times its inverse to the identity, in norm
MOST_MISSING = 3e-13


@compiled()
def _dissect(orders: np.ndarray, indptr: np.ndarray, indices: np.ndarray, depth: int, window: float) -> np.ndarray:
    """The loops of `ordering.nested_dissection`, part by part; the vertices sorted by each coordinate are overwritten.

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


@compiled()
def _tree(
    node: np.ndarray, n_nodes: int, indptr: np.ndarray, indices: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The elimination tree for vertices assigned to the nodes of a heap, depth first.

    Returns:
        order (V,), number (V,): the vertex of each number and the number of each vertex.
        first (N + 1,): where each node's own numbers start.
        children (N, 2): nodes, or -1.
        start (N + 1,), boundary: the numbers in each node's boundary, sorted.
        parent_row: their rows in the front of the node's parent.
    """
    n_vertices = len(node)
    post = np.empty(n_nodes, np.int64)  # of a place in the heap
    children = np.full((n_nodes, 2), -1, np.int64)
    parent = np.full(n_nodes, -1, np.int64)
    stack = np.empty(128, np.int64)
    stack[0] = 0
    top, count = 1, 0
    while top:
        here = stack[top - 1]
        if here >= 0 and 2 * here + 1 < n_nodes:
            stack[top - 1] = -1 - here  # to come back to after its children
            stack[top], stack[top + 1] = 2 * here + 2, 2 * here + 1
            top += 2
            continue
        top -= 1
        here = here if here >= 0 else -1 - here
        post[here] = count
        if 2 * here + 1 < n_nodes:
            for side in range(2):
                child = post[2 * here + 1 + side]
                children[count, side], parent[child] = child, count
        count += 1

    first = np.zeros(n_nodes + 1, np.int64)
    for v in range(n_vertices):
        first[post[node[v]] + 1] += 1
    for n in range(n_nodes):
        first[n + 1] += first[n]
    fill = first[:-1].copy()
    order, number = np.empty(n_vertices, np.int64), np.empty(n_vertices, np.int64)
    for v in range(n_vertices):
        n = post[node[v]]
        order[fill[n]], number[v] = v, fill[n]
        fill[n] += 1

    # a node's boundary: what its own edges reach, and its children's boundaries, less what it owns
    seen = np.full(n_vertices, -1, np.int64)
    start = np.zeros(n_nodes + 1, np.int64)
    boundary = np.empty(4 * n_vertices, np.int64)
    for n in range(n_nodes):
        stop, begin = first[n + 1], start[n]
        end = begin
        need = begin
        for side in range(2):
            child = children[n, side]
            if child >= 0:
                need += start[child + 1] - start[child]
        for i in range(first[n], stop):
            need += indptr[order[i] + 1] - indptr[order[i]]
        if need > len(boundary):
            larger = np.empty(2 * need, np.int64)
            larger[:end] = boundary[:end]
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
        boundary[begin:end].sort()
        start[n + 1] = end

    parent_row = np.empty(start[n_nodes], np.int64)
    for n in range(n_nodes - 1):
        p = parent[n]
        n_own, place = first[p + 1] - first[p], start[p]
        for k in range(start[n], start[n + 1]):
            if boundary[k] < first[p + 1]:
                parent_row[k] = boundary[k] - first[p]
                continue
            while boundary[place] < boundary[k]:
                place += 1
            parent_row[k] = n_own + place - start[p]
    return order, number, first, children, start, boundary[: start[n_nodes]].copy(), parent_row


@compiled()
def _arranged(
    indptr: np.ndarray, indices: np.ndarray, values: np.ndarray, order: np.ndarray, number: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A csr matrix whose row i and column i are those of ``order[i]`` before; its entries are sorted."""
    new_indptr, new_indices = np.zeros_like(indptr), np.empty_like(indices)
    new_values = np.empty_like(values)
    end = 0
    for i in range(len(order)):
        begin = end
        for k in range(indptr[order[i]], indptr[order[i] + 1]):
            j, place = number[indices[k]], end
            while place > begin and new_indices[place - 1] > j:
                new_indices[place], new_values[place] = new_indices[place - 1], new_values[place - 1]
                place -= 1
            new_indices[place], new_values[place] = j, values[k]
            end += 1
        new_indptr[i + 1] = end
    return new_indptr, new_indices, new_values


@compiled()
def _assemble(
    n: int,
    values: np.ndarray,
    shift: float,
    indptr: np.ndarray,
    indices: np.ndarray,
    order: np.ndarray,
    number: np.ndarray,
    first: np.ndarray,
    children: np.ndarray,
    start: np.ndarray,
    boundary: np.ndarray,
    parent_row: np.ndarray,
    updates: np.ndarray,
    update_start: np.ndarray,
    place: np.ndarray,
    front: np.ndarray,
) -> None:
    """Write the upper triangle of a node's front, (S + B, S + B): of the matrix, and its children's complements."""
    begin, stop = first[n], first[n + 1]
    n_own = stop - begin
    width = n_own + start[n + 1] - start[n]
    for k in range(start[n], start[n + 1]):
        place[boundary[k]] = n_own + k - start[n]
    for i in range(width):
        front[i * width + i : (i + 1) * width] = 0.0
    for i in range(n_own):
        vertex = order[begin + i]
        for k in range(indptr[vertex], indptr[vertex + 1]):
            j = number[indices[k]]
            if j >= begin + i:
                front[i * width + (j - begin if j < stop else place[j])] += values[k]
        front[i * width + i] -= shift
    for side in range(2):
        child = children[n, side]
        if child < 0:
            continue
        base, size = start[child], start[child + 1] - start[child]
        for i in range(size):
            row = parent_row[base + i] * width
            source = update_start[child] + i * size
            for j in range(i, size):
                front[row + parent_row[base + j]] += updates[source + j]


assemble = _assemble.dispatcher


@compiled()
def _invert_pivot(pivot: np.ndarray, size: int) -> int:
    """Replace a block, rows of AT_ONCE numbers, by its inverse; its negative pivots, -1 if one is 0 or not finite.

    What is behind ``size`` in a row must be finite.
    """
    n_negative = 0
    for q in range(np.uint64(size)):
        row = q * np.uint64(AT_ONCE)
        value = pivot[row + q]
        if not 0.0 < abs(value) < np.inf:
            return -1
        n_negative += value < 0
        pivot[row + q] = 1.0
        for j in range(np.uint64(AT_ONCE)):
            pivot[row + j] *= 1.0 / value
        for i in range(np.uint64(size)):
            if i != q:
                other = i * np.uint64(AT_ONCE)
                factor = pivot[other + q]
                pivot[other + q] = 0.0
                for j in range(np.uint64(AT_ONCE)):
                    pivot[other + j] -= factor * pivot[row + j]
    return n_negative


invert_pivot = _invert_pivot.dispatcher


@compiled()
def _invert(matrix: np.ndarray, n: int, width: int, rows: np.ndarray, columns: np.ndarray) -> int:
    """Replace a symmetric matrix (n, width) by its inverse; its negative pivots, -1 if one is 0 or not finite.

    Gauss and Jordan's elimination of AT_ONCE unknowns at a time, of which the width is a multiple. As the pivots are
    taken as they come, the inverse is accurate where the matrix is definite; elsewhere see `_invert_front`.

    Args:
        matrix: flat.
        n, width: its size, and that of its rows; what is behind n must be 0.
        rows: (AT_ONCE · width,) room.
        columns: ((n + AT_ONCE) · AT_ONCE,) room.
    """
    n_negative = 0
    pivot = columns[n * AT_ONCE :]
    for k in range(0, n, AT_ONCE):
        size = min(AT_ONCE, n - k)
        for i in range(size):
            for j in range(AT_ONCE):
                pivot[i * AT_ONCE + j] = matrix[(k + i) * width + k + j]
        negative = invert_pivot(pivot, size)
        if negative < 0:
            return -1
        n_negative += negative
        # the rows that are eliminated, times the inverse of their pivot
        eliminated, times_inverse = (matrix, k * width, width), (rows, 0, width)
        product((size, width, size), 1.0, (pivot, 0, AT_ONCE, 1), eliminated, False, times_inverse, times_inverse)
        for i in range(size):
            for j in range(size):
                rows[i * width + k + j] = pivot[i * AT_ONCE + j]
        for i in range(n):
            for j in range(size):
                columns[i * AT_ONCE + j] = matrix[i * width + k + j]
                matrix[i * width + k + j] = 0.0
        for begin, end in ((0, k), (k + size, n)):
            shape, rest = (end - begin, width, size), (matrix, begin * width, width)
            product(shape, -1.0, (columns, begin * AT_ONCE, 1, AT_ONCE), times_inverse, True, rest, rest)
        for i in range(size * width):
            matrix[k * width + i] = rows[i]
    return n_negative


invert = _invert.dispatcher


@compiled()
def _load(matrix: np.ndarray, front: np.ndarray, n: int, front_width: int, width: int, backwards: bool) -> None:
    """Copy the symmetric matrix (n, width) of which a front has the upper triangle, with zeros behind it."""
    for i in range(n):
        for j in range(i, n):
            value = front[i * front_width + j]
            row, column = (n - 1 - i, n - 1 - j) if backwards else (i, j)
            matrix[row * width + column] = matrix[column * width + row] = value
        for j in range(n, width):
            matrix[i * width + j] = 0.0


@compiled()
def _missing(matrix: np.ndarray, inverse: np.ndarray, n: int, width: int, room: np.ndarray) -> float:
    """The Frobenius norm of I − A X."""
    whole = (room, 0, width)
    for i in range(n * width):
        room[i] = 0.0
    for i in range(n):
        room[i * width + i] = 1.0
    product((n, width, n), -1.0, (matrix, 0, width, 1), (inverse, 0, width), True, whole, whole)
    squares = 0.0
    for i in range(n * width):
        squares += room[i] ** 2
    return np.sqrt(squares)


load, missing = _load.dispatcher, _missing.dispatcher


@compiled()
def _invert_front(
    inverse: np.ndarray,
    front: np.ndarray,
    n: int,
    front_width: int,
    width: int,
    copy: np.ndarray,
    room: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
) -> int:
    """Write the inverse (n, width) of a front's pivot block; the negative eigenvalues of that, -1 if it cannot tell.

    What is definite is inverted accurately with its pivots in any order. What is not loses digits in one order or the
    other, rarely in both: how many is seen by A X, which is also why their signs can be believed. Between A and the
    matrix that X is the inverse of, no eigenvalue passes zero.
    """
    for backwards in (False, True):
        load(inverse, front, n, front_width, width, backwards)
        n_negative = invert(inverse, n, width, rows, columns)
        if n_negative > 0:
            load(copy, front, n, front_width, width, backwards)
            if not missing(copy, inverse, n, width, room) <= MOST_MISSING:
                continue
        if n_negative >= 0:
            if backwards:
                for i in range(n // 2 + n % 2):
                    for j in range(n if i < n // 2 else n // 2):
                        here, there = i * width + j, (n - 1 - i) * width + n - 1 - j
                        inverse[here], inverse[there] = inverse[there], inverse[here]
            return n_negative
    return -1


invert_front = _invert_front.dispatcher


@compiled()
def _eliminate(
    nodes: tuple[int, int],
    largest: int,
    values: np.ndarray,
    shift: float,
    indptr: np.ndarray,
    indices: np.ndarray,
    order: np.ndarray,
    number: np.ndarray,
    first: np.ndarray,
    children: np.ndarray,
    start: np.ndarray,
    boundary: np.ndarray,
    parent_row: np.ndarray,
    updates: np.ndarray,
    update_start: np.ndarray,
    place: np.ndarray,
    front: np.ndarray,
    blocks: np.ndarray,
    block_start: np.ndarray,
    pivot: np.ndarray,
    copy: np.ndarray,
    room: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
) -> tuple[int, int]:
    """Eliminate the nodes of a range one after another; their negative pivots, and the node at which it stops.

    Before the end of the range it stops at a node, whose front is assembled, that has more than ``largest`` own
    unknowns, or whose pivots must be taken in another order.
    """
    n_negative = 0
    for n in range(nodes[0], nodes[1]):
        assemble(
            n, values, shift, indptr, indices, order, number, first, children, start, boundary, parent_row, updates,
            update_start, place, front,
        )  # fmt: skip
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        width = n_own + n_boundary
        if n_own > largest:
            return n_negative, n
        padded = -(-n_own // AT_ONCE) * AT_ONCE
        negative = invert_front(pivot, front, n_own, width, padded, copy, room, rows, columns)
        if negative < 0:
            return n_negative, n
        n_negative += negative
        block = blocks[block_start[n] :]
        for i in range(n_own):
            for j in range(n_own):
                block[i * width + j] = pivot[j * padded + i]
        if n_boundary == 0:
            continue
        coupling, elimination = (front, n_own, width), (blocks, block_start[n] + n_own, width)
        shape = (n_own, n_boundary, n_own)
        product(shape, -1.0, (pivot, 0, 1, padded), coupling, False, elimination, elimination)
        # of the complement the upper triangle, some rows at a time
        for i in range(0, n_boundary, ROWS):
            n_rows, begin = min(ROWS, n_boundary - i), max(0, min(i, n_boundary - COLUMNS))
            product(
                (n_rows, n_boundary - begin, n_own), 1.0, (front, n_own + i, width, 1),
                (blocks, block_start[n] + n_own + begin, width), True,
                (front, (n_own + i) * width + n_own + begin, width),
                (updates, update_start[n] + i * n_boundary + begin, n_boundary),
            )  # fmt: skip
    return n_negative, nodes[1]


@compiled()
def _add_row(into: np.ndarray, at: int, source: np.ndarray, of: int, b: int) -> None:
    """Add row ``of`` of one flat array to row ``at`` of another, rows of b numbers each."""
    # An unsigned index is one that need not be counted from the end.
    begin, origin = np.uint64(at * b), np.uint64(of * b)
    for c in range(np.uint64(b)):
        into[begin + c] += source[origin + c]


add_row = _add_row.dispatcher


@compiled()
def _forward(
    nodes: tuple[int, int],
    right: np.ndarray,
    order: np.ndarray,
    first: np.ndarray,
    children: np.ndarray,
    start: np.ndarray,
    parent_row: np.ndarray,
    blocks: np.ndarray,
    block_start: np.ndarray,
    x: np.ndarray,
    carried: np.ndarray,
    carried_start: np.ndarray,
    largest: int,
) -> None:
    """The way up through a range of nodes: x, (V, b) flat, becomes D x; Eᵀ x is carried to the boundary's owners."""
    b = right.shape[1]
    rows = np.empty(largest * b)
    for n in range(nodes[0], nodes[1]):
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        width, own = n_own + n_boundary, x[first[n] * b :]
        for i in range(n_own):
            place = np.uint64(order[first[n] + i])
            for c in range(np.uint64(b)):
                own[np.uint64(i * b) + c] = right[place, c]
        # what the children carry: to own unknowns first, to those on the boundary behind the product
        for side in range(2):
            child = children[n, side]
            if child >= 0:
                source, place = carried[carried_start[child] * b :], start[child]
                k = 0
                while k < start[child + 1] - place and parent_row[place + k] < n_own:
                    add_row(own, parent_row[place + k], source, k, b)
                    k += 1
        # D is symmetric: one product with the transposed block gives D x and Eᵀ x
        block, found = (blocks, block_start[n], width, 1), (rows, 0, b)
        product((width, b, n_own), 1.0, block, (x, first[n] * b, b), False, found, found)
        own[: n_own * b] = rows[: n_own * b]
        for side in range(2):
            child = children[n, side]
            if child >= 0:
                source, place = carried[carried_start[child] * b :], start[child]
                k = start[child + 1] - place - 1
                while k >= 0 and parent_row[place + k] >= n_own:
                    add_row(rows, parent_row[place + k], source, k, b)
                    k -= 1
        target = carried[carried_start[n] * b :]
        target[: n_boundary * b] = rows[n_own * b : width * b]


@compiled()
def _backward(
    nodes: tuple[int, int],
    order: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    boundary: np.ndarray,
    blocks: np.ndarray,
    block_start: np.ndarray,
    x: np.ndarray,
    largest: int,
    solution: np.ndarray,
) -> None:
    """The way down through a range of nodes: x, (V, b) flat, becomes D x + E x_boundary, the solution (b, V)."""
    b = len(solution)
    known, found = np.empty(largest * b), np.empty(largest * b)
    for n in range(nodes[1] - 1, nodes[0] - 1, -1):
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        own, width = x[first[n] * b :], n_own + n_boundary
        for k in range(n_boundary):
            to, place = np.uint64(k * b), np.uint64(boundary[start[n] + k]) * np.uint64(b)
            for c in range(np.uint64(b)):
                known[to + c] = x[place + c]
        elimination = (blocks, block_start[n] + n_own, 1, width)
        product((n_own, b, n_boundary), 1.0, elimination, (known, 0, b), True, (x, first[n] * b, b), (found, 0, b))
        own[: n_own * b] = found[: n_own * b]
        for i in range(n_own):
            place = np.uint64(order[first[n] + i])
            for c in range(np.uint64(b)):
                solution[c, place] = own[np.uint64(i * b) + c]


@compiled()
def _defects(
    values: np.ndarray, indptr: np.ndarray, indices: np.ndarray, eigenvalues: np.ndarray, vectors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(K,) lengths of A y − λ y and (K,) its products with y, for a csr matrix and vectors (V, K)."""
    n_vertices, n_vectors = vectors.shape
    defect, squares, products = np.empty(n_vectors), np.zeros(n_vectors), np.zeros(n_vectors)
    for i in range(n_vertices):
        for c in range(n_vectors):
            defect[c] = -eigenvalues[c] * vectors[i, c]
        for k in range(indptr[i], indptr[i + 1]):
            value, j = values[k], indices[k]
            for c in range(n_vectors):
                defect[c] += value * vectors[j, c]
        for c in range(n_vectors):
            squares[c] += defect[c] * defect[c]
            products[c] += defect[c] * vectors[i, c]
    return np.sqrt(squares), products


dissect, tree, arranged, eliminate = _dissect, _tree, _arranged, _eliminate
forward, backward, defects = _forward, _backward, _defects

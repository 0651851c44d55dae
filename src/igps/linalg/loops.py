"""The loops of `multifrontal`, compiled. Importing this module imports Numba: ask `igps.compiled.is_available` first.

Dense blocks go to the BLAS and LAPACK that SciPy brings, by the addresses of its functions, which the caller hands in:
an address is no constant, so that the compiled code may be kept on disk. The products are cut into tiles so small that
no BLAS starts threads for one of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from igps.compiled import compiled

# Multiplications in a product above which OpenBLAS thinks of threads: 2¹⁸
TILE, DEPTH = 64, 64
SOLVE_TILE = 128
NO, TRANSPOSED, LOWER = np.uint8(ord("N")), np.uint8(ord("T")), np.uint8(ord("L"))


def _intrinsic() -> Any:
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

    def fortran(context: Any, address: Any, arguments: Any) -> Any:
        """Call the subroutine at an address: numbers go by reference, integers as 32 bits, arrays as they lie."""

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            pointers = []
            for i, kind in enumerate(arguments.types):
                value = builder.extract_value(values[1], i)
                if isinstance(kind, types.Array):
                    pointers.append(context.make_array(kind)(context, builder, value).data)
                    continue
                if isinstance(kind, types.Integer) and kind != types.uint8:
                    value = context.cast(builder, value, kind, types.int32)
                pointers.append(cgutils.alloca_once_value(builder, value))
            function = ir.FunctionType(ir.VoidType(), [pointer.type for pointer in pointers])
            builder.call(builder.inttoptr(values[0], function.as_pointer()), pointers)
            return context.get_dummy_value()

        return types.void(address, arguments), generate

    return intrinsic(fortran)


fortran = _intrinsic()


@compiled()
def _dissect(orders: np.ndarray, indptr: np.ndarray, indices: np.ndarray, depth: int, window: float) -> np.ndarray:
    """The loops of `ordering.nested_dissection`, part by part; the vertices sorted by each coordinate are overwritten.

    A vertex carries the node of the part it is in, 2 · node + 1 or + 2 on the next level, until a separator takes it.
    """
    n_coordinates, n_vertices = orders.shape
    label = np.zeros(n_vertices, np.int64)
    node = np.full(n_vertices, -1, np.int64)
    rank, low, high = (np.empty(n_vertices, np.int32), np.empty(n_vertices, np.int32), np.empty(n_vertices, np.int32))
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
                    lowest = highest = np.int32(i)
                    for k in range(indptr[order[i]], indptr[order[i] + 1]):
                        j = indices[k]
                        if label[j] == here:
                            lowest, highest = min(lowest, rank[j]), max(highest, rank[j])
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
                        label[vertex] = -1
                for i in range(n_behind):
                    order[n_before + i] = behind[i]
                if c == 0:
                    for i in range(n_before + n_behind):
                        label[order[i]] = 2 * here + (1 if i < n_before else 2)
                    next_begin[2 * part], next_end[2 * part] = first, first + n_before
                    next_begin[2 * part + 1], next_end[2 * part + 1] = first + n_before, first + n_before + n_behind
        begin, end = next_begin, next_end
    for vertex in range(n_vertices):
        if node[vertex] < 0:
            node[vertex] = label[vertex]
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
def _product(
    gemm: int,
    transposed_b: np.uint8,
    shape: tuple[int, int, int],
    alpha: float,
    a: np.ndarray,
    lda: int,
    b: np.ndarray,
    ldb: int,
    beta: float,
    c: np.ndarray,
    ldc: int,
    tile: tuple[int, int, int],
) -> None:
    """C ← α A B + β C, or with Bᵀ, in Fortran's order, shape (m, n, k), in tiles no larger than so."""
    m, n, k = shape
    for j in range(0, n, tile[1]):
        for i in range(0, m, tile[0]):
            for p in range(0, k, tile[2]):
                fortran(
                    gemm,
                    (
                        NO,
                        transposed_b,
                        min(tile[0], m - i),
                        min(tile[1], n - j),
                        min(tile[2], k - p),
                        alpha,
                        a[i + p * lda :],
                        lda,
                        b[j + p * ldb :] if transposed_b == TRANSPOSED else b[p + j * ldb :],
                        ldb,
                        beta if p == 0 else 1.0,
                        c[i + j * ldc :],
                        ldc,
                    ),
                )


product = _product.dispatcher


@compiled()
def _invert(
    block: np.ndarray,
    n: int,
    ld: int,
    scratch: np.ndarray,
    work: np.ndarray,
    pivots: np.ndarray,
    lapack: np.ndarray,
) -> int:
    """Replace the upper triangle of a symmetric matrix by its whole inverse; its negative eigenvalues, -1 if singular.

    Fortran sees the transposed matrix, and so a lower triangle.
    """
    for i in range(n):
        scratch[i * n + i : (i + 1) * n] = block[i * ld + i : i * ld + n]
    info = np.zeros(1, np.int32)
    n_negative = 0
    fortran(lapack[1], (LOWER, n, block, ld, info))
    if info[0] == 0:
        fortran(lapack[2], (LOWER, n, block, ld, info))
    else:
        fortran(lapack[3], (LOWER, n, scratch, n, pivots, work, len(work), info))
        if info[0] != 0:
            return -1
        # a 1×1 pivot counts by its sign, a 2×2 one, marked by two negative indices, has one eigenvalue of either sign
        n_halves = 0
        for i in range(n):
            if pivots[i] < 0:
                n_halves += 1
            elif scratch[i * n + i] < 0:
                n_negative += 1
        n_negative += n_halves // 2
        for i in range(n):
            block[i * ld : i * ld + n] = 0.0
            block[i * ld + i] = 1.0
        fortran(lapack[4], (LOWER, n, n, scratch, n, pivots, block, ld, info))
        for i in range(n):
            for j in range(i + 1, n):
                block[i * ld + j] = (block[i * ld + j] + block[j * ld + i]) / 2
    for i in range(n):
        for j in range(i + 1, n):
            block[j * ld + i] = block[i * ld + j]
    return n_negative


invert = _invert.dispatcher


@compiled()
def _eliminate(
    nodes: tuple[int, int],
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
    scratch: np.ndarray,
    work: np.ndarray,
    pivots: np.ndarray,
    lapack: np.ndarray,
) -> int:
    """Eliminate a range of nodes with few own unknowns each; their negative pivots, -1 if one is singular."""
    n_negative = 0
    for n in range(nodes[0], nodes[1]):
        assemble(
            n, values, shift, indptr, indices, order, number, first, children, start, boundary, parent_row, updates,
            update_start, place, front,
        )  # fmt: skip
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        width = n_own + n_boundary
        block = blocks[block_start[n] :]
        for i in range(n_own):
            block[i * width + i : i * width + n_own] = front[i * width + i : i * width + n_own]
        if n_own:
            here = invert(block, n_own, width, scratch, work, pivots, lapack)
            if here < 0:
                return -1
            n_negative += here
        if n_boundary == 0:
            continue
        update = updates[update_start[n] :]
        for i in range(n_boundary):
            row = (n_own + i) * width + n_own
            update[i * n_boundary + i : (i + 1) * n_boundary] = front[row + i : row + n_boundary]
        if n_own:
            coupling, elimination = front[n_own:], block[n_own:]
            shape, tile = (n_boundary, n_own, n_own), (TILE, TILE, DEPTH)
            product(lapack[0], NO, shape, -1.0, coupling, width, block, width, 0.0, elimination, width, tile)
            for i in range(0, n_boundary, TILE):
                shape = (n_boundary - i, min(TILE, n_boundary - i), n_own)
                product(
                    lapack[0], TRANSPOSED, shape, 1.0, elimination[i:], width, coupling[i:], width, 1.0,
                    update[i * n_boundary + i :], n_boundary, tile,
                )  # fmt: skip
    return n_negative


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
    gemm: int,
) -> None:
    """The way up through a range of nodes: x, (V, b) flat, becomes D x; Eᵀ x is carried to the boundary's owners."""
    b = right.shape[1]
    rows = np.empty(largest * b)
    tile = (max(1, min(b, 16)), SOLVE_TILE, SOLVE_TILE)
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
        if n_own:
            # D is symmetric: one product with the transposed block gives D x and Eᵀ x
            shape = (b, width, n_own)
            product(gemm, TRANSPOSED, shape, 1.0, own, b, blocks[block_start[n] :], width, 0.0, rows, b, tile)
            own[: n_own * b] = rows[: n_own * b]
        else:
            rows[: width * b] = 0.0
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
    gemm: int,
    solution: np.ndarray,
) -> None:
    """The way down through a range of nodes: x, (V, b) flat, becomes D x + E x_boundary, the solution (b, V)."""
    b = len(solution)
    known = np.empty(largest * b)
    tile = (max(1, min(b, 16)), SOLVE_TILE, SOLVE_TILE)
    for n in range(nodes[1] - 1, nodes[0] - 1, -1):
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        own = x[first[n] * b :]
        if n_own and n_boundary:
            for k in range(n_boundary):
                to, place = np.uint64(k * b), np.uint64(boundary[start[n] + k]) * np.uint64(b)
                for c in range(np.uint64(b)):
                    known[to + c] = x[place + c]
            block = blocks[block_start[n] + n_own :]
            shape = (b, n_own, n_boundary)
            product(gemm, NO, shape, 1.0, known, b, block, n_own + n_boundary, 1.0, own, b, tile)
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

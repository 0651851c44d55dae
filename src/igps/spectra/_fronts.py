"""The compiled loops of `_multifrontal`: elimination of fronts, and the two ways through the tree of a solve."""

from __future__ import annotations

from typing import cast

import numpy as np

from igps._compiled import compiled
from igps.spectra._products import COLUMNS, ONE, ROWS, ZERO, product

# Unknowns that are eliminated at once inside of a pivot block
AT_ONCE = cast(int, np.int64(COLUMNS))
# What may be missing of an indefinite block times its inverse to the identity, in norm
MOST_MISSING = 3e-13


@compiled()
def assemble(
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


@compiled()
def invert_pivot(pivot: np.ndarray, size: int) -> int:
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


@compiled()
def invert(matrix: np.ndarray, n: int, width: int, rows: np.ndarray, columns: np.ndarray) -> int:
    """Replace a symmetric matrix (n, width) by its inverse; its negative pivots, -1 if one is 0 or not finite.

    Gauss and Jordan's elimination of AT_ONCE unknowns at a time, of which the width is a multiple. As the pivots are
    taken as they come, the inverse is accurate where the matrix is definite; elsewhere see `invert_front`.

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
        eliminated, times_inverse = (matrix, k * width, width), (rows, ZERO, width)
        product((size, width, size), 1.0, (pivot, ZERO, AT_ONCE, ONE), eliminated, False, times_inverse, times_inverse)
        for i in range(size):
            for j in range(size):
                rows[i * width + k + j] = pivot[i * AT_ONCE + j]
        for i in range(n):
            for j in range(size):
                columns[i * AT_ONCE + j] = matrix[i * width + k + j]
                matrix[i * width + k + j] = 0.0
        for begin, end in ((0, k), (k + size, n)):
            shape, rest = (end - begin, width, size), (matrix, begin * width, width)
            product(shape, -1.0, (columns, begin * AT_ONCE, ONE, AT_ONCE), times_inverse, True, rest, rest)
        for i in range(size * width):
            matrix[k * width + i] = rows[i]
    return n_negative


@compiled()
def load(matrix: np.ndarray, front: np.ndarray, n: int, front_width: int, width: int, backwards: bool) -> None:
    """Copy the symmetric matrix (n, width) of which a front has the upper triangle, with zeros behind it."""
    for i in range(n):
        for j in range(i, n):
            value = front[i * front_width + j]
            row, column = (n - 1 - i, n - 1 - j) if backwards else (i, j)
            matrix[row * width + column] = matrix[column * width + row] = value
        for j in range(n, width):
            matrix[i * width + j] = 0.0


@compiled()
def missing(matrix: np.ndarray, inverse: np.ndarray, n: int, width: int, room: np.ndarray) -> float:
    """The Frobenius norm of I − A X."""
    whole = (room, ZERO, width)
    for i in range(n * width):
        room[i] = 0.0
    for i in range(n):
        room[i * width + i] = 1.0
    product((n, width, n), -1.0, (matrix, ZERO, width, ONE), (inverse, ZERO, width), True, whole, whole)
    squares = 0.0
    for i in range(n * width):
        squares += room[i] ** 2
    return np.sqrt(squares)


@compiled()
def invert_front(
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

    A definite block is inverted accurately with its pivots in any order. An indefinite one may lose digits in one
    order, rarely in both; I − A X tells how many. Where it is small, the signs of the pivots are right as well: on the
    way from A to the matrix whose inverse X is, no eigenvalue passes zero.
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


@compiled()
def eliminate(
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
        product(shape, -1.0, (pivot, ZERO, ONE, padded), coupling, False, elimination, elimination)
        # of the complement the upper triangle, some rows at a time
        for i in range(0, n_boundary, ROWS):
            n_rows, begin = min(ROWS, n_boundary - i), max(0, min(i, n_boundary - COLUMNS))
            product(
                (n_rows, n_boundary - begin, n_own), 1.0, (front, n_own + i, width, ONE),
                (blocks, block_start[n] + n_own + begin, width), True,
                (front, (n_own + i) * width + n_own + begin, width),
                (updates, update_start[n] + i * n_boundary + begin, n_boundary),
            )  # fmt: skip
    return n_negative, nodes[1]


@compiled()
def add_row(into: np.ndarray, at: int, source: np.ndarray, of: int, b: int) -> None:
    """Add row ``of`` of one flat array to row ``at`` of another, rows of b numbers each."""
    # An unsigned index is one that need not be counted from the end.
    begin, origin = np.uint64(at * b), np.uint64(of * b)
    for c in range(np.uint64(b)):
        into[begin + c] += source[origin + c]


@compiled()
def forward(
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
    """The way up through a range of nodes: x, (V, b) flat, becomes D x; Eᵀ x is carried to the boundary's owners.

    The right-hand sides are (b, V).
    """
    b = len(right)
    rows = np.empty(largest * b)
    for n in range(nodes[0], nodes[1]):
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        width, own = n_own + n_boundary, x[first[n] * b :]
        for i in range(n_own):
            place = np.uint64(order[first[n] + i])
            for c in range(np.uint64(b)):
                own[np.uint64(i * b) + c] = right[c, place]
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
        block, found = (blocks, block_start[n], width, ONE), (rows, ZERO, b)
        product((width, b, n_own), 1.0, block, (x, first[n] * b, b), False, found, found)
        for i in range(n_own * b):
            own[i] = rows[i]
        for side in range(2):
            child = children[n, side]
            if child >= 0:
                source, place = carried[carried_start[child] * b :], start[child]
                k = start[child + 1] - place - 1
                while k >= 0 and parent_row[place + k] >= n_own:
                    add_row(rows, parent_row[place + k], source, k, b)
                    k -= 1
        target = carried[carried_start[n] * b :]
        for i in range(n_boundary * b):
            target[i] = rows[n_own * b + i]


@compiled()
def backward(
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
        elimination = (blocks, block_start[n] + n_own, ONE, width)
        product(
            (n_own, b, n_boundary), 1.0, elimination, (known, ZERO, b), True, (x, first[n] * b, b), (found, ZERO, b)
        )
        for i in range(n_own * b):
            own[i] = found[i]
        for i in range(n_own):
            place = np.uint64(order[first[n] + i])
            for c in range(np.uint64(b)):
                solution[c, place] = own[np.uint64(i * b) + c]

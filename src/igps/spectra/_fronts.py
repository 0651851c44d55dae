"""The compiled loops of `_multifrontal`: elimination of fronts, and the two ways through the tree of a solve."""

from typing import Any

import numpy as np

from igps._arrays import Floats
from igps._compiled import compiled
from igps.spectra._pivots import AT_ONCE, Scratch, invert_front
from igps.spectra._products import COLUMNS, ONE, ROWS, ZERO, product
from igps.spectra._tree import Nodes, Structure


@compiled(inline="always")
def assemble(n: int, tree: Structure, values: Floats, shift: float, updates: Floats, scratch: Scratch) -> None:
    """Write the upper triangle of a node's front, (S + B, S + B): of the matrix, and its children's complements."""
    first, start, place, front = tree.first, tree.start, scratch.place, scratch.front
    begin, stop = first[n], first[n + 1]
    n_own = stop - begin
    width = n_own + start[n + 1] - start[n]
    for k in range(start[n], start[n + 1]):
        place[tree.boundary[k]] = n_own + k - start[n]
    for i in range(width):
        front[i * width + i : (i + 1) * width] = 0.0
    for i in range(n_own):
        vertex = tree.order[begin + i]
        for k in range(tree.indptr[vertex], tree.indptr[vertex + 1]):
            j = tree.number[tree.indices[k]]
            if j >= begin + i:
                front[i * width + (j - begin if j < stop else place[j])] += values[k]
        front[i * width + i] -= shift
    for side in range(2):
        child = tree.children[n, side]
        if child < 0:
            continue
        base, size = start[child], start[child + 1] - start[child]
        for i in range(size):
            row = tree.parent_row[base + i] * width
            source = tree.update_start[child] + i * size
            for j in range(i, size):
                front[row + tree.parent_row[base + j]] += updates[source + j]


@compiled()
def eliminate(
    nodes: Nodes,
    largest: int,
    tree: Structure,
    values: Floats,
    shift: float,
    updates: Floats,
    blocks: Floats,
    scratch: Scratch,
) -> tuple[int, int]:
    """Eliminate the nodes of a range one after another; their negative pivots, and the node at which it stops.

    Before the end of the range it stops at a node, whose front is assembled, that has more than ``largest`` own
    unknowns, or whose pivots must be taken in another order.
    """
    n_negative = 0
    first, start, front, pivot = tree.first, tree.start, scratch.front, scratch.pivot
    for n in range(nodes[0], nodes[1]):
        assemble(n, tree, values, shift, updates, scratch)
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        width = n_own + n_boundary
        if n_own > largest:
            return n_negative, n
        padded = -(-n_own // AT_ONCE) * AT_ONCE
        negative = invert_front(scratch, n_own, width, padded)
        if negative < 0:
            return n_negative, n
        n_negative += negative
        begin, at = tree.block_start[n], tree.update_start[n]
        for i in range(n_own):
            for j in range(n_own):
                blocks[begin + i * width + j] = pivot[j * padded + i]
        if n_boundary == 0:
            continue
        coupling, elimination = (front, n_own, width), (blocks, begin + n_own, width)
        shape = (n_own, n_boundary, n_own)
        product(shape, -1.0, (pivot, ZERO, ONE, padded), coupling, False, elimination, elimination)
        # of the complement the upper triangle, some rows at a time
        for i in range(0, n_boundary, ROWS):
            n_rows, left = min(ROWS, n_boundary - i), max(0, min(i, n_boundary - COLUMNS))
            product(
                (n_rows, n_boundary - left, n_own), 1.0, (front, n_own + i, width, ONE),
                (blocks, begin + n_own + left, width), True, (front, (n_own + i) * width + n_own + left, width),
                (updates, at + i * n_boundary + left, n_boundary),
            )  # fmt: skip
    return n_negative, nodes[1]


@compiled()
def add_row(into: Floats, at: int, source: Floats, of: Any, b: int) -> None:
    """Add row ``of`` of one flat array to row ``at`` of another, rows of b numbers each."""
    # An unsigned index is one that need not be counted from the end.
    begin, origin = np.uint64(at * b), np.uint64(of * b)
    for c in range(np.uint64(b)):
        into[begin + c] += source[origin + c]


@compiled()
def forward(
    nodes: Nodes, right: Floats, tree: Structure, blocks: Floats, x: Floats, carried: Floats, largest: int
) -> None:
    """The way up through a range of nodes: x, (V, b) flat, becomes D x; Eᵀ x is carried to the boundary's owners.

    The right-hand sides are (b, V).
    """
    b = len(right)
    order, first, children, start, parent_row = tree.order, tree.first, tree.children, tree.start, tree.parent_row
    carried_start = tree.carried_start
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
                k = np.int64(0)  # a plain 0 would make a function of its own of `add_row`
                while k < start[child + 1] - place and parent_row[place + k] < n_own:
                    add_row(own, parent_row[place + k], source, k, b)
                    k += 1
        # D is symmetric: one product with the transposed block gives D x and Eᵀ x
        block, found = (blocks, tree.block_start[n], width, ONE), (rows, ZERO, b)
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
def backward(nodes: Nodes, tree: Structure, blocks: Floats, x: Floats, largest: int, solution: Floats) -> None:
    """The way down through a range of nodes: x, (V, b) flat, becomes D x + E x_boundary, the solution (b, V)."""
    b = len(solution)
    order, first, start, boundary = tree.order, tree.first, tree.start, tree.boundary
    known, found = np.empty(largest * b), np.empty(largest * b)
    for n in range(nodes[1] - 1, nodes[0] - 1, -1):
        n_own, n_boundary = first[n + 1] - first[n], start[n + 1] - start[n]
        own, width = x[first[n] * b :], n_own + n_boundary
        for k in range(n_boundary):
            to, place = np.uint64(k * b), np.uint64(boundary[start[n] + k]) * np.uint64(b)
            for c in range(np.uint64(b)):
                known[to + c] = x[place + c]
        elimination = (blocks, tree.block_start[n] + n_own, ONE, width)
        product(
            (n_own, b, n_boundary), 1.0, elimination, (known, ZERO, b), True, (x, first[n] * b, b), (found, ZERO, b)
        )
        for i in range(n_own * b):
            own[i] = found[i]
        for i in range(n_own):
            place = np.uint64(order[first[n] + i])
            for c in range(np.uint64(b)):
                solution[c, place] = own[np.uint64(i * b) + c]

"""Compiled loops of `multifrontal`: elimination of fronts, and the forward and backward pass of a solve."""

from typing import Any

import numpy as np

from igps._arrays import Floats
from igps._compiled import compiled
from igps.spectra._pivots import STEP, Scratch, invert_front
from igps.spectra._products import COLUMNS, ONE, ROWS, ZERO, product
from igps.spectra.tree import BLOCK, BOUNDARY, CARRIED, LEFT, OWN, UPDATE, Nodes, Structure


@compiled(inline="always")
def assemble(
    node: int, tree: Structure, values: Floats, shift: float, updates: Floats, scratch: Scratch
) -> None:
    """Write the upper triangle of a node's front (S + B, S + B), including the Schur complements of its children."""
    own_start = tree.nodes[OWN]
    boundary_start = tree.nodes[BOUNDARY]
    boundary_row = scratch.boundary_row
    front = scratch.front
    own_begin = own_start[node]
    own_end = own_start[node + 1]
    n_own = own_end - own_begin
    width = n_own + boundary_start[node + 1] - boundary_start[node]
    for k in range(boundary_start[node], boundary_start[node + 1]):
        boundary_row[tree.boundary[k]] = n_own + k - boundary_start[node]
    for i in range(width):
        for j in range(i * width + i, (i + 1) * width):
            front[j] = 0.0
    for i in range(n_own):
        vertex = tree.order[own_begin + i]
        for k in range(tree.indptr[vertex], tree.indptr[vertex + 1]):
            j = tree.position[tree.indices[k]]
            if j >= own_begin + i:
                front[i * width + (j - own_begin if j < own_end else boundary_row[j])] += values[k]
        front[i * width + i] -= shift
    for side in range(2):
        child = tree.nodes[LEFT + side, node]
        if child < 0:
            continue
        base = boundary_start[child]
        size = boundary_start[child + 1] - boundary_start[child]
        for i in range(size):
            row = tree.parent_row[base + i] * width
            source = tree.nodes[UPDATE, child] + i * size
            for j in range(i, size):
                front[row + tree.parent_row[base + j]] += updates[source + j]


@compiled()
def eliminate(
    nodes: Nodes,
    max_own: int,
    tree: Structure,
    values: Floats,
    shift: float,
    updates: Floats,
    blocks: Floats,
    scratch: Scratch,
) -> tuple[int, int]:
    """Eliminate a range of nodes; return the number of negative pivots, and the node where the elimination stopped.

    It stops before the end of the range at a node with more than ``max_own`` own unknowns, or whose pivots lose
    too many digits in their order. The front of that node is assembled.
    """
    n_negative = 0
    own_start = tree.nodes[OWN]
    boundary_start = tree.nodes[BOUNDARY]
    front = scratch.front
    inverse = scratch.inverse
    for node in range(nodes[0], nodes[1]):
        assemble(node, tree, values, shift, updates, scratch)
        n_own = own_start[node + 1] - own_start[node]
        n_boundary = boundary_start[node + 1] - boundary_start[node]
        width = n_own + n_boundary
        if n_own > max_own:
            return n_negative, node
        padded = -(-n_own // STEP) * STEP
        n_new = invert_front(scratch, n_own, width, padded)
        if n_new < 0:
            return n_negative, node
        n_negative += n_new
        begin = tree.nodes[BLOCK, node]
        update_begin = tree.nodes[UPDATE, node]
        for i in range(n_own):
            for j in range(n_own):
                blocks[begin + i * width + j] = inverse[j * padded + i]
        if n_boundary == 0:
            continue
        coupling = (front, n_own, width)
        elimination = (blocks, begin + n_own, width)
        shape = (n_own, n_boundary, n_own)
        product(shape, -1.0, (inverse, ZERO, ONE, padded), coupling, ZERO, elimination, elimination)
        # Compute the upper triangle of the Schur complement, a few rows at a time.
        for i in range(0, n_boundary, ROWS):
            n_rows = min(ROWS, n_boundary - i)
            skipped = max(0, min(i, n_boundary - COLUMNS))
            product(
                (n_rows, n_boundary - skipped, n_own),
                1.0,
                (front, n_own + i, width, ONE),
                (blocks, begin + n_own + skipped, width),
                ONE,
                (front, (n_own + i) * width + n_own + skipped, width),
                (updates, update_begin + i * n_boundary + skipped, n_boundary),
            )
    return n_negative, nodes[1]


@compiled()
def add_row(target: Floats, target_row: int, source: Floats, source_row: Any, b: int) -> None:
    """Add a row of one flat array to a row of another; both have rows of b numbers."""
    # Unsigned indices spare Numba the check for negative ones.
    first = np.uint64(target_row * b)
    source_first = np.uint64(source_row * b)
    for c in range(np.uint64(b)):
        target[first + c] += source[source_first + c]


@compiled()
def forward(
    nodes: Nodes,
    right: Floats,
    tree: Structure,
    blocks: Floats,
    x: Floats,
    carried: Floats,
    rows: Floats,
) -> None:
    """Pass upwards through a range of nodes: x, (V, b) flat, becomes D x, and Eᵀ x is carried to the boundary's owners.

    The right-hand sides are (b, V). The rows are scratch space of b numbers for each row of the largest front.
    """
    b = len(right)
    order = tree.order
    own_start = tree.nodes[OWN]
    boundary_start = tree.nodes[BOUNDARY]
    parent_row = tree.parent_row
    carried_start = tree.nodes[CARRIED]
    for node in range(nodes[0], nodes[1]):
        n_own = own_start[node + 1] - own_start[node]
        n_boundary = boundary_start[node + 1] - boundary_start[node]
        width = n_own + n_boundary
        own_x = x[own_start[node] * b :]
        for i in range(n_own):
            vertex = np.uint64(order[own_start[node] + i])
            for c in range(np.uint64(b)):
                own_x[np.uint64(i * b) + c] = right[c, vertex]
        # Contributions of the children: to own unknowns before the product, to boundary rows after it.
        for side in range(2):
            child = tree.nodes[LEFT + side, node]
            if child >= 0:
                source = carried[carried_start[child] * b :]
                base = boundary_start[child]
                # A plain 0 has another type, for which Numba would compile `add_row` again
                k = np.int64(0)
                while k < boundary_start[child + 1] - base and parent_row[base + k] < n_own:
                    add_row(own_x, parent_row[base + k], source, k, b)
                    k += 1
        # D is symmetric: one product with the transposed block gives both D x and Eᵀ x.
        block = (blocks, tree.nodes[BLOCK, node], width, ONE)
        product_rows = (rows, ZERO, b)
        product(
            (width, b, n_own),
            1.0,
            block,
            (x, own_start[node] * b, b),
            ZERO,
            product_rows,
            product_rows,
        )
        for i in range(n_own * b):
            own_x[i] = rows[i]
        for side in range(2):
            child = tree.nodes[LEFT + side, node]
            if child >= 0:
                source = carried[carried_start[child] * b :]
                base = boundary_start[child]
                k = boundary_start[child + 1] - base - 1
                while k >= 0 and parent_row[base + k] >= n_own:
                    add_row(rows, parent_row[base + k], source, k, b)
                    k -= 1
        target = carried[carried_start[node] * b :]
        for i in range(n_boundary * b):
            target[i] = rows[n_own * b + i]


@compiled()
def backward(
    nodes: Nodes,
    tree: Structure,
    blocks: Floats,
    x: Floats,
    rows: Floats,
    boundary_x: Floats,
    solution: Floats,
) -> None:
    """Pass downwards through a range of nodes: x, (V, b) flat, becomes D x + E x_boundary, the solution (b, V).

    The rows and boundary_x are scratch space, as the rows of `forward`.
    """
    b = len(solution)
    order = tree.order
    own_start = tree.nodes[OWN]
    boundary_start = tree.nodes[BOUNDARY]
    boundary = tree.boundary
    for node in range(nodes[1] - 1, nodes[0] - 1, -1):
        n_own = own_start[node + 1] - own_start[node]
        n_boundary = boundary_start[node + 1] - boundary_start[node]
        own_x = x[own_start[node] * b :]
        width = n_own + n_boundary
        for k in range(n_boundary):
            row = np.uint64(k * b)
            source = np.uint64(boundary[boundary_start[node] + k]) * np.uint64(b)
            for c in range(np.uint64(b)):
                boundary_x[row + c] = x[source + c]
        elimination = (blocks, tree.nodes[BLOCK, node] + n_own, ONE, width)
        shape = (n_own, b, n_boundary)
        product_rows = (rows, ZERO, b)
        product(
            shape,
            1.0,
            elimination,
            (boundary_x, ZERO, b),
            ONE,
            (x, own_start[node] * b, b),
            product_rows,
        )
        for i in range(n_own * b):
            own_x[i] = rows[i]
        for i in range(n_own):
            vertex = np.uint64(order[own_start[node] + i])
            for c in range(np.uint64(b)):
                solution[c, vertex] = own_x[np.uint64(i * b) + c]

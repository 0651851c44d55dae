"""Compiled loops that invert the pivot blocks of `_fronts`."""

from typing import NamedTuple, cast

import numpy as np

from igps._compiled import compiled
from igps.spectra._products import COLUMNS, ONE, ZERO, product


class Scratch(NamedTuple):
    """Flat work arrays."""

    boundary_row: np.ndarray  # row in the front of each position on the boundary
    front: np.ndarray
    inverse: np.ndarray  # of the front's pivot block
    pivot_copy: np.ndarray  # as large as `inverse`
    residual: np.ndarray  # as large as `inverse`
    rows: np.ndarray  # see `invert`
    columns: np.ndarray  # see `invert`


# Number of unknowns of a pivot block that are eliminated together.
STEP = cast(int, np.int64(COLUMNS))
# Largest Frobenius norm of I − A X for an indefinite block A and its computed inverse X.
MAX_RESIDUAL = 3e-13


@compiled(inline="always")
def invert_pivot(pivot: np.ndarray, size: int) -> int:
    """Replace a block, with rows of STEP numbers, by its inverse; return its number of negative pivots.

    Return -1 if a pivot is 0 or not finite. The entries after ``size`` in a row must be finite.
    """
    n_negative = 0
    for q in range(np.uint64(size)):
        row = q * np.uint64(STEP)
        value = pivot[row + q]
        if not 0.0 < abs(value) < np.inf:
            return -1
        n_negative += value < 0
        pivot[row + q] = 1.0
        for j in range(np.uint64(STEP)):
            pivot[row + j] *= 1.0 / value
        for i in range(np.uint64(size)):
            if i != q:
                other = i * np.uint64(STEP)
                factor = pivot[other + q]
                pivot[other + q] = 0.0
                for j in range(np.uint64(STEP)):
                    pivot[other + j] -= factor * pivot[row + j]
    return n_negative


@compiled(inline="always")
def invert(matrix: np.ndarray, n: int, width: int, rows: np.ndarray, columns: np.ndarray) -> int:
    """Replace a symmetric matrix (n, width) by its inverse; return its number of negative pivots, or -1 on failure.

    This is Gauss–Jordan elimination of STEP unknowns at a time; the width is a multiple of STEP. Pivots are taken in
    their order, so the inverse is accurate for a definite matrix; for others see `invert_front`. The entries after n in
    a row must be 0. The work arrays are rows (STEP · width,) and columns ((n + STEP) · STEP,).
    """
    n_negative = 0
    pivot = columns[n * STEP :]
    for k in range(0, n, STEP):
        size = min(STEP, n - k)
        for i in range(size):
            for j in range(STEP):
                pivot[i * STEP + j] = matrix[(k + i) * width + k + j]
        negative = invert_pivot(pivot, size)
        if negative < 0:
            return -1
        n_negative += negative
        # Multiply the eliminated rows by the inverse of their pivot block.
        eliminated = (matrix, k * width, width)
        scaled = (rows, ZERO, width)
        product(
            (size, width, size), 1.0, (pivot, ZERO, STEP, ONE), eliminated, ZERO, scaled, scaled
        )
        for i in range(size):
            for j in range(size):
                rows[i * width + k + j] = pivot[i * STEP + j]
        for i in range(n):
            for j in range(size):
                columns[i * STEP + j] = matrix[i * width + k + j]
                matrix[i * width + k + j] = 0.0
        for begin, end in ((0, k), (k + size, n)):
            shape = (end - begin, width, size)
            others = (matrix, begin * width, width)
            product(shape, -1.0, (columns, begin * STEP, ONE, STEP), scaled, ONE, others, others)
        for i in range(size * width):
            matrix[k * width + i] = rows[i]
    return n_negative


@compiled()
def load(matrix: np.ndarray, front: np.ndarray, n: int, front_width: int, width: int) -> None:
    """Copy a symmetric matrix (n, width) from the upper triangle of a front, and pad its rows with zeros."""
    for i in range(n):
        for j in range(i, n):
            value = front[i * front_width + j]
            matrix[i * width + j] = matrix[j * width + i] = value
        for j in range(n, width):
            matrix[i * width + j] = 0.0


@compiled(inline="always")
def residual_norm(
    matrix: np.ndarray, inverse: np.ndarray, n: int, width: int, scratch: np.ndarray
) -> float:
    """Return the Frobenius norm of I − A X for a matrix A and its computed inverse X."""
    residual = (scratch, ZERO, width)
    for i in range(n * width):
        scratch[i] = 0.0
    for i in range(n):
        scratch[i * width + i] = 1.0
    product(
        (n, width, n),
        -1.0,
        (matrix, ZERO, width, ONE),
        (inverse, ZERO, width),
        ONE,
        residual,
        residual,
    )
    squares = 0.0
    for i in range(n * width):
        squares += scratch[i] ** 2
    return np.sqrt(squares)


@compiled(inline="always")
def invert_front(scratch: Scratch, n: int, front_width: int, width: int) -> int:
    """Write the inverse (n, width) of a front's pivot block to `scratch`; return the number of its negative pivots.

    Return -1 on failure. A definite block is inverted accurately with its pivots in any order. An indefinite block may
    lose digits; the norm of I − A X measures the loss. If it is small, the signs of the pivots are right, too: no
    eigenvalue crosses zero between A and the matrix whose inverse is X.
    """
    inverse = scratch.inverse
    load(inverse, scratch.front, n, front_width, width)
    n_negative = invert(inverse, n, width, scratch.rows, scratch.columns)
    if n_negative > 0:
        load(scratch.pivot_copy, scratch.front, n, front_width, width)
        residual = residual_norm(scratch.pivot_copy, inverse, n, width, scratch.residual)
        if not residual <= MAX_RESIDUAL:
            return -1
    return n_negative

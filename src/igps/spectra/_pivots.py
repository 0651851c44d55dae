"""The compiled loops that invert the pivot blocks of `_fronts`."""

from typing import NamedTuple, cast

import numpy as np

from igps._compiled import compiled
from igps.spectra._products import COLUMNS, ONE, ZERO, product


class Scratch(NamedTuple):
    """Flat arrays to compute in."""

    place: np.ndarray  # the rows of a boundary in a front
    front: np.ndarray
    pivot: np.ndarray  # the inverse of a front's pivot block
    copy: np.ndarray  # of as many entries as that, as the next
    squares: np.ndarray
    rows: np.ndarray  # see `invert`
    columns: np.ndarray


# Unknowns that are eliminated at once inside of a pivot block
AT_ONCE = cast(int, np.int64(COLUMNS))
# What may be missing of an indefinite block times its inverse to the identity, in norm
MOST_MISSING = 3e-13


@compiled(inline="always")
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


@compiled(inline="always")
def invert(matrix: np.ndarray, n: int, width: int, rows: np.ndarray, columns: np.ndarray) -> int:
    """Replace a symmetric matrix (n, width) by its inverse; its negative pivots, -1 if one is 0 or not finite.

    Gauss and Jordan's elimination of AT_ONCE unknowns at a time, of which the width is a multiple. As the pivots are
    taken as they come, the inverse is accurate where the matrix is definite; elsewhere see `invert_front`. What is
    behind n in a row must be 0; rows (AT_ONCE · width,) and columns ((n + AT_ONCE) · AT_ONCE,) are to compute in.
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


@compiled(inline="always")
def missing(matrix: np.ndarray, inverse: np.ndarray, n: int, width: int, scratch: np.ndarray) -> float:
    """The Frobenius norm of I − A X."""
    whole = (scratch, ZERO, width)
    for i in range(n * width):
        scratch[i] = 0.0
    for i in range(n):
        scratch[i * width + i] = 1.0
    product((n, width, n), -1.0, (matrix, ZERO, width, ONE), (inverse, ZERO, width), True, whole, whole)
    squares = 0.0
    for i in range(n * width):
        squares += scratch[i] ** 2
    return np.sqrt(squares)


@compiled(inline="always")
def invert_front(scratch: Scratch, n: int, front_width: int, width: int) -> int:
    """Write the inverse (n, width) of a front's pivot block; the negative eigenvalues of that, -1 if it cannot tell.

    A definite block is inverted accurately with its pivots in any order. An indefinite one may lose digits in one
    order, rarely in both; I − A X tells how many. Where it is small, the signs of the pivots are right as well: on the
    way from A to the matrix whose inverse X is, no eigenvalue passes zero.
    """
    inverse = scratch.pivot
    for backwards in (False, True):
        load(inverse, scratch.front, n, front_width, width, backwards)
        n_negative = invert(inverse, n, width, scratch.rows, scratch.columns)
        if n_negative > 0:
            load(scratch.copy, scratch.front, n, front_width, width, backwards)
            if not missing(scratch.copy, inverse, n, width, scratch.squares) <= MOST_MISSING:
                continue
        if n_negative >= 0:
            if backwards:
                for i in range(n // 2 + n % 2):
                    for j in range(n if i < n // 2 else n // 2):
                        here, there = i * width + j, (n - 1 - i) * width + n - 1 - j
                        inverse[here], inverse[there] = inverse[there], inverse[here]
            return n_negative
    return -1

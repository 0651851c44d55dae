"""Loops that Numba compiles for `far_field` and `closed_forms`: the weights of hats far from points and near them."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from igps._compiled import compiled

Real = TypeVar("Real", np.float32, np.float64)


@compiled(error_model="numpy", fastmath={"contract"})
def fill_hat_weights(polynomials: NDArray[Real], monomials: NDArray[Real], weights: NDArray[Real]) -> None:
    """Fill weights (h, n) from the polynomials (h, 4, 10) of h hats and the monomials (10, n) of n points.

    With r², L, S and T the polynomials in the order of `HatMoments.polynomials`: ((T L/r² + S)/r² + L)/r⁴.
    """
    for hat in range(len(weights)):
        p = polynomials[hat]
        for point in range(weights.shape[1]):
            squared, linear, second, third = p[0, 0], p[1, 0], p[2, 0], p[3, 0]
            for k in range(1, 10):
                monomial = monomials[k, point]
                squared += p[0, k] * monomial
                linear += p[1, k] * monomial
                second += p[2, k] * monomial
                third += p[3, k] * monomial
            inverse = 1 / squared
            weights[hat, point] = ((third * inverse * linear + second) * inverse + linear) * (inverse * inverse)


@compiled(error_model="numpy")
def replace_weights(
    points: NDArray[np.float64],
    near: NDArray[np.int64],
    rows: NDArray[np.int64],
    faces: NDArray[np.int64],
    table: NDArray[np.float64],
    first: NDArray[np.int64],
    around: NDArray[np.int64],
    on_surface: float,
    weights: NDArray[Real],
) -> None:
    """`ListedRule.replace` of points (n, 3), with the fields of the rule, and the distance below which one is on it."""
    is_near = np.zeros(weights.shape, dtype=np.bool_)
    for pair in range(near.shape[1]):
        row, point = rows[near[0, pair]], near[1, pair]
        is_near[row, point] = True
        weights[row, point] = 0
    touched = np.full(len(points), -1)
    shares = np.empty((len(points), 3))
    of_face = np.empty((3, 3))
    for pair in range(near.shape[1]):
        hat, point = near[0, pair], near[1, pair]
        for place in range(first[hat], first[hat + 1]):
            face = around[place]
            corners = faces[face]
            counted = False
            for i in range(3):
                # A face counts once: with its first near corner.
                counted |= corners[i] < hat and is_near[rows[corners[i]], point]
            if counted:
                continue
            if _weigh_face(table[face], points[point], on_surface, of_face) and touched[point] < 0:
                touched[point] = face
                shares[point] = of_face[1]
            for i in range(3):
                row = rows[corners[i]]
                if is_near[row, point]:
                    weights[row, point] += of_face[0, i]
    for point in range(len(points)):
        if touched[point] >= 0:
            weights[:, point] = 0
            for i in range(3):
                weights[rows[faces[touched[point], i]], point] = shares[point, i]


@compiled(error_model="numpy")
def _weigh_face(
    row: NDArray[np.float64], point: NDArray[np.float64], on_surface: float, found: NDArray[np.float64]
) -> bool:
    """`ListedRule.weights` of one row of the table and one point: whether it is on the face.

    What is found (3, 3) are weights, barycentric coordinates and, for this function alone, angles over lengths.
    """
    a0, a1, a2 = row[0] - point[0], row[1] - point[1], row[2] - point[2]
    b0, b1, b2 = row[3] - point[0], row[4] - point[1], row[5] - point[2]
    c0, c1, c2 = row[6] - point[0], row[7] - point[1], row[8] - point[2]
    height = row[9] * a0 + row[10] * a1 + row[11] * a2
    area_0 = -(row[12] * b0 + row[13] * b1 + row[14] * b2)
    area_1 = -(row[15] * c0 + row[16] * c1 + row[17] * c2)
    areas = (area_0, area_1, row[21] - area_0 - area_1)
    cosines = (b0 * c0 + b1 * c1 + b2 * c2, c0 * a0 + c1 * a1 + c2 * a2, a0 * b0 + a1 * b1 + a2 * b2)
    sides = (row[18], row[19], row[20])
    half = (sides[0] + sides[1] + sides[2]) / 2
    total, whole, on_face = 0.0, 0.0, abs(height) <= on_surface
    for i in range(3):
        length = max(math.sqrt(areas[i] * areas[i] + sides[i] * height * height), 1e-150)
        found[2, i] = math.atan2(length, cosines[i]) / length
        total += found[2, i] * areas[i]
        on_face &= areas[i] >= -on_surface * math.sqrt(sides[i])
        whole += max(areas[i], 0.0)
    outside = abs(height) < on_surface and total < 1e-2
    for i in range(3):
        left, right = (i + 2) % 3, (i + 1) % 3
        second = found[2, left] * (sides[right] - half) + found[2, right] * (sides[left] - half)
        flat = 0.0 if outside else total / height * areas[i]
        found[0, i] = ((found[2, i] * sides[i] + second) * height + flat) / (2 * row[21])
        found[1, i] = max(areas[i], 0.0) / whole
    return on_face

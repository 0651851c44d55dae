"""Loops that Numba compiles for `igps.geometry.far_field`: the weights of hats far from points."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from igps.compiled import compiled

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

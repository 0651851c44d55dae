"""Block Lanczos iteration with a shift inside the wanted part of the spectrum; see `eigensolver`."""

import logging
import math
from collections.abc import Callable
from functools import partial
from operator import call
from typing import Any

import numpy as np
import torch
from scipy import sparse

from igps._threads import Team
from igps.spectra._checks import ROUNDING
from igps.spectra._krylov import Krylov
from igps.spectra.multifrontal import Factors, Tree, analyse

logger = logging.getLogger(__name__)

# Share of the wanted eigenvalues below the shift, at which both ends of the spectrum converge at the same time.
SHIFT_RANK = 0.55
# Number of vectors in a block. Small blocks make a small basis, large ones fast products. Small ones are better for few
# eigenpairs, and for results with very many numbers, where the basis takes gigabytes.
SMALL_BLOCK = 8
LARGE_BLOCK = 12
MAX_SMALL_BLOCK_PAIRS = 128
MAX_LARGE_BLOCK_RESULT = 2**27
# Basis size at which usually all pairs have converged, as measured on bodies of 11,000 vertices: vectors per eigenpair,
# plus a number of blocks, which grows with the decades of the number of eigenpairs and with the digits of the tolerance
# beyond seven.
BASIS_PER_EIGENPAIR = 1.35
BASIS_BLOCKS, BASIS_BLOCKS_PER_DECADE, BASIS_BLOCKS_PER_DIGIT = 2.4, 4.8, 1.0
# The iteration stops at this multiple of the vectors per eigenpair, plus a constant.
MAX_BASIS_FACTOR, MAX_BASIS_EXTRA = 3, 600
# Smallest result, in numbers, for which a second thread pays.
MIN_TEAM_RESULT = 2**21
# Largest error of the factorization, relative to the tolerance: the lowest modes magnify it some 1000 times.
MAX_DEFECT = 2e-4
# Gaps, relative to the eigenvalue: the first above WIDE_GAP is used, or else the widest above MIN_GAP. A multiplet has
# none.
WIDE_GAP, MIN_GAP = 1e-4, 1e-7


class ConvergenceError(RuntimeError):
    """The eigenpairs could not be computed to the tolerance, or could not be proved complete."""


def lanczos(
    matrix: sparse.csr_array,
    zero_mode: np.ndarray,
    n_eigenpairs: int,
    positions: np.ndarray | None,
    tolerance: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues (K,) and orthonormal eigenvectors (V, K) of a matrix with one zero mode (V,), of length 1."""
    # Solves are faster if vectors are stored in elimination order.
    tree, matrix, order = analyse(matrix, positions).arranged(matrix)
    zero_mode = zero_mode[order]
    result_size = n_eigenpairs * len(zero_mode)
    block_size = LARGE_BLOCK
    if n_eigenpairs <= MAX_SMALL_BLOCK_PAIRS or result_size > MAX_LARGE_BLOCK_RESULT:
        block_size = SMALL_BLOCK
    first_size, max_size = _basis_sizes(n_eigenpairs, block_size, tolerance)
    max_size = min(max_size, len(zero_mode) - 2 * block_size)
    generator = np.random.default_rng(seed)
    max_threads = None if result_size >= MIN_TEAM_RESULT else 1
    with Team(max_threads) as team:
        shift, factors = _factorize_inside(tree, matrix, zero_mode, n_eigenpairs, tolerance, team)
        n_below = factors.n_negative - 1  # without the zero mode
        capacity = first_size + 3 * block_size
        krylov = Krylov(factors, zero_mode, block_size, capacity, generator, team)
        while krylov.size < first_size:
            krylov.expand()
        while True:
            ritz = krylov.ritz_pairs(shift)
            converged = ritz.leading(n_below, tolerance)
            gap = gap_after(ritz.eigenvalues[converged], n_eigenpairs)
            if gap is not None:
                n_found, bound = gap
                wanted = converged[:n_eigenpairs]
                count = partial(tree.inertia, matrix, bound, team)
                if krylov.overwrites_basis:
                    # Count first: if some are missing, the basis is still needed.
                    vectors = None
                    n_negative = count()
                else:
                    # Count and compute the vectors in parallel.
                    vectors, fill_steps = krylov.eigenvectors(ritz, wanted, order)
                    steps: list[Callable[[], Any]] = [count, *fill_steps]
                    n_negative = team.each(call, steps)[0]
                n_present = n_negative - 1
                if n_present == n_found:
                    if vectors is None:
                        vectors = krylov.eigenvectors_in_place(ritz, wanted, order)
                    return ritz.eigenvalues[wanted].numpy(), vectors
                if n_present < n_found:
                    raise ConvergenceError(
                        f"found {n_found} instead of {n_present} eigenvalues below {bound:.6g} / area"
                    )
                logger.debug("found %d of %d eigenvalues below %g", n_found, n_present, bound)
            if krylov.size > max_size:
                raise ConvergenceError(
                    f"found {len(converged)} of {n_eigenpairs} pairs with a basis of {krylov.size}"
                )
            # Pairs are missing, or convergence is slow.
            if gap is not None or krylov.size > max_size / 2:
                krylov.widen()
            for _ in range(2):
                krylov.expand()


def _basis_sizes(n_eigenpairs: int, block_size: int, tolerance: float) -> tuple[int, int]:
    """Return the size of the basis at which usually all pairs have converged, and that at which the iteration stops."""
    n_vectors = BASIS_PER_EIGENPAIR * n_eigenpairs
    digits = -math.log10(max(tolerance, ROUNDING)) - 7
    n_blocks = BASIS_BLOCKS + BASIS_BLOCKS_PER_DECADE * math.log10(n_eigenpairs)
    n_blocks = max(1, n_blocks + BASIS_BLOCKS_PER_DIGIT * digits)
    first_size = math.ceil(n_vectors + n_blocks * block_size)
    max_size = math.ceil(MAX_BASIS_FACTOR * n_vectors) + MAX_BASIS_EXTRA
    return first_size, max_size


def _factorize_inside(
    tree: Tree,
    matrix: sparse.csr_array,
    zero_mode: np.ndarray,
    n_eigenpairs: int,
    tolerance: float,
    team: Team,
) -> tuple[float, Factors]:
    """Return a shift with about SHIFT_RANK of the wanted eigenvalues below it, and an accurate factorization.

    Since A − σI is indefinite, a pivot block may be nearly singular. The known zero mode reveals the accuracy.
    """
    target = max(1.5, SHIFT_RANK * n_eigenpairs)
    shift = 4 * math.pi * target
    mode = torch.from_numpy(zero_mode)[:, None]
    best: tuple[float, float, float, Factors] | None = None
    for _ in range(6):
        factors = tree.factorize(matrix, shift, team)
        rank = factors.n_negative
        off_target = max(0.0, abs(rank - target) - 0.2 * target - 1)
        solution = factors.solve(mode, team)
        defect = float(torch.linalg.norm(shift * solution + mode))
        logger.debug("shift %.6g: %d eigenvalues below, defect %.1e", shift, rank, defect)
        if best is None or (off_target, defect) < best[:2]:
            best = off_target, defect, shift, factors
        if off_target > 0:
            growth = target / max(rank, 1)
            shift *= min(4.0, max(0.25, growth))
        elif defect > MAX_DEFECT * tolerance:
            shift *= 0.97
        else:
            break
    assert best is not None
    return best[2:]


def gap_after(eigenvalues: torch.Tensor, n_eigenpairs: int) -> tuple[int, float] | None:
    """Return the number of eigenvalues before a gap, at least ``n_eigenpairs``, and a value in the gap, or None."""
    values = eigenvalues[n_eigenpairs - 1 :]
    if len(values) < 2:
        return None
    gaps = torch.diff(values) / values[1:]
    wide_gaps = torch.nonzero(gaps > WIDE_GAP).flatten()
    index = int(wide_gaps[0]) if len(wide_gaps) else int(gaps.argmax())
    if gaps[index] < MIN_GAP:
        return None
    middle = float(values[index] + values[index + 1]) / 2
    return n_eigenpairs + index, middle

"""Block Lanczos with a shift inside the wanted part of the spectrum, or below it; explained in `eigensolver`."""

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
from igps.spectra._multifrontal import Factors, Tree, analyse

logger = logging.getLogger(__name__)

# Share of the wanted eigenvalues below the shift: here both ends of the spectrum converge at the same time.
SHIFT_RANK = 0.55
# The shift of the second try, in units of 1/area
SHIFT_BELOW = -1.0
# Vectors in a block: few make a small basis, many make fast products. Few are better for up to FEW_EIGENPAIRS pairs,
# and where the result has more than LARGE_RESULT numbers, as the basis then takes gigabytes.
SMALL_BLOCK, LARGE_BLOCK, FEW_EIGENPAIRS, LARGE_RESULT = 8, 12, 128, 2**27
# Basis size at which mostly all pairs have converged, as measured on bodies of 11,000 vertices: so many vectors a pair
# and, besides, so many blocks, more for each factor of ten in the number of pairs and for each digit beyond seven
BASIS_PER_EIGENPAIR, BASIS_PER_EIGENPAIR_BELOW = 1.35, 2.35
BASIS_BLOCKS, BASIS_BLOCKS_PER_DECADE, BASIS_BLOCKS_PER_DIGIT = 2.4, 4.8, 1.0
# The basis gives up at this multiple of what the pairs need, and so many vectors more
BASIS_LIMIT, BASIS_LIMIT_BESIDES = 3, 600
# Numbers in the result from which a second thread pays
TEAM_RESULT = 2**21
# How accurate the factorization must be, relative to the tolerance: the lowest modes see its error some 1000 times
DEFECT = 2e-4
# A gap this wide, relative to the eigenvalue, is taken at once; a multiplet has none, and the next gap is looked for
WIDE_GAP, NARROWEST_GAP = 1e-4, 1e-7


class ConvergenceError(RuntimeError):
    """The eigenpairs asked for could not be computed, or not be proved complete, to the tolerance asked for."""


def lanczos(
    matrix: sparse.csr_array,
    zero_mode: np.ndarray,
    n_eigenpairs: int,
    positions: np.ndarray | None,
    tolerance: float,
    seed: int,
    inside: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (K,) and orthonormal eigenvectors (V, K) of a matrix with one zero mode, (V,) of length 1.

    With the shift inside the spectrum it is fast. With the shift below, A − σI is definite: its factors are accurate.
    """
    # a solve is faster where vectors lie in memory in the order of elimination
    tree, matrix, order = analyse(matrix, positions).arranged(matrix)
    zero_mode = zero_mode[order]
    few = n_eigenpairs <= FEW_EIGENPAIRS or n_eigenpairs * len(zero_mode) > LARGE_RESULT
    block_size = SMALL_BLOCK if few else LARGE_BLOCK
    per_eigenpair = BASIS_PER_EIGENPAIR if inside else BASIS_PER_EIGENPAIR_BELOW
    digits = -math.log10(max(tolerance, ROUNDING)) - 7
    n_blocks = BASIS_BLOCKS + BASIS_BLOCKS_PER_DECADE * math.log10(n_eigenpairs)
    n_blocks = max(1, n_blocks + BASIS_BLOCKS_PER_DIGIT * digits)
    first_look = math.ceil(per_eigenpair * n_eigenpairs + n_blocks * block_size)
    limit = math.ceil(BASIS_LIMIT * per_eigenpair * n_eigenpairs) + BASIS_LIMIT_BESIDES
    limit = min(limit, len(zero_mode) - 2 * block_size)
    generator = np.random.default_rng(seed)
    with Team(None if n_eigenpairs * len(zero_mode) >= TEAM_RESULT else 1) as team:
        if inside:
            shift, factors = _factorize_inside(tree, matrix, zero_mode, n_eigenpairs, tolerance, team)
        else:
            shift, factors = SHIFT_BELOW, tree.factorize(matrix, SHIFT_BELOW, team)
        n_below = factors.n_negative - 1 if inside else 0  # without the zero mode
        krylov = Krylov(factors, zero_mode, block_size, first_look + 3 * block_size, generator, team)
        while krylov.size < first_look:
            krylov.expand()
        while True:
            ritz = krylov.ritz_pairs(shift)
            found = ritz.leading(n_below, tolerance)
            gap = gap_behind(ritz.eigenvalues[found], n_eigenpairs)
            missing = False
            if gap is not None:
                n_found, bound = gap
                wanted = found[:n_eigenpairs]
                count = partial(tree.inertia, matrix, bound, team)
                if krylov.loses_basis:  # which must be kept in case that some are missing
                    vectors, n_negative = None, count()
                else:  # side by side
                    vectors, filling = krylov.eigenvectors(ritz, wanted, order)
                    steps: list[Callable[[], Any]] = [count, *filling]
                    n_negative = team.each(call, steps)[0]
                n_present = n_negative - 1
                if n_present == n_found:
                    if vectors is None:
                        vectors = krylov.eigenvectors_in_place(ritz, wanted, order)
                    return ritz.eigenvalues[wanted].numpy(), vectors
                if n_present < n_found:
                    raise ConvergenceError(
                        f"{n_found} eigenvalues found below {bound:.6g} / area, where there are {n_present}"
                    )
                logger.debug("%d of %d eigenvalues found below %g", n_found, n_present, bound)
                missing = True
            if krylov.size > limit:
                raise ConvergenceError(f"{len(found)} of {n_eigenpairs} eigenpairs after {krylov.size} basis vectors")
            if missing or krylov.size > limit / 2:
                krylov.widen()
            for _ in range(2):
                krylov.expand()


def _factorize_inside(
    tree: Tree, matrix: sparse.csr_array, zero_mode: np.ndarray, n_eigenpairs: int, tolerance: float, team: Team
) -> tuple[float, Factors]:
    """A shift with about SHIFT_RANK of the wanted eigenvalues below it, at which the factorization is accurate.

    The known zero mode tells the accuracy: as A − σI is indefinite, a pivot block is close to singular now and then.
    """
    target = max(1.5, SHIFT_RANK * n_eigenpairs)
    shift = 4 * math.pi * target
    mode = torch.from_numpy(zero_mode)[:, None]
    best: tuple[float, float, float, Factors] | None = None
    for _ in range(6):
        factors = tree.factorize(matrix, shift, team)
        rank = factors.n_negative
        off_target = max(0.0, abs(rank - target) - 0.2 * target - 1)
        defect = float(torch.linalg.norm(shift * factors.solve(mode, team) + mode))
        logger.debug("shift %.6g: %d eigenvalues below, defect %.1e", shift, rank, defect)
        if best is None or (off_target, defect) < best[:2]:
            best = off_target, defect, shift, factors
        if off_target > 0:
            shift *= min(4.0, max(0.25, target / max(rank, 1)))
        elif defect > DEFECT * tolerance:
            shift *= 0.97
        else:
            break
    assert best is not None
    return best[2:]


def gap_behind(eigenvalues: torch.Tensor, n_eigenpairs: int) -> tuple[int, float] | None:
    """Number of eigenvalues up to a gap that follows the ``n_eigenpairs``-th or a later one, and a value in the gap."""
    values = eigenvalues[n_eigenpairs - 1 :]
    if len(values) < 2:
        return None
    gaps = torch.diff(values) / values[1:]
    wide = torch.nonzero(gaps > WIDE_GAP).flatten()
    place = int(wide[0]) if len(wide) else int(gaps.argmax())
    if gaps[place] < NARROWEST_GAP:
        return None
    return n_eigenpairs + place, float(values[place] + values[place + 1]) / 2

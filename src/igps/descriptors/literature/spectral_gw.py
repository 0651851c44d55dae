"""A lower bound of the spectral Gromov-Wasserstein distance: shapes compared by their heat kernels (Mémoli 2009).

Let A be the area and t a time. The kernel K_t(x, y) = A k_t(x, y) = 1 + A Σₖ exp(−λₖt) φₖ(x) φₖ(y) has mean 1 over the
surface. The distance of two shapes, with the minimum over all couplings μ of their points, is

    min_μ sup_t c²(t) (∫∫ |K_t(x, x') − K'_t(y, y')|² dμ(x, y) dμ(x', y'))^½,   c(t) = exp(−(t + 1/t)).

This is the form of exponent 2. The unit of time is the slowest decay time of heat on a sphere of the same area, A/8π,
so that the distance does not depend on scale. The lower bound compares the distributions of K_t(x, y) over the pairs of
points. A shape is represented by its surface samples with equal weights; for the samples and the chosen times, the
bound holds exactly.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from igps._arrays import Floats, Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean
from igps.signature.signature import Signature


class SpectralGromovWasserstein(BodyDescriptor):
    """The lower bound of the spectral Gromov-Wasserstein distance by pairs of points, see this module."""

    name = "spectral_gw"
    source = "Mémoli 2009"
    invariant_to = ("motion", "scale", "pose")

    # In units of A/8π; c² is largest at t = 1 and falls off steeply on both sides
    times = (0.25, 0.5, 1.0, 2.0, 4.0)
    n_samples = 500  # at most, at equal steps along the order of the samples
    n_quantiles = 200  # steps of the quantile functions
    # Of the kernels; at the shortest default time the hundredth weighs 10⁻⁶ of the first
    n_eigenpairs = 100
    requirements = Requirements(n_eigenpairs=n_eigenpairs)
    seed = 0  # of the offset of the steps along the order of the samples
    description_shape = (len(times), -1)

    def describe_body(self, body: Body) -> Singles:
        """(times, n_quantiles) quantile functions of the kernels times c²(t)."""
        kernels = heat_kernels(body, self.times, self.n_samples, self.n_eigenpairs, self.seed)
        rows = []
        for time, kernel in zip(self.times, kernels, strict=True):
            rows.append(time_weight(time) * quantiles(kernel, self.n_quantiles))
        return np.array(rows, dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Wasserstein distances of exponent 2, the largest over the times."""
        _, n_times, n_steps = queries.shape
        at_times = [euclidean(queries[:, i], gallery[:, i]) for i in range(n_times)]
        return torch.stack(at_times).amax(dim=0) / n_steps**0.5


def heat_kernels(
    body: Body | Signature,
    times: Sequence[float],
    n_samples: int,
    n_eigenpairs: int | None = None,
    seed: int = 0,
) -> list[Floats]:
    """Heat kernels A k_t(x, y) between P ≤ `n_samples` surface samples: for every time a (P, P) array without unit.

    For the parameters and errors see `SpectralGromovWasserstein`; all eigenpairs are used if `n_eigenpairs` is None.
    """
    eigenfunctions = body.surface.eigenfunctions[:, :n_eigenpairs]
    # Samples are in a canonical order in which similar samples are neighbours, so that equal steps reach all parts.
    n_chosen = min(n_samples, len(eigenfunctions))
    step = len(eigenfunctions) / n_chosen
    offset = np.random.default_rng(seed).random()
    positions = (np.arange(n_chosen) + offset) * step
    chosen = np.minimum(positions.astype(np.int64), len(eigenfunctions) - 1)
    values = np.sqrt(body.area) * eigenfunctions[chosen].astype(np.float64)
    exponents = body.eigenvalues[:n_eigenpairs] * body.area / (8 * np.pi)
    kernels = []
    for time in times:
        decayed = values * np.exp(-exponents * time)
        kernels.append(1 + decayed @ values.T)
    return kernels


def time_weight(time: float) -> float:
    """c²(t) = exp(−2 (t + 1/t)) (Mémoli 2009)."""
    return float(np.exp(-2 * (time + 1 / time)))


def quantiles(values: ArrayLike, n_quantiles: int) -> Floats:
    """(n_quantiles,) means of the quantile function of some values over equal steps, ascending.

    Let q and q' be such means of two sets of values. For any exponent p ≥ 1, (mean |q − q'|ᵖ)^(1/p) is at most the
    Wasserstein distance of the two sets (Jensen), and converges to it as the number of steps grows.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    integral = np.concatenate([[0.0], np.cumsum(ordered)]) / len(ordered)
    shares = np.linspace(0, 1, len(integral))
    ends = np.linspace(0, 1, n_quantiles + 1)
    return n_quantiles * np.diff(np.interp(ends, shares, integral))

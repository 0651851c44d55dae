"""Spectral Gromov-Wasserstein distances: shapes compared through their heat kernels (Mémoli 2009).

With A the area and t a time, the kernel K_t(x, y) = A k_t(x, y) = 1 + A Σₖ exp(−λₖt) φₖ(x) φₖ(y) has mean 1 over the
surface. The distance of two shapes is, over all couplings μ of their points,

    min_μ sup_t c²(t) (∫∫ |K_t(x, x') − K'_t(y, y')|² dμ(x, y) dμ(x', y'))^½,   c(t) = exp(−(t + 1/t)),

the form of exponent 2. Time is counted in the decay time of the slowest heat on a sphere of the same area, A/8π, so
that scale does not matter. The lower bounds compare what each shape tells of itself. The samples stand for the shape,
each with the same weight; between the samples, at the given times, the bounds hold exactly. In the interior the
eigenfunctions are those that Rustamov 2010 extends from the surface: the volumetric counterpart he leaves to others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from igps._arrays import Floats, Singles
from igps._parameters import check_at_least, check_one_of
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Signature

Bound = Literal["trace", "signature", "pairs"]

# Around the largest c², which falls off steeply on both sides.
TIMES = (0.25, 0.5, 1.0, 2.0, 4.0)


@dataclass(eq=False, repr=False)
class SpectralGromovWasserstein(BodyDescriptor):
    """Lower bounds of the spectral Gromov-Wasserstein distance.

    "trace" compares the norms ‖K_t‖₂, whose squares are the heat traces; "signature" the distributions over the points
    x of ‖K_t(x, ·)‖₂, on the surface the square root of the heat kernel signature at 2t; "pairs" the distributions of
    K_t(x, y) over the pairs of points.
    """

    name = "spectral_gw"
    source = "Mémoli 2009"
    invariant_to = ("motion", "scale", "pose")

    samples: SampleKind = "surface"
    bound: Bound = "pairs"
    times: tuple[float, ...] = TIMES  # in units of A/8π
    n_samples: int = 500  # at most so many of the body's samples, at equal steps of their order of form
    n_quantiles: int = 200  # steps of the quantile functions
    n_eigenpairs: int = 100  # of the kernels; at the shortest default time the hundredth weighs 10⁻⁶ of the first
    seed: int = 0  # of the first step

    def __post_init__(self) -> None:
        super().__init__()
        self.description_shape = (len(self.times), -1)
        _check(self.samples, self.times, self.n_samples)
        check_one_of(get_args(Bound), bound=self.bound)
        check_at_least(1, n_quantiles=self.n_quantiles, n_eigenpairs=self.n_eigenpairs)
        self.requirements = Requirements(n_eigenpairs=self.n_eigenpairs)

    def describe_body(self, body: Body) -> Singles:
        """(times, n_quantiles) quantile functions, with the factor c²(t); (times, 1) for the bound "trace"."""
        kernels = heat_kernels(body, self.samples, self.times, self.n_samples, self.n_eigenpairs, self.seed)
        rows = []
        for time, kernel in zip(self.times, kernels, strict=True):
            if self.bound == "pairs":
                values = quantiles(kernel, self.n_quantiles)
            else:
                norms = np.sqrt(np.square(kernel).mean(axis=1))
                values = quantiles(norms, self.n_quantiles)
                if self.bound == "trace":
                    values = np.sqrt(np.square(norms).mean(keepdims=True))
            rows.append(time_weight(time) * values)
        return np.array(rows, dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) the largest over the times of the Wasserstein distances of exponent 2."""
        at_times = [euclidean(queries[:, i], gallery[:, i]) for i in range(queries.shape[1])]
        return torch.stack(at_times).amax(dim=0) / queries.shape[2] ** 0.5


def heat_kernels(
    body: Body | Signature,
    samples: SampleKind,
    times: Sequence[float],
    n_samples: int,
    n_eigenpairs: int | None = None,
    seed: int = 0,
) -> list[Floats]:
    """A k_t(x, y) among some samples: for every time a (P, P) array without unit, P ≤ `n_samples`.

    For the parameters and errors see `SpectralGromovWasserstein`; without a number of eigenpairs all are taken.
    """
    _check(samples, times, n_samples)
    eigenfunctions = getattr(body, samples).eigenfunctions[:, :n_eigenpairs]
    # Samples come in an order of form, along which the like are neighbours: steps of it see all parts of the body.
    count = min(n_samples, len(eigenfunctions))
    step = len(eigenfunctions) / count
    places = (np.arange(count) + np.random.default_rng(seed).random()) * step
    chosen = np.minimum(places.astype(np.int64), len(eigenfunctions) - 1)
    values = np.sqrt(body.area) * eigenfunctions[chosen].astype(np.float64)
    exponents = body.eigenvalues[:n_eigenpairs] * body.area / (8 * np.pi)
    return [1 + (values * np.exp(-exponents * time)) @ values.T for time in times]


def time_weight(time: float) -> float:
    """c²(t) = exp(−2 (t + 1/t)) (Mémoli 2009)."""
    return float(np.exp(-2 * (time + 1 / time)))


def quantiles(values: ArrayLike, n_quantiles: int) -> Floats:
    """Means of the quantile function of a sample over equal steps.

    For any exponent p ≥ 1, (mean |q − q'|ᵖ)^(1/p) of two samples' means q, q' is at most their Wasserstein distance
    (Jensen), and tends to it with the number of steps. They ascend, (n_quantiles,).
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    integral = np.concatenate([[0.0], np.cumsum(ordered)]) / len(ordered)
    ends = np.linspace(0, 1, n_quantiles + 1)
    return n_quantiles * np.diff(np.interp(ends, np.linspace(0, 1, len(integral)), integral))


def gromov_wasserstein(
    a: Signature,
    b: Signature,
    *,
    samples: SampleKind = "surface",
    times: Sequence[float] = TIMES,
    n_samples: int = 50,
    seed: int = 0,
) -> float:
    """The spectral Gromov-Wasserstein distance of two small sets of samples, with a coupling of its own for each time.

    The largest over the times of local minima over the couplings, by conditional gradients from the uniform coupling
    and from the one of the bound "signature". No lower bound of `SpectralGromovWasserstein` for the same
    samples and times exceeds it. For the parameters see `SpectralGromovWasserstein`; an ImportError without POT.
    """
    try:
        import ot
    except ImportError as error:
        raise ImportError('gromov_wasserstein needs POT: pip install "interior-gps[transport]".') from error
    kernels = (heat_kernels(shape, samples, times, n_samples, seed=seed) for shape in (a, b))
    largest = 0.0
    for time, first, second in zip(times, *kernels, strict=True):
        p, q = (np.full(len(kernel), 1 / len(kernel)) for kernel in (first, second))
        norms = (np.sqrt(np.square(kernel).mean(axis=1)) for kernel in (first, second))
        starts = (np.outer(p, q), ot.emd_1d(*norms, p, q))
        squared = min(
            ot.gromov.gromov_wasserstein2(first, second, p, q, loss_fun="square_loss", G0=start) for start in starts
        )
        largest = max(largest, time_weight(time) * float(np.sqrt(max(squared, 0.0))))
    return largest


def _check(samples: SampleKind, times: Sequence[float], n_samples: int) -> None:
    check_one_of(SAMPLE_KINDS, samples=samples)
    check_at_least(1, n_samples=n_samples)
    if not times or not all(0 < time < np.inf for time in times):
        raise ValueError(f"times: expected at least one positive number, got {tuple(times)}.")

"""How far apart two surfaces are once one is laid onto the other: moved, turned, mirrored and scaled."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# In units of √area. Of two points of a thin sheet, those whose normals agree are the near ones: a normal counts as so
# long a step.
_NORMAL = 0.1
# Steps between neighbouring samples within which another sample of the same surface is looked for.
_GAP = 2.5
# Principal axes whose extents differ by a smaller factor are ambiguous: other starts are tried beside them.
_AMBIGUOUS = 1.1
_N_ROTATIONS = 300
_N_PROFILE = 1000
_N_SCORED, _N_COARSE, _N_FINE = 60, 250, 1000
_N_TRIED, _COARSE_STEPS, _FINE_STEPS = 6, 15, 8
_MOST_SCALED = math.log(1.1)


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread evenly over a surface, about their mean and in units of √area.

    Args:
        points: (P, 3) without unit.
        normals: (P, 3) outward, of length 1.
    """

    points: Array
    normals: Array

    @classmethod
    def of(cls, points: Array, normals: NDArray[np.floating], area: float) -> SurfaceSamples:
        """Those of points (P, 3), length, and outward normals (P, 3) of a surface of an area, length²."""
        if points.shape != normals.shape or points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
            raise ValueError(
                f"points, normals: expected both (P, 3) with P ≥ 4, got {tuple(points.shape)} and "
                f"{tuple(normals.shape)}."
            )
        return cls((points - points.mean(axis=0)) / math.sqrt(area), np.asarray(normals, dtype=np.float64))

    @property
    def extents(self) -> Array:
        """(3,) standard deviations along the principal axes, ascending, without unit."""
        return np.sqrt(np.linalg.eigvalsh(np.cov(self.points.T)))

    @property
    def profile(self) -> Array:
        """(64,) quantiles of the distances between samples, without unit.

        The root mean square difference of two surfaces' profiles is at most twice their distance, however they are
        laid, but for what the sampling adds: distances between corresponding points differ by no more than both moved.
        """
        distances = pdist(_subset(self, _N_PROFILE).points)
        return np.quantile(distances, (np.arange(64) + 0.5) / 64)

    @property
    def gap(self) -> float:
        """How far apart neighbours are, about."""
        return 1 / math.sqrt(len(self.points))


def surface_distance(
    one: SurfaceSamples, other: SurfaceSamples, *, enough: float = 0.0, hopeless: float = math.inf
) -> float:
    """Root mean square distance of two surfaces laid onto each other, over √area, the mean of both directions.

    One is moved, turned, perhaps mirrored, and scaled by up to a tenth (their areas are equal already), from many
    starts, by iterated closest points to tangent planes (Chen and Medioni 1992; Besl and McKay 1992). A sample is as
    far from the other surface as from the plane of the nearest sample there whose normal agrees, and farther by what it
    lies off to the side of that sample, beyond the gaps between samples.

    Args:
        one, other: samples of the surfaces.
        enough: a distance that ends the search: a smaller one is not looked for.
        hopeless: a distance beyond which it matters no more how far apart they are: where few samples are farther
            after many steps, no more are taken.

    Returns:
        Without unit; symmetric but for where the search ends.
    """
    target = _Target(other)
    best = math.inf
    ways = [_principal_starts(one, other)]
    if min(_least_step(one), _least_step(other)) < _AMBIGUOUS:
        ways.append(_uniform_starts())
    for starts in ways:
        scored = _subset(one, _N_SCORED)
        order = np.argsort(target.scores(scored, starts), kind="stable")[:_N_TRIED]
        coarse = sorted(
            (_fitted(_subset(one, _N_COARSE), target, _Placing(starts[i]), _COARSE_STEPS) for i in order),
            key=lambda found: found[0],
        )
        for far, placing in coarse[:2]:
            if far > hopeless:
                best = min(best, far)
                continue
            _, placing = _fitted(_subset(one, _N_FINE), target, placing, _FINE_STEPS)
            placed = placing(one)
            there, back = target.distances(placed), _Target(placed).distances(other)
            # In units of the mean of both, so that neither is favoured.
            best = min(best, float(np.sqrt((np.mean(there**2) + np.mean(back**2)) / 2)) / math.sqrt(placing.scale))
            if best <= enough:
                return best
    return best


class _Target:
    """Where the nearest sample of a surface is found."""

    def __init__(self, surface: SurfaceSamples) -> None:
        self.surface = surface
        self.tree = KDTree(_with_normals(surface))

    def nearest(self, samples: SurfaceSamples) -> NDArray[np.intp]:
        return self.tree.query(_with_normals(samples))[1]

    def distances(self, samples: SurfaceSamples) -> Array:
        """(P,) of each sample from the surface."""
        found = self.nearest(samples)
        steps = samples.points - self.surface.points[found]
        across = np.einsum("ni,ni->n", steps, self.surface.normals[found])
        aside = np.sqrt(np.maximum(np.einsum("ni,ni->n", steps, steps) - across**2, 0))
        return np.hypot(across, np.maximum(aside - _GAP * self.surface.gap, 0))

    def scores(self, samples: SurfaceSamples, starts: Array) -> Array:
        """(S,) how badly each of the starts (S, 3, 3) lays the samples."""
        points, normals = (np.einsum("sij,nj->sni", starts, one) for one in (samples.points, samples.normals))
        placed = SurfaceSamples(points.reshape(-1, 3), normals.reshape(-1, 3))
        far, _ = self.tree.query(_with_normals(placed))
        return np.square(far).reshape(len(starts), -1).mean(axis=1)


@dataclass(frozen=True, eq=False)
class _Placing:
    """How a surface is laid: scale · turn · x + shift; `turn` may mirror."""

    turn: Array
    shift: Array | float = 0.0
    scale: float = 1.0

    def __call__(self, samples: SurfaceSamples) -> SurfaceSamples:
        return SurfaceSamples(self.scale * samples.points @ self.turn.T + self.shift, samples.normals @ self.turn.T)

    def then(self, step: Array) -> _Placing:
        """After a further small rotation vector, shift and logarithm of a scale, (7,)."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        log_scale = np.clip(math.log(self.scale) + step[6], -_MOST_SCALED, _MOST_SCALED)
        factor = math.exp(log_scale) / self.scale
        return _Placing(
            turn @ self.turn, factor * turn @ np.broadcast_to(self.shift, 3) + step[3:6], math.exp(log_scale)
        )


def _fitted(samples: SurfaceSamples, target: _Target, placing: _Placing, n_steps: int) -> tuple[float, _Placing]:
    """Root mean square distance to the tangent planes, and the placing that the steps end at."""
    for _ in range(n_steps):
        placed = placing(samples)
        found = target.nearest(placed)
        normals = target.surface.normals[found]
        across = np.einsum("ni,ni->n", target.surface.points[found] - placed.points, normals)
        along = np.einsum("ni,ni->n", placed.points, normals)
        columns = np.column_stack([np.cross(placed.points, normals), normals, along])
        square = columns.T @ columns
        # What the surface leaves free, as a sphere its rotations, stays as it is.
        square[np.diag_indices(7)] += 1e-4 * np.trace(square) / 7
        step = np.linalg.solve(square, columns.T @ across)
        placing = placing.then(step)
        if np.abs(step).max() < 1e-5:
            break
    return float(np.sqrt(np.mean(target.distances(placing(samples)) ** 2))), placing


def _with_normals(samples: SurfaceSamples) -> Array:
    return np.hstack([samples.points, _NORMAL * samples.normals])


def _subset(samples: SurfaceSamples, n: int) -> SurfaceSamples:
    """About n of the samples, at equal steps."""
    chosen = np.linspace(0, len(samples.points) - 1, min(n, len(samples.points))).round().astype(np.int64)
    return SurfaceSamples(samples.points[chosen], samples.normals[chosen])


def _principal_starts(one: SurfaceSamples, other: SurfaceSamples) -> Array:
    """(8, 3, 3): principal axes onto principal axes, each with either sign."""
    of_one, of_other = (np.linalg.eigh(np.cov(samples.points.T))[1] for samples in (one, other))
    return np.stack([of_other @ np.diag(signs) @ of_one.T for signs in _signs()])


def _least_step(samples: SurfaceSamples) -> float:
    """The smallest factor from one extent to the next."""
    extents = np.maximum(samples.extents, 1e-9)
    return float((extents[1:] / extents[:-1]).min())


def _signs() -> Iterator[tuple[float, float, float]]:
    return ((a, b, c) for a in (1.0, -1.0) for b in (1.0, -1.0) for c in (1.0, -1.0))


@cache
def _uniform_starts() -> Array:
    """(2 · _N_ROTATIONS, 3, 3) rotations, spread evenly, and their mirror images (super-Fibonacci, Alexa 2022)."""
    s = np.arange(_N_ROTATIONS) + 0.5
    phi, psi = math.sqrt(2), 1.533751168755204288118041
    r, big_r = np.sqrt(s / _N_ROTATIONS), np.sqrt(1 - s / _N_ROTATIONS)
    alpha, beta = 2 * math.pi * s / phi, 2 * math.pi * s / psi
    quaternions = np.column_stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)])
    rotations = Rotation.from_quat(quaternions).as_matrix()
    return np.concatenate([rotations, -rotations])

"""How far apart two surfaces are once one is laid onto the other: moved, turned, mirrored and scaled."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from igps._arrays import Floats, Integers
from igps.mesh.surface import area_vectors, unit

# In units of √area. Of two points of a thin sheet, those whose normals agree are the near ones: a normal counts as so
# long a step.
_NORMAL = 0.1
# Steps between neighbouring samples within which another sample of the same surface is looked for.
_GAP = 2.5
# Principal axes whose extents differ by a smaller factor are ambiguous: other starts are tried even where those from
# the axes are hopeless
_AMBIGUOUS = 1.1
_N_ROTATIONS = 300
_N_SCORED, _N_FITTED = 60, 250
_N_TRIED, _COARSE_STEPS, _FINE_STEPS, _LAST_STEPS = 12, 6, 4, 10
# Placings that samples tell no better from each other than by this factor are laid onto the surface
_ALIKE = 1.5
# After the fine steps, what is farther than the hopeless distance over this is hopeless. With 0.03 for that, 99 % of
# copies of generated bodies are within 0.006 then, well below 0.02; the others are found from other starts.
_FINER = 1.5
# Over √area: the last steps bring patches nearer by less; those of copies of generated bodies by up to 0.0001.
_LAST_GAIN = 0.004
# Neighbouring samples whose offsets are averaged.
_PATCH = 10
MOST_SCALED = math.log(1.1)
"""How much one is scaled at most beside the other: the logarithm of the factor."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points (P, 3) spread evenly over a surface, about their mean and over √area, and unit outward normals (P, 3).

    `surface` gives the surface itself, about the same origin and in the same unit; it is asked for where others are
    near.
    """

    points: Floats
    normals: Floats
    surface: Callable[[], TriangleSurface] | None = None

    @classmethod
    def of(cls, points: Floats, normals: NDArray[np.floating], area: float) -> SurfaceSamples:
        """Those of points (P, 3), length, and outward normals (P, 3) of a surface of an area, length²."""
        if points.shape != normals.shape or points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
            raise ValueError(
                f"points, normals: expected both (P, 3) with P ≥ 4, got {tuple(points.shape)} and "
                f"{tuple(normals.shape)}."
            )
        return cls((points - points.mean(axis=0)) / math.sqrt(area), np.asarray(normals, dtype=np.float64))

    @cached_property
    def tree(self) -> KDTree:
        """Finds the nearest of them."""
        return KDTree(_with_normals(self), leafsize=50)  # in six dimensions twice as fast as the default

    @cached_property
    def extents(self) -> Floats:
        """(3,) standard deviations along the principal axes, ascending, without unit."""
        return np.sqrt(np.linalg.eigvalsh(np.cov(self.points.T)))

    @property
    def gap(self) -> float:
        """How far apart neighbours are, about."""
        return 1 / math.sqrt(len(self.points))

    def nearest(self, samples: SurfaceSamples) -> tuple[Floats, Floats]:
        """(P, 3) and (P, 3) the nearest of them to each of other samples, whose normal agrees, and its normal."""
        found = self.tree.query(_with_normals(samples))[1]
        return self.points[found], self.normals[found]


class TriangleSurface:
    """A surface to find nearest points of: vertices (V, 3) over √area, and faces (F, 3)."""

    gap = 0.0

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        import igl

        self._triangles = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
        self._normals = unit(area_vectors(vertices, faces))
        self._tree = igl.AABB()
        self._tree.init(*self._triangles)

    def nearest(self, samples: SurfaceSamples) -> tuple[Floats, Floats]:
        """(P, 3) and (P, 3) the nearest point of it to each of some samples, and the normal there."""
        _, face, points = self._tree.squared_distance(*self._triangles, np.ascontiguousarray(samples.points))
        return np.asarray(points), self._normals[np.asarray(face).ravel()]


def surface_distance(
    one: SurfaceSamples, other: SurfaceSamples, *, enough: float = 0.0, hopeless: float = math.inf,
    most: float = math.inf, patch: int = _PATCH,
) -> float:  # fmt: skip
    """How far apart two surfaces laid onto each other stay, over √area: root mean square of patches, of both ways.

    One is moved, turned, perhaps mirrored, and scaled by up to a tenth (their areas are equal already), from many
    starts, by iterated closest points to tangent planes (Chen and Medioni 1992; Besl and McKay 1992). The offset of a
    sample is that to the other surface; where that is not at hand, that to the plane of its nearest sample whose normal
    agrees, and beside it what it lies off to the side of that sample, beyond the gaps between samples. Offsets are
    averaged over patches of ten neighbours, a twentieth of √area across: relief that a coarser mesh has lost, and the
    roughness of triangles, go in and out and cancel, where another shape or pose moves whole patches.

    The search ends at a distance that is `enough`. Beyond `hopeless` it matters no more how far apart they are: where
    few samples are farther after some steps, the other surface itself is not asked for; nor are all samples laid onto
    that, where few are farther from it than two thirds of it. What is farther than `most` is told to be, not how far:
    one way may do. With a `patch` of 1 instead of ten neighbours, for two that are known to be the same, lost relief
    counts, and the farthest sample instead of the mean. The result is symmetric but for where the search ends.
    """
    best = math.inf
    is_ambiguous = min(_least_step(one), _least_step(other)) < _AMBIGUOUS
    samples = _subset(one, _N_FITTED)
    for starts in (_principal_starts(one, other), _uniform_starts()):
        order = np.argsort(_scores(_subset(one, _N_SCORED), other, starts), kind="stable")[:_N_TRIED]
        coarse = [_fitted(samples, other, _Placing(starts[i]), _COARSE_STEPS) for i in order]
        far = min(apart for apart, _ in coarse)
        if far <= hopeless:
            # Of a spring's turns samples tell no more than how far apart they lie: the surface itself decides
            finest = other if other.surface is None else other.surface()
            fine = [
                _fitted(samples, finest, placing, _FINE_STEPS) for apart, placing in coarse if apart <= _ALIKE * far
            ]
            far, placing = min(fine, key=itemgetter(0))
            if far <= hopeless / _FINER:
                far = _apart(one, other, placing, patch, most)
        best = min(best, far)
        # A body may be nearly its own mirror image: near is not yet the nearest; but of two that are known to be the
        # same, clear axes tell which of their starts is
        if best <= enough or ((best > hopeless or patch == 1) and not is_ambiguous):
            break
    return best


def offset_in_place(samples: SurfaceSamples, surface: TriangleSurface) -> float:
    """Root mean square of the patches of samples, as in `surface_distance`, to a surface in its place."""
    return math.sqrt(_mean_square(samples, surface))


def _apart(one: SurfaceSamples, other: SurfaceSamples, placing: _Placing, patch: int, most: float) -> float:
    """Root mean square of the patches of either, each laid onto all that is known of the other; or at least `most`."""
    squares = []
    for samples, target, way in ((one, other, placing), (other, one, placing.inverse())):
        finest = target if target.surface is None else target.surface()
        if most < math.inf:
            at_least = math.sqrt(_mean_square(way(samples), finest, patch) / way.scale) - _LAST_GAIN
            if at_least > most:
                return at_least
        _, fitted = _fitted(samples, finest, way, _LAST_STEPS)
        # In units of the mean of both, so that neither is favoured.
        squares.append(_mean_square(fitted(samples), finest, patch) / fitted.scale)
        if sum(squares) / 2 > most**2:
            break
    return math.sqrt(sum(squares) / 2)


def _mean_square(samples: SurfaceSamples, target: SurfaceSamples | TriangleSurface, patch: int = _PATCH) -> float:
    among = np.arange(1, min(patch, len(samples.points)) + 1)
    neighbours = samples.tree.query(_with_normals(samples), k=among)[1]
    means = _offsets(samples, target)[neighbours].mean(axis=1)
    squares = np.einsum("ni,ni->n", means, means)
    return float(squares.max() if patch == 1 else squares.mean())


def _offsets(samples: SurfaceSamples, target: SurfaceSamples | TriangleSurface) -> Floats:
    """(P, 3) from each sample to the surface of the target."""
    nearest, normals = target.nearest(samples)
    steps = nearest - samples.points
    across = np.einsum("ni,ni->n", steps, normals)[:, None] * normals
    aside = steps - across
    length = np.linalg.norm(aside, axis=1, keepdims=True)
    return across + aside * np.maximum(1 - _GAP * target.gap / np.maximum(length, 1e-12), 0)


def _scores(samples: SurfaceSamples, target: SurfaceSamples, starts: Floats) -> Floats:
    """(S,) how badly each of the starts (S, 3, 3) lays the samples."""
    points, normals = (np.einsum("sij,nj->sni", starts, one) for one in (samples.points, samples.normals))
    placed = SurfaceSamples(points.reshape(-1, 3), normals.reshape(-1, 3))
    far, _ = target.tree.query(_with_normals(placed), eps=0.5)  # starts are put in nearly the same order
    return np.asarray(np.square(far).reshape(len(starts), -1).mean(axis=1))


@dataclass(frozen=True, eq=False)
class _Placing:
    """How a surface is laid: scale · turn · x + shift; `turn` may mirror."""

    turn: Floats
    shift: Floats | float = 0.0
    scale: float = 1.0

    def __call__(self, samples: SurfaceSamples) -> SurfaceSamples:
        return SurfaceSamples(self.scale * samples.points @ self.turn.T + self.shift, samples.normals @ self.turn.T)

    def inverse(self) -> _Placing:
        return _Placing(self.turn.T, -self.turn.T @ np.broadcast_to(self.shift, 3) / self.scale, 1 / self.scale)

    def then(self, step: Floats) -> _Placing:
        """After a further small rotation vector, shift and logarithm of a scale, (7,)."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        log_scale = np.clip(math.log(self.scale) + step[6], -MOST_SCALED, MOST_SCALED)
        factor = math.exp(log_scale) / self.scale
        shift = factor * turn @ np.broadcast_to(self.shift, 3) + step[3:6]
        return _Placing(turn @ self.turn, shift, math.exp(log_scale))


def _fitted(
    samples: SurfaceSamples, target: SurfaceSamples | TriangleSurface, placing: _Placing, n_steps: int
) -> tuple[float, _Placing]:
    """Root mean square of the offsets, and the placing that the steps end at."""
    for _ in range(n_steps):
        placed = placing(samples)
        nearest, normals = target.nearest(placed)
        across = np.einsum("ni,ni->n", nearest - placed.points, normals)
        along = np.einsum("ni,ni->n", placed.points, normals)
        columns = np.column_stack([np.cross(placed.points, normals), normals, along])
        square = columns.T @ columns
        # What the surface leaves free, as a sphere its rotations, stays as it is.
        square[np.diag_indices(7)] += 1e-4 * np.trace(square) / 7
        step = np.linalg.solve(square, columns.T @ across)
        placing = placing.then(step)
        if np.abs(step).max() < 1e-5:
            break
    offsets = _offsets(placing(samples), target)
    return float(np.sqrt(np.einsum("ni,ni->n", offsets, offsets).mean())), placing


def _with_normals(samples: SurfaceSamples) -> Floats:
    return np.hstack([samples.points, _NORMAL * samples.normals])


def _subset(samples: SurfaceSamples, n: int) -> SurfaceSamples:
    """About n of the samples, at equal steps."""
    chosen = np.linspace(0, len(samples.points) - 1, min(n, len(samples.points))).round().astype(np.int64)
    return SurfaceSamples(samples.points[chosen], samples.normals[chosen])


def _principal_starts(one: SurfaceSamples, other: SurfaceSamples) -> Floats:
    """(8, 3, 3): principal axes onto principal axes, each with either sign."""
    of_one, of_other = (np.linalg.eigh(np.cov(samples.points.T))[1] for samples in (one, other))
    return np.stack([of_other @ np.diag(signs) @ of_one.T for signs in product((1.0, -1.0), repeat=3)])


def _least_step(samples: SurfaceSamples) -> float:
    """The smallest factor from one extent to the next."""
    extents = np.maximum(samples.extents, 1e-9)
    return float((extents[1:] / extents[:-1]).min())


@cache
def _uniform_starts() -> Floats:
    """(2 · _N_ROTATIONS, 3, 3) rotations, spread evenly, and their mirror images (super-Fibonacci, Alexa 2022)."""
    s = np.arange(_N_ROTATIONS) + 0.5
    phi, psi = math.sqrt(2), 1.533751168755204288118041
    r, big_r = np.sqrt(s / _N_ROTATIONS), np.sqrt(1 - s / _N_ROTATIONS)
    alpha, beta = 2 * math.pi * s / phi, 2 * math.pi * s / psi
    quaternions = np.column_stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)])
    rotations = Rotation.from_quat(quaternions).as_matrix()
    return np.concatenate([rotations, -rotations])

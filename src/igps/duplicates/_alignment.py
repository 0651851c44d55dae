"""The distance of two surfaces after alignment by a motion, a reflection and a scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from operator import itemgetter
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from igps._arrays import Floats, Integers
from igps.mesh.surface import area_vectors, dots, face_areas, lengths, undirected_edges, unit

# Lengths are over √area.
_NORMAL_WEIGHT = 0.1  # of normals in the search for the nearest sample, to tell apart the two sides of a thin sheet
_GAP = 2.5  # lateral distance of the nearest sample that does not count, in steps between neighbouring samples
# Principal axes whose extents differ by a smaller factor are ambiguous: starts from other rotations are tried as well
_AMBIGUITY = 1.1
_N_ROTATIONS = 300
_N_SCORED = 60  # samples that score a start
_N_FITTED = 250  # samples that are fitted
_N_STARTS = 12
_N_COARSE_STEPS = 6
_N_FINE_STEPS = 4
_N_LAST_STEPS = 10
# Poses that fit up to this factor worse than the best by samples alone are fitted to the surface itself
_CLOSE_FIT = 1.5
# After the fine steps, `hopeless` is divided by this factor. With 0.03, it is then 0.02, while 99 % of the copies of
# generated bodies are within 0.006; the others are found from other starts.
_FINE_FACTOR = 1.5
_LAST_GAIN = 0.004  # upper bound of the decrease of a distance by the last steps; 0.0001 for copies of generated bodies
_PATCH_SIZE = 10  # neighbouring samples whose offsets are averaged
# Degrees between neighbouring triangles: less than the first is flat, up to the second round, and beyond the third an
# edge. In between it may be either.
_BENDS = (1.0, 30.0, 60.0)
# Flat faces tell whether a body was changed if they have this share of the samples, and half of these lie nearer than
# the tolerance over _COINCIDING.
_MIN_FLAT = 0.1
_COINCIDING = 5.0
_N_TRIMMED = 3  # improvements of the alignment by the half that fits best
_PLAY = 2.0  # times the play of both surfaces by which round places may lie apart
MAX_LOG_SCALE = math.log(1.1)
"""Largest logarithm of the scale of an alignment."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points (P, 3) spread evenly over a surface, centred and over √area, with unit outward normals (P, 3).

    `surface` returns the surface itself in the same coordinates. It is called only if another surface is near.
    """

    points: Floats
    normals: Floats
    surface: Callable[[], TriangleSurface] | None = None

    @classmethod
    def of(cls, points: Floats, normals: NDArray[np.floating], area: float) -> SurfaceSamples:
        """Normalise points (P, 3), a length, with outward normals (P, 3), by the area of the surface, a length²."""
        n = len(points)
        if n < 4 or points.shape != (n, 3) or normals.shape != (n, 3):
            shapes = f"{tuple(points.shape)} and {tuple(normals.shape)}"
            raise ValueError(f"points, normals: expected both (P, 3) with P ≥ 4, got {shapes}.")
        centred = points - points.mean(axis=0)
        return cls(centred / math.sqrt(area), np.asarray(normals, dtype=np.float64))

    @cached_property
    def tree(self) -> KDTree:
        """Tree of the samples, with positions and weighted normals as six coordinates."""
        # Twice as fast as the default in six dimensions
        return KDTree(_with_normals(self), leafsize=50)

    @cached_property
    def extents(self) -> Floats:
        """Standard deviations (3,) along the principal axes, ascending."""
        return np.sqrt(np.linalg.eigvalsh(np.cov(self.points.T)))

    @property
    def gap(self) -> float:
        """Typical distance of neighbouring samples."""
        return 1 / math.sqrt(len(self.points))

    def finest(self) -> SurfaceSamples | TriangleSurface:
        """Return the surface itself, or the samples if it is not known."""
        return self if self.surface is None else self.surface()

    def nearest(self, samples: SurfaceSamples) -> tuple[Floats, Floats]:
        """Return points and normals of these samples: the nearest, with similar normals, to each of the given ones."""
        _, nearest = self.tree.query(_with_normals(samples))
        return self.points[nearest], self.normals[nearest]


class TriangleSurface:
    """A triangle mesh for searches of nearest points: vertices (V, 3) over √area, and faces (F, 3)."""

    gap = 0.0

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        import igl

        self._vertices = np.ascontiguousarray(vertices)
        self._faces = np.ascontiguousarray(faces)
        self._normals = unit(area_vectors(vertices, faces))
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def nearest(self, samples: SurfaceSamples) -> tuple[Floats, Floats]:
        """Return the nearest point of the surface to each of the samples (P), and the normal there."""
        face, points = self._nearest(samples)
        return points, self._normals[face]

    def _nearest(self, samples: SurfaceSamples) -> tuple[Integers, Floats]:
        """Return the face (P,) nearest to each of the samples, and its nearest point (P, 3)."""
        points = np.ascontiguousarray(samples.points)
        _, face, nearest = self._tree.squared_distance(self._vertices, self._faces, points)
        return np.asarray(face).ravel(), np.asarray(nearest)

    def play_at(self, samples: SurfaceSamples) -> Floats:
        """Return how far (P,) the round surface behind the nearest triangles may lie from them: 0 on flat faces.

        Bends of a few degrees are those of a round surface. An arc whose chords are w wide and bend by β lies up to
        w/2 · tan(β/4) off them. Bends of more degrees may be edges or coarse arcs: infinity.
        """
        face, _ = self._nearest(samples)
        return self._play[face]

    @cached_property
    def _play(self) -> Floats:
        edges, edge_of_side = undirected_edges(self._faces)
        count = np.bincount(edge_of_side, minlength=len(edges))
        is_between_two = count == 2
        sides = np.argsort(edge_of_side, kind="stable")
        starts = (np.cumsum(count) - count)[is_between_two]
        pairs = np.stack([sides[starts], sides[starts + 1]]) // 3  # the two faces (2, E) of edges
        cosines = dots(*self._normals[pairs])
        bends = np.arccos(np.clip(cosines, -1, 1))
        start, end = edges[is_between_two].T
        chords = lengths(self._vertices[start] - self._vertices[end])
        areas = face_areas(self._vertices, self._faces)
        widths = 2 * areas[pairs] / np.maximum(chords, 1e-12)
        play = widths / 2 * np.tan(bends / 4)
        flat, round_, arc = np.radians(_BENDS)
        play[:, bends > round_] = np.inf
        play[:, (bends < flat) | (bends > arc)] = 0.0
        largest = np.zeros(len(self._faces))
        np.maximum.at(largest, pairs, play)
        return largest


Side = Literal["any", "same", "mirrored"]
"""Which alignments are tried: all, those without a reflection, or those with one."""


def surface_distance(
    one: SurfaceSamples,
    other: SurfaceSamples,
    *,
    stop_at: float = 0.0,
    hopeless: float = math.inf,
    max_distance: float = math.inf,
    patch_size: int = _PATCH_SIZE,
    side: Side = "any",
) -> float:
    """Return the distance of two surfaces after alignment, over √area: root mean square over patches, both ways.

    The first surface is moved, rotated, possibly reflected, and scaled by up to a tenth (areas are equal already) by
    iterated closest points with tangent planes (Chen and Medioni 1992; Besl and McKay 1992), from many starts. The
    offset of a sample leads to the nearest point of the other surface. Without that surface, it leads to the tangent
    plane of the nearest sample with a similar normal; a lateral offset counts only beyond the gaps between samples.
    Offsets are averaged over patches of ten neighbours, a twentieth of √area across. Relief that a coarse mesh lacks,
    and the roughness of triangles, have offsets of either sign and cancel; another shape or pose moves whole patches.

    The result is symmetric, except that the search may stop at different distances.

    Args:
        one: samples of the surface that is moved.
        other: samples of the other surface.
        stop_at: distance at which the search stops.
        hopeless: distance beyond which the result need not be precise. If a subset of the samples is farther after the
            coarse steps, the other surface itself is not loaded; if the subset is farther than two thirds of
            `hopeless` after the fine steps, the remaining samples are not used.
        max_distance: distance beyond which the result is only a lower bound, for which one direction may be enough.
        patch_size: samples in a patch. With 1, for surfaces known to be the same, lost relief counts, and the largest
            offset is returned instead of the root mean square.
        side: which alignments are tried.
    """
    best = math.inf
    is_ambiguous = min(_min_extent_ratio(one), _min_extent_ratio(other)) < _AMBIGUITY
    samples = _subset(one, _N_FITTED)
    for starts in _starts(one, other, side):
        coarse = _coarse_fits(one, other, starts)
        distance, _ = min(coarse, key=itemgetter(0))
        if distance <= hopeless:
            # Samples alone cannot tell which turn of a spring fits another turn: the surface itself decides
            finest = other.finest()
            close = [alignment for error, alignment in coarse if error <= _CLOSE_FIT * distance]
            fine = [_fit(samples, finest, alignment, _N_FINE_STEPS) for alignment in close]
            distance, alignment = min(fine, key=itemgetter(0))
            if distance <= hopeless / _FINE_FACTOR:
                distance = _two_way_distance(one, other, alignment, patch_size, max_distance)
        best = min(best, distance)
        # A body may nearly be its own mirror image, so a small distance need not be the smallest. For surfaces known to
        # be the same, unambiguous axes are enough.
        are_axes_enough = not is_ambiguous and (best > hopeless or patch_size == 1)
        if best <= stop_at or are_axes_enough:
            break
    return best


def _coarse_fits(
    one: SurfaceSamples, other: SurfaceSamples, starts: Floats
) -> list[tuple[float, _Alignment]]:
    """Return the distances and alignments of samples from the best of the starts (S, 3, 3)."""
    scores = _scores(_subset(one, _N_SCORED), other, starts)
    best = np.argsort(scores, kind="stable")[:_N_STARTS]
    samples = _subset(one, _N_FITTED)
    return [_fit(samples, other, _Alignment(starts[i]), _N_COARSE_STEPS) for i in best]


def _starts(one: SurfaceSamples, other: SurfaceSamples, side: Side) -> list[Floats]:
    """Return the maps (S, 3, 3) of principal axes, and those spread evenly, on the given side."""
    all_starts = [_principal_starts(one, other), _uniform_starts()]
    if side == "any":
        return all_starts
    is_mirrored = side == "mirrored"
    return [starts[(np.linalg.det(starts) < 0) == is_mirrored] for starts in all_starts]


def changed_share(one: SurfaceSamples, other: SurfaceSamples, tolerance: float) -> float:
    """Return the share of two aligned surfaces that lies apart, if flat faces mostly coincide; else 0.

    Another level of detail moves round places by their play, see `TriangleSurface.play_at`, but no flat face. So
    surfaces whose flat faces mostly coincide, and that lie farther apart elsewhere, are those of different bodies. The
    alignment is that of the half that fits best.
    """
    surface = other.surface
    if surface is None or one.surface is None:
        return 0.0
    target = surface()
    few = _subset(one, _N_FITTED)
    fits = []
    for starts in _starts(one, other, "any"):
        for _, alignment in _coarse_fits(one, other, starts):
            fits.append(_fit(few, target, alignment, _N_FINE_STEPS))
    _, alignment = min(fits, key=itemgetter(0))
    for _ in range(_N_TRIMMED):
        apart = lengths(_offsets(alignment(one), target))
        is_near = apart <= np.median(apart)
        half = SurfaceSamples(one.points[is_near], one.normals[is_near])
        _, alignment = _fit(half, target, alignment, _N_LAST_STEPS)
    moved = alignment(one)
    play = one.surface().play_at(one) + target.play_at(moved)
    apart = lengths(_offsets(moved, target))
    on_flat = apart[play == 0]
    if len(on_flat) < _MIN_FLAT * len(apart):
        return 0.0
    if np.median(on_flat) > tolerance / _COINCIDING:
        return 0.0
    is_apart = apart > tolerance + _PLAY * play
    return float(is_apart.mean())


def offset_in_place(samples: SurfaceSamples, surface: TriangleSurface) -> float:
    """Return the root mean square over patches, as in `surface_distance`, without alignment."""
    return math.sqrt(_mean_square(samples, surface, _PATCH_SIZE))


def _two_way_distance(
    one: SurfaceSamples,
    other: SurfaceSamples,
    alignment: _Alignment,
    patch_size: int,
    max_distance: float,
) -> float:
    """Return the root mean square over the patches of both surfaces, or a lower bound of it above `max_distance`."""
    total = 0.0
    for samples, target, initial in ((one, other, alignment), (other, one, alignment.inverse())):
        finest = target.finest()
        if max_distance < math.inf:
            now = math.sqrt(_square_after(initial, samples, finest, patch_size))
            bound = now - _LAST_GAIN
            if bound > max_distance:
                return bound
        _, fitted = _fit(samples, finest, initial, _N_LAST_STEPS)
        total += _square_after(fitted, samples, finest, patch_size)
        if total / 2 > max_distance**2:
            break
    return math.sqrt(total / 2)


def _square_after(
    alignment: _Alignment,
    samples: SurfaceSamples,
    target: SurfaceSamples | TriangleSurface,
    patch_size: int,
) -> float:
    """Return the mean square after an alignment, in the unit of the geometric mean of both, which favours neither."""
    return _mean_square(alignment(samples), target, patch_size) / alignment.scale


def _mean_square(
    samples: SurfaceSamples, target: SurfaceSamples | TriangleSurface, patch_size: int
) -> float:
    """Return the mean square offset of patches, or the largest square offset if a patch is one sample."""
    ranks = np.arange(1, min(patch_size, len(samples.points)) + 1)
    _, neighbours = samples.tree.query(_with_normals(samples), k=ranks)
    means = _offsets(samples, target)[neighbours].mean(axis=1)
    squares = dots(means, means)
    return float(squares.max() if patch_size == 1 else squares.mean())


def _offsets(samples: SurfaceSamples, target: SurfaceSamples | TriangleSurface) -> Floats:
    """Return the offsets (P, 3) from samples to the surface of the target."""
    nearest, normals = target.nearest(samples)
    steps = nearest - samples.points
    heights = dots(steps, normals)
    normal_part = heights[:, None] * normals
    lateral = steps - normal_part
    length = np.linalg.norm(lateral, axis=1, keepdims=True)
    beyond_gap = np.maximum(1 - _GAP * target.gap / np.maximum(length, 1e-12), 0)
    return normal_part + lateral * beyond_gap


def _scores(samples: SurfaceSamples, target: SurfaceSamples, starts: Floats) -> Floats:
    """Return the mean square distance (S,) of the samples from the target after each of the rotations (S, 3, 3)."""
    points = np.einsum("sij,nj->sni", starts, samples.points)
    normals = np.einsum("sij,nj->sni", starts, samples.normals)
    rotated = SurfaceSamples(points.reshape(-1, 3), normals.reshape(-1, 3))
    # Precise enough to order the starts
    distances, _ = target.tree.query(_with_normals(rotated), eps=0.5)
    squares = np.square(distances).reshape(len(starts), -1)
    return np.asarray(squares.mean(axis=1))


@dataclass(frozen=True, eq=False)
class _Alignment:
    """The map x ↦ scale · rotation · x + shift; `rotation` may contain a reflection."""

    rotation: Floats
    shift: Floats | float = 0.0
    scale: float = 1.0

    def __call__(self, samples: SurfaceSamples) -> SurfaceSamples:
        points = self.scale * samples.points @ self.rotation.T + self.shift
        return SurfaceSamples(points, samples.normals @ self.rotation.T)

    def inverse(self) -> _Alignment:
        shift = -self.rotation.T @ np.broadcast_to(self.shift, 3) / self.scale
        return _Alignment(self.rotation.T, shift, 1 / self.scale)

    def then(self, step: Floats) -> _Alignment:
        """Compose with a small step (7,): a rotation vector, a shift, and the logarithm of a scale."""
        rotation = Rotation.from_rotvec(step[:3]).as_matrix()
        log_scale = np.clip(math.log(self.scale) + step[6], -MAX_LOG_SCALE, MAX_LOG_SCALE)
        scale = math.exp(log_scale)
        moved = scale / self.scale * rotation @ np.broadcast_to(self.shift, 3)
        return _Alignment(rotation @ self.rotation, moved + step[3:6], scale)


def _fit(
    samples: SurfaceSamples,
    target: SurfaceSamples | TriangleSurface,
    alignment: _Alignment,
    n_steps: int,
) -> tuple[float, _Alignment]:
    """Improve an alignment, and return the root mean square of the offsets with the last alignment."""
    for _ in range(n_steps):
        moved = alignment(samples)
        nearest, normals = target.nearest(moved)
        residuals = dots(nearest - moved.points, normals)
        along_normals = dots(moved.points, normals)
        jacobian = np.column_stack([np.cross(moved.points, normals), normals, along_normals])
        normal_matrix = jacobian.T @ jacobian
        # Directions that the surface does not determine, such as rotations of a sphere, get no step
        normal_matrix[np.diag_indices(7)] += 1e-4 * np.trace(normal_matrix) / 7
        step = np.linalg.solve(normal_matrix, jacobian.T @ residuals)
        alignment = alignment.then(step)
        if np.abs(step).max() < 1e-5:
            break
    offsets = _offsets(alignment(samples), target)
    squares = dots(offsets, offsets)
    return float(np.sqrt(squares.mean())), alignment


def _with_normals(samples: SurfaceSamples) -> Floats:
    return np.hstack([samples.points, _NORMAL_WEIGHT * samples.normals])


def _subset(samples: SurfaceSamples, n: int) -> SurfaceSamples:
    """Return about n of the samples, at equal steps."""
    n_all = len(samples.points)
    steps = np.linspace(0, n_all - 1, min(n, n_all))
    chosen = steps.round().astype(np.int64)
    return SurfaceSamples(samples.points[chosen], samples.normals[chosen])


def _principal_starts(one: SurfaceSamples, other: SurfaceSamples) -> Floats:
    """Return the maps (8, 3, 3) of principal axes onto principal axes, with every choice of signs."""
    _, axes = np.linalg.eigh(np.cov(one.points.T))
    _, other_axes = np.linalg.eigh(np.cov(other.points.T))
    all_signs = product((1.0, -1.0), repeat=3)
    return np.stack([other_axes @ np.diag(signs) @ axes.T for signs in all_signs])


def _min_extent_ratio(samples: SurfaceSamples) -> float:
    """Return the smallest ratio of an extent to the next smaller one."""
    extents = np.maximum(samples.extents, 1e-9)
    return float((extents[1:] / extents[:-1]).min())


@cache
def _uniform_starts() -> Floats:
    """Return rotations (600, 3, 3) spread evenly, half of them with a reflection (super-Fibonacci, Alexa 2022)."""
    s = np.arange(_N_ROTATIONS) + 0.5
    phi = math.sqrt(2)
    psi = 1.533751168755204288118041
    r = np.sqrt(s / _N_ROTATIONS)
    big_r = np.sqrt(1 - s / _N_ROTATIONS)
    alpha = 2 * math.pi * s / phi
    beta = 2 * math.pi * s / psi
    quaternions = np.column_stack(
        [r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)]
    )
    rotations = Rotation.from_quat(quaternions).as_matrix()
    return np.concatenate([rotations, -rotations])

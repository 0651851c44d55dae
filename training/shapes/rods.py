"""Rods: centre lines that bend, and carry the surface around them.

A limb bends like a beam: its cross-sections keep their shape and rotate one after another. This preserves area and
volume as long as the bending radius exceeds the radius of the limb. A joint of 130 degrees is therefore not a hinge but
a stretch of the limb, which is longer for a thicker limb; a tentacle curls anywhere.

All rotations are about points of the centre lines at rest, in the frame at rest. The motion of an element of a rod is
the motion of the element before it, after the rotation between the two. Vertices follow the rods by dual quaternion
skinning, with weights that are diffused over the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps.mesh import surface
from igps.shapes.skeleton import Placed
from training.shapes.skinning import (
    IDENTITY,
    Motions,
    compose,
    normalized,
    rotations_about,
    transform,
)

MAX_ELEMENTS = 48
"""Largest number of elements of a rod."""

MAX_CURVATURE = 0.75
"""Largest ratio of the radius of a limb to its bending radius. At 1, the inner side would be a crease."""

# Width of the transition between the weights of two rods, over the radius of the rod.
_DIFFUSION_WIDTH = 0.45
# Two elements must not collide if their distance at rest exceeds this multiple of the sum of their radii. Nearer
# elements belong to the same crease.
_MIN_SEPARATION = 1.7


@dataclass(frozen=True)
class Joint:
    """A place where a rod bends."""

    position: float  # arc length along the rod
    axes: Floats  # (3,2) axes of raise and swing at rest
    low: Floats  # (2,) lower limits of the angles, radians
    high: Floats  # (2,) upper limits
    is_root: bool  # the rod bends beyond the joint instead of around it


@dataclass(frozen=True)
class Rod:
    """A centre line at rest, of n points. A rod of one point is rigid."""

    parent: int  # index of the rod that carries it; −1 for the first
    attachment: float  # arc length along the parent at which the rod is attached
    points: Floats  # (n,3) of the centre line
    arc_lengths: Floats  # (n,)
    radii: Floats  # (n,)
    # (n,) radii that limit bending: larger where a rigid solid sits on the rod
    bending_radii: Floats
    sides: Floats  # (n,3,2) two directions across the rod
    joints: tuple[Joint, ...] = ()
    curl: float = 0.0  # largest curl over the whole length, radians
    twist: float = 0.0  # largest twist over the whole length, radians
    is_hinge: bool = False  # the whole rod rotates about its first joint

    @property
    def length(self) -> float:
        return float(self.arc_lengths[-1])


@dataclass(frozen=True)
class Rig:
    """Rods, parents before children, and the index of the rod of each solid, (solids,)."""

    rods: tuple[Rod, ...]
    rod_of_solid: Integers


@dataclass(frozen=True)
class Binding:
    """Weights (V,R) of the rods for each vertex, and the arc lengths (V,R) of the vertex along each rod."""

    weights: Floats
    arc_lengths: Floats


def rod_motions(rig: Rig, turns: Sequence[Floats]) -> list[Motions]:
    """Return the motions (n,) of the elements of each rod in a pose, see `draw_turns`; element j starts at point j."""
    motions_of_rods: list[Motions] = []
    for rod, turn in zip(rig.rods, turns, strict=True):
        motion = IDENTITY
        if rod.parent >= 0:
            carrier = rig.rods[rod.parent]
            carried = motions_of_rods[rod.parent]
            motion = _interpolated(carrier, carried, np.array(rod.attachment))
        motions = []
        for step in zip(*rotations_about(rod.points, turn), strict=True):
            motion = compose(motion, Motions(*step))
            motions.append(motion)
        real, dual = map(np.array, zip(*motions, strict=True))
        motions_of_rods.append(normalized(Motions(real, dual)))
    return motions_of_rods


def bind(vertices: Floats, faces: Integers, rig: Rig, placed: Sequence[Placed]) -> Binding:
    """Bind vertices to the rods of their nearest solids; weights are diffused over the surface by implicit heat steps.

    Arc lengths are diffused together with the weights, which continues them smoothly onto neighbouring rods.
    """
    n_rods = len(rig.rods)
    if n_rods == 1:
        arc_lengths = projected(rig.rods[0], vertices)
        return Binding(np.ones((len(vertices), 1)), arc_lengths[:, None])
    distances = np.stack([solid.distance(*vertices.T) for solid in placed])
    nearest_solid = np.argmin(distances, axis=0)
    nearest = rig.rod_of_solid[nearest_solid]
    values = np.zeros((len(vertices), 2 * n_rods))
    width = np.zeros(len(vertices))
    for number, rod in enumerate(rig.rods):
        own = np.nonzero(nearest == number)[0]
        if not len(own):
            continue
        arc_lengths = projected(rod, vertices[own])
        values[own, number] = 1.0
        values[own, n_rods + number] = arc_lengths
        width[own] = np.interp(arc_lengths, rod.arc_lengths, rod.radii)
    diffused = _diffused(vertices, faces, values, _DIFFUSION_WIDTH * width)
    spread = diffused[:, :n_rods]
    weights = np.maximum(spread, 0.0)
    weights[weights < 1e-3] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    arc_lengths = diffused[:, n_rods:] / np.maximum(spread, 1e-6)
    lengths = np.array([rod.length for rod in rig.rods])
    arc_lengths = np.clip(arc_lengths, 0.0, lengths)
    return Binding(weights, arc_lengths)


def bend(
    vertices: Floats, rig: Rig, binding: Binding, motions_of_rods: Sequence[Motions]
) -> Floats:
    """Return the vertices (V,3) after the motions of the rods."""
    real = np.zeros((len(vertices), 4))
    dual = np.zeros((len(vertices), 4))
    for number, rod in enumerate(rig.rods):
        own = np.nonzero(binding.weights[:, number])[0]
        arc_lengths = binding.arc_lengths[own, number]
        motions = _interpolated(rod, motions_of_rods[number], arc_lengths)
        weights = binding.weights[own, number, None]
        real[own] += weights * motions.real
        dual[own] += weights * motions.dual
    return transform(normalized(Motions(real, dual)), vertices)


@dataclass(frozen=True)
class Gaps:
    """Pairs of elements that are apart at rest and must not collide, and the sum of the radii of each pair."""

    first: Integers
    second: Integers
    radius_sums: Floats

    @classmethod
    def of(cls, rig: Rig) -> Gaps:
        """Find the pairs of elements of all rods that are apart at rest."""
        points = np.concatenate([rod.points for rod in rig.rods])
        radii = np.concatenate([rod.radii for rod in rig.rods])
        offsets = points[:, None] - points[None]
        distance = np.sqrt((offsets**2).sum(axis=2))
        radius_sums = radii[:, None] + radii[None]
        is_apart = distance > _MIN_SEPARATION * radius_sums
        first, second = np.nonzero(np.triu(is_apart))
        return cls(first, second, radii[first] + radii[second])

    def smallest(self, rig: Rig, motions_of_rods: Sequence[Motions]) -> float:
        """Return the smallest gap in a pose: negative if elements overlap, infinite if there are no pairs."""
        pairs = zip(rig.rods, motions_of_rods, strict=True)
        points = np.concatenate([transform(motions, rod.points) for rod, motions in pairs])
        offsets = points[self.first] - points[self.second]
        distances = np.sqrt((offsets**2).sum(axis=1))
        gap = distances - self.radius_sums
        return float(gap.min(initial=np.inf))


def projected(rod: Rod, points: Floats) -> Floats:
    """Return the arc lengths (V,) of the projections of points (V,3) onto a rod."""
    if len(rod.arc_lengths) == 1:
        return np.zeros(len(points))
    _, nearest = cKDTree(rod.points).query(points)
    tangent = surface.unit(np.gradient(rod.points, axis=0))
    offsets = points - rod.points[nearest]
    ahead = (offsets * tangent[nearest]).sum(axis=1)
    step = rod.arc_lengths[1]
    ahead = np.clip(ahead, -step, step)
    return np.clip(rod.arc_lengths[nearest] + ahead, 0.0, rod.length)


def _interpolated(rod: Rod, motions: Motions, arc_lengths: Floats) -> Motions:
    """Motions at arc lengths (V,), interpolated between the two elements with the nearest midpoints."""
    n_elements = len(rod.arc_lengths)
    if n_elements == 1:
        shape = (*arc_lengths.shape, 4)
        real = np.broadcast_to(motions.real[0], shape)
        dual = np.broadcast_to(motions.dual[0], shape)
        return Motions(real, dual)
    position = arc_lengths / rod.arc_lengths[1] - 0.5
    position = np.clip(position, 0.0, n_elements - 1.0)
    lower = np.minimum(position.astype(np.int64), n_elements - 2)
    share = (position - lower)[..., None]
    blended = []
    for part in motions:
        blended.append((1.0 - share) * part[lower] + share * part[lower + 1])
    return normalized(Motions(*blended))


def _diffused(vertices: Floats, faces: Integers, values: Floats, width: Floats) -> Floats:
    """Values (V,C) after two implicit heat steps over the surface that spread them by about `width` (V,)."""
    corners = vertices[faces]
    edges = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    squared = np.einsum("fij,fij->fi", edges, edges)
    normals = np.cross(edges[:, 0], edges[:, 1])
    double_area = np.linalg.norm(normals, axis=1)[:, None]
    adjacent = squared.sum(axis=1, keepdims=True) - 2.0 * squared
    cotangents = adjacent / (2.0 * np.maximum(double_area, 1e-12))
    squared_width = (width[faces] ** 2).mean(axis=1)[:, None]
    # Weights of edges must be positive, so that no weight of a vertex becomes negative.
    conductance = np.maximum(cotangents, 0.02) * 0.25 * squared_width
    i = np.roll(faces, -1, axis=1).ravel()
    j = np.roll(faces, -2, axis=1).ravel()
    n = len(vertices)
    one_way = coo_array((conductance.ravel(), (i, j)), shape=(n, n)).tocsc()
    off_diagonal = one_way + one_way.T
    sums = np.asarray(off_diagonal.sum(axis=1)).ravel()
    mass = surface.vertex_areas(vertices, faces)
    diagonal = diags_array(mass + sums)
    solver = splu(
        (diagonal - off_diagonal).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    for _ in range(2):
        values = solver.solve(mass[:, None] * values)
    return values

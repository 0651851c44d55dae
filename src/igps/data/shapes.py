"""A generated benchmark of labelled, closed, articulated triangle meshes.

A class is a skeleton: a tree of solids, each with a signed distance function (negative inside), joined to its parent by
a ball joint with limits. The first classes are named templates, every further one is drawn from a grammar of skeletons.
A shape is one pose of its class: joint angles, proportions, resolution, surface noise and a rigid motion are drawn, the
solids are blended by a smooth union and the zero level set is meshed by marching cubes (Lewiner, Lopes, Vieira and
Tavares 2003), relaxed along the surface and checked.

Directions: z is up, y points backwards. A limb runs along its own +z; a joint's limits are degrees about its own x
(raise), y (swing) and z (twist).
"""

from __future__ import annotations

import itertools
import json
import logging
import operator
import os
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from tqdm import tqdm

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
Vector = tuple[float, float, float]

_VERSION = 1  # raised whenever the same arguments would give other meshes
_MAX_ATTEMPTS = 20
_TRIAL_VERTICES = 3000  # the same whatever resolution is asked for: a class does not depend on it
_MIN_ANGLE = 5.0  # degrees; keeps every cotangent below 11.5
_VERTEX_TOLERANCE = 0.4
_COARSE_CELLS = 30_000
_SNAP = 0.1  # grid values closer to zero than this share of the spacing move away from it
_RELAXATION_STEPS = 10
_POSE, _MOTION, _CLASS, _FAMILY, _TRIAL = range(5)  # what a random stream is for: keeps the streams of one seed apart

_log = logging.getLogger(__name__)


# --------------------------------------------------------------------------------------------------------------- solids


class _Solid(ABC):
    """A solid in its own frame, given by a signed distance function."""

    @property
    def genus(self) -> int:
        """The number of handles of the solid's surface."""
        return 0

    @abstractmethod
    def distance(self, x: Array, y: Array, z: Array) -> Array:
        """The signed distance (exact or a good approximation), negative inside."""

    @abstractmethod
    def box(self) -> tuple[Array, Array]:
        """The lower and upper corner of a box around the solid."""

    @abstractmethod
    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        """The solid with other proportions, and the factors (3,) by which points fixed to it move."""


@dataclass(frozen=True)
class _Cone(_Solid):
    """A tapered capsule: spheres of radius ``start`` at the origin to ``end`` at (0, 0, length)."""

    length: float
    start: float
    end: float

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        radial = np.hypot(x, y)
        slope = (self.start - self.end) / self.length
        # The nearest sphere of a tapered sweep lies off the perpendicular foot by the taper's tilt.
        along = np.clip(z - radial * (slope / np.sqrt(1.0 - slope * slope)), 0.0, self.length)
        return np.hypot(radial, z - along) - (self.start - slope * along)

    def box(self) -> tuple[Array, Array]:
        wide = max(self.start, self.end)
        return np.array([-wide, -wide, -self.start]), np.array([wide, wide, self.length + self.end])

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        return _Cone(self.length * length, self.start * thick, self.end * thick), np.array([thick, thick, length])


@dataclass(frozen=True)
class _Arc(_Solid):
    """A bent tube: from the origin along +z, turning by ``angle`` radians towards +y on a circle of radius ``bend``."""

    bend: float
    angle: float
    start: float
    end: float

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        turned = np.arctan2(z, self.bend - y) - 0.5 * self.angle
        turned = np.mod(turned + np.pi, 2.0 * np.pi) - np.pi
        turned = np.clip(turned, -0.5 * self.angle, 0.5 * self.angle) + 0.5 * self.angle
        centre_y, centre_z = self.bend * (1.0 - np.cos(turned)), self.bend * np.sin(turned)
        tube = self.start + (self.end - self.start) / self.angle * turned
        return np.sqrt(x * x + (y - centre_y) ** 2 + (z - centre_z) ** 2) - tube

    def box(self) -> tuple[Array, Array]:
        wide = max(self.start, self.end)
        turned = np.linspace(0.0, self.angle, 33)
        y, z = self.bend * (1.0 - np.cos(turned)), self.bend * np.sin(turned)
        slack = wide + 0.01 * self.bend
        return np.array([-wide, y.min() - slack, z.min() - slack]), np.array([wide, y.max() + slack, z.max() + slack])

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        return _Arc(self.bend * length, self.angle, self.start * thick, self.end * thick), np.full(3, length)

    def tip(self) -> Vector:
        """The far end of the centre line."""
        return (0.0, self.bend * (1.0 - np.cos(self.angle)), self.bend * np.sin(self.angle))


@dataclass(frozen=True)
class _Ring(_Solid):
    """A torus in the x-z plane around the y axis, drawn out along z by straight sides of half length ``side``."""

    radius: float
    tube: float
    side: float = 0.0

    @property
    def genus(self) -> int:
        return 1

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        return np.hypot(np.hypot(x, np.maximum(np.abs(z) - self.side, 0.0)) - self.radius, y) - self.tube

    def box(self) -> tuple[Array, Array]:
        wide = self.radius + self.tube
        upper = np.array([wide, self.tube, wide + self.side])
        return -upper, upper

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        return _Ring(self.radius * length, self.tube * thick, self.side * length), np.full(3, length)


@dataclass(frozen=True)
class _Blob(_Solid):
    """An ellipsoid around the origin."""

    radii: Vector

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        a, b, c = self.radii
        unit = np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
        gradient = np.sqrt((x / a**2) ** 2 + (y / b**2) ** 2 + (z / c**2) ** 2)
        # First order in the distance from the surface; the floor keeps the centre finite and inside.
        return unit * (unit - 1.0) / np.maximum(gradient, 1e-9) - 1e-12

    def box(self) -> tuple[Array, Array]:
        return -np.array(self.radii), np.array(self.radii)

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        a, b, c = self.radii
        return _Blob((a * thick, b * thick, c * length)), np.array([thick, thick, length])


@dataclass(frozen=True)
class _Box(_Solid):
    """A box around the origin with edges rounded to radius ``rounding``."""

    size: Vector
    rounding: float

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        a, b, c = (np.abs(q) - (0.5 * s - self.rounding) for q, s in zip((x, y, z), self.size, strict=True))
        outside = np.sqrt(np.maximum(a, 0.0) ** 2 + np.maximum(b, 0.0) ** 2 + np.maximum(c, 0.0) ** 2)
        return outside + np.minimum(np.maximum(np.maximum(a, b), c), 0.0) - self.rounding

    def box(self) -> tuple[Array, Array]:
        return -0.5 * np.array(self.size), 0.5 * np.array(self.size)

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        a, b, c = self.size
        rounding = self.rounding * min(thick, length)
        return _Box((a * thick, b * thick, c * length), rounding), np.array([thick, thick, length])


@dataclass(frozen=True)
class _Prism(_Solid):
    """A regular prism or plate around the z axis: ``sides`` corners at ``radius``, ``height`` high, rounded edges."""

    sides: int
    radius: float
    height: float
    rounding: float

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        sector = np.pi / self.sides
        folded = np.mod(np.arctan2(y, x), 2.0 * sector) - sector
        radial = np.hypot(x, y)
        radius = self.radius - self.rounding / np.cos(sector)
        across = radial * np.cos(folded) - radius * np.cos(sector)
        past_corner = np.maximum(radial * np.abs(np.sin(folded)) - radius * np.sin(sector), 0.0)
        a = np.where(across > 0.0, np.hypot(across, past_corner), across)
        b = np.abs(z) - (0.5 * self.height - self.rounding)
        return np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0)) + np.minimum(np.maximum(a, b), 0.0) - self.rounding

    def box(self) -> tuple[Array, Array]:
        upper = np.array([self.radius, self.radius, 0.5 * self.height])
        return -upper, upper

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        rounding = self.rounding * min(thick, length)
        prism = _Prism(self.sides, self.radius * thick, self.height * length, rounding)
        return prism, np.array([thick, thick, length])


@dataclass(frozen=True)
class _Shell(_Solid):
    """A hollow body of revolution around z: a wall ``wall`` thick along the polyline ``profile`` of (radius, z)."""

    profile: tuple[tuple[float, float], ...]
    wall: float

    @property
    def genus(self) -> int:
        return 0 if self.profile[0][0] == 0.0 else 1  # a profile that starts off the axis is a tube, open at both ends

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        radial = np.hypot(x, y)
        squared = np.full(radial.shape, np.inf)
        for (r0, z0), (r1, z1) in itertools.pairwise(self.profile):
            dr, dz = r1 - r0, z1 - z0
            along = np.clip(((radial - r0) * dr + (z - z0) * dz) / (dr * dr + dz * dz), 0.0, 1.0)
            np.minimum(squared, (radial - r0 - along * dr) ** 2 + (z - z0 - along * dz) ** 2, out=squared)
        return np.sqrt(squared) - 0.5 * self.wall

    def box(self) -> tuple[Array, Array]:
        radii, heights = np.array(self.profile).T
        wide = radii.max() + 0.5 * self.wall
        low, high = heights.min() - 0.5 * self.wall, heights.max() + 0.5 * self.wall
        return np.array([-wide, -wide, low]), np.array([wide, wide, high])

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        profile = tuple((r * thick, z * length) for r, z in self.profile)
        return _Shell(profile, self.wall * thick), np.array([thick, thick, length])


@dataclass(frozen=True)
class _Frame(_Solid):
    """A tube of radius ``tube`` along a regular polygon around z with corners at ``radius``."""

    sides: int
    radius: float
    tube: float

    @property
    def genus(self) -> int:
        return 1

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        sector = np.pi / self.sides
        folded = np.mod(np.arctan2(y, x), 2.0 * sector) - sector
        radial = np.hypot(x, y)
        across = radial * np.cos(folded) - self.radius * np.cos(sector)
        past_corner = np.maximum(radial * np.abs(np.sin(folded)) - self.radius * np.sin(sector), 0.0)
        return np.sqrt(across * across + past_corner * past_corner + z * z) - self.tube

    def box(self) -> tuple[Array, Array]:
        upper = np.array([self.radius + self.tube, self.radius + self.tube, self.tube])
        return -upper, upper

    def stretched(self, thick: float, length: float) -> tuple[_Solid, Array]:
        return _Frame(self.sides, self.radius * length, self.tube * thick), np.full(3, length)


# ------------------------------------------------------------------------------------------------------------ skeletons


@dataclass(frozen=True)
class _Part:
    """A solid and the joint that holds it: where on the parent, which way at rest, how far it bends (degrees)."""

    solid: _Solid
    at: Vector = (0.0, 0.0, 0.0)
    turn: Array = field(default_factory=lambda: np.eye(3))
    bend: Vector = (0.0, 0.0, 0.0)
    group: str = "body"  # parts of one group share their proportions
    blend: float = 0.06
    lift: float = 0.0  # how far the solid's own origin lies along z from the joint
    children: tuple[_Part, ...] = ()

    def walk(self) -> Iterator[_Part]:
        """This part and all below it."""
        yield self
        for child in self.children:
            yield from child.walk()


@dataclass(frozen=True)
class _ShapeClass:
    """A class: its name, its skeleton, and the handles made by limbs that meet again."""

    name: str
    root: _Part
    loops: int = 0

    @property
    def genus(self) -> int:
        """The number of handles of every shape of the class."""
        return self.loops + sum(part.solid.genus for part in self.root.walk())


@dataclass(frozen=True)
class _Placed:
    """A solid in the world: ``world = rotation @ local + offset``."""

    solid: _Solid
    rotation: Array
    offset: Array
    blend: float

    def distance(self, x: Array, y: Array, z: Array) -> Array:
        # Written out: a library product may sum in another order on another number of threads.
        r, (a, b, c) = self.rotation, self.offset
        x, y, z = x - a, y - b, z - c
        return self.solid.distance(*(r[0, i] * x + r[1, i] * y + r[2, i] * z for i in range(3)))

    def bounds(self) -> tuple[Array, Array]:
        low, high = self.solid.box()
        centre = (self.rotation * (0.5 * (low + high))).sum(axis=1) + self.offset
        half = (np.abs(self.rotation) * (0.5 * (high - low))).sum(axis=1)
        return centre - half, centre + half


def _aim(heading: Vector) -> Array:
    """A rotation that takes +z to ``heading``, with x level (x itself where the heading is steep)."""
    z = np.array(heading) / np.linalg.norm(heading)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z if abs(z[2]) > 0.9 else np.array([-z[1], z[0], 0.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _limb(
    lengths: Sequence[float],
    radii: Sequence[float],
    bends: Sequence[Vector],
    group: str,
    at: Vector = (0.0, 0.0, 0.0),
    heading: Vector = (0.0, 0.0, 1.0),
    knee: Vector = (0.0, 0.0, 1.0),
    tip: tuple[_Part, ...] = (),
    roll: float = 0.0,
) -> _Part:
    """A chain of tapered capsules; ``knee`` is the heading of each later segment in the frame of the one before."""
    children = tip
    for i in reversed(range(len(lengths))):
        first = i == 0
        turn = _aim(heading) @ Rotation.from_euler("z", roll).as_matrix() if first else _aim(knee)
        cone = _Cone(lengths[i], radii[i], radii[i + 1])
        place = at if first else (0.0, 0.0, lengths[i - 1])
        children = (_Part(cone, place, turn, bends[min(i, len(bends) - 1)], group, 0.5 * radii[i], 0.0, children),)
    return children[0]


def _pose(shape_class: _ShapeClass, rng: np.random.Generator, flex: float, rotation: Array) -> list[_Placed]:
    """Draw proportions and joint angles (``flex`` times the limits) and place every solid."""
    proportions: dict[str, tuple[float, float]] = {}
    placed: list[_Placed] = []

    def place(part: _Part, frame: Array, origin: Array) -> None:
        if part.group not in proportions:
            thick, length = np.exp(rng.uniform(-1.0, 1.0, 2) * (0.1, 0.13))
            proportions[part.group] = (float(thick), float(length))
        joint = Rotation.from_euler("xyz", flex * np.array(part.bend) * rng.uniform(-1.0, 1.0, 3), degrees=True)
        frame = frame @ part.turn @ joint.as_matrix()
        solid, factors = part.solid.stretched(*proportions[part.group])
        placed.append(_Placed(solid, frame, origin + frame[:, 2] * (part.lift * factors[2]), part.blend))
        for child in part.children:
            place(child, frame, origin + frame @ (factors * np.array(child.at)))

    place(shape_class.root, rotation, np.zeros(3))
    return placed


# ------------------------------------------------------------------------------------------------------------ templates


def _biped() -> _ShapeClass:
    foot = _limb([0.22], [0.11, 0.1], [(12, 8, 0)], "foot", (0, 0, 0.52), (0, 1, 0.1))
    arms, legs = [], []
    for s in (-1.0, 1.0):
        hand = _Part(_Blob((0.14, 0.11, 0.17)), (0, 0, 0.42), group="hand", bend=(15, 15, 0), lift=0.08)
        arms.append(
            _limb(
                [0.44, 0.42],
                [0.13, 0.11, 0.1],
                [(40, 30, 0), (35, 15, 0)],
                "arm",
                (0.3 * s, 0, 0.72),
                (s, -0.15, -0.35),
                (0, -0.15, 1),
                (hand,),
            )
        )
        legs.append(
            _limb(
                [0.55, 0.52],
                [0.17, 0.13, 0.11],
                [(28, 8, 0), (25, 0, 0)],
                "leg",
                (0.17 * s, 0, -0.02),
                (0.2 * s, 0, -1),
                (0, -0.12, 1),
                (foot,),
            )
        )
    head = _Part(_Blob((0.21, 0.24, 0.27)), (0, 0, 0.85), bend=(20, 15, 0), group="head", lift=0.3)
    neck = _limb([0.2], [0.12, 0.11], [(5, 5, 0)], "neck", (0, 0, 0.8))
    return _ShapeClass("biped", _Part(_Cone(0.75, 0.25, 0.29), children=(neck, head, *arms, *legs)))


def _quadruped() -> _ShapeClass:
    head = _limb([0.32], [0.18, 0.12], [(20, 15, 0)], "head", (0, 0, 0.42), (0, -1, 0.35))
    ears = tuple(
        _limb([0.2], [0.09, 0.08], [(10, 10, 0)], "ear", (0.1 * s, 0, 0.5), (0.5 * s, 0.2, 1)) for s in (-1, 1)
    )
    neck = _limb([0.42], [0.19, 0.15], [(18, 15, 0)], "neck", (0, -0.55, 0.08), (0, -0.8, 1), tip=(head, *ears))
    tail = _limb([0.3, 0.3], [0.1, 0.09, 0.08], [(20, 25, 0)], "tail", (0, 0.62, 0.1), (0, 1, 0.1))
    legs = [
        _limb(
            [0.42, 0.42],
            [0.15, 0.11, 0.1],
            [(22, 6, 0), (22, 0, 0)],
            f"leg{y}",
            (0.18 * s, y, -0.12),
            (0.12 * s, 0, -1),
            (0, 0.15, 1),
        )
        for s in (-1, 1)
        for y in (-0.48, 0.48)
    ]
    return _ShapeClass("quadruped", _Part(_Blob((0.29, 0.75, 0.31)), children=(neck, tail, *legs)))


def _octopus() -> _ShapeClass:
    arms = [
        _limb(
            [0.42, 0.4, 0.38],
            [0.16, 0.13, 0.1, 0.08],
            [(18, 8, 0), (28, 18, 0), (35, 25, 0)],
            "arm",
            (0.24 * c, 0.24 * s, 0.0),
            (c, s, -0.35),
            (0, 0.12, 1),
        )
        for c, s in _circle(8)
    ]
    return _ShapeClass("octopus", _Part(_Blob((0.4, 0.4, 0.52)), lift=0.25, blend=0.1, children=tuple(arms)))


def _spider() -> _ShapeClass:
    abdomen = _Part(_Blob((0.4, 0.48, 0.36)), (0, 0.62, 0.08), bend=(8, 0, 6), group="abdomen")
    legs = [
        _limb(
            [0.5, 0.75],
            [0.1, 0.09, 0.08],
            [(12, 5, 0), (14, 6, 0)],
            "leg",
            (0.16 * s, y, 0),
            (s, 4.0 * y, 0.9),
            (0, -3, 0.5),
        )
        for s in (-1, 1)
        for y in (-0.27, -0.09, 0.09, 0.27)
    ]
    fangs = [
        _limb([0.22], [0.09, 0.08], [(15, 10, 0)], "fang", (0.1 * s, -0.25, 0), (0.3 * s, -1, -0.4)) for s in (-1, 1)
    ]
    return _ShapeClass("spider", _Part(_Blob((0.27, 0.36, 0.22)), children=(abdomen, *legs, *fangs)))


def _hand() -> _ShapeClass:
    fingers = [
        _limb(
            [0.3 * k, 0.24 * k, 0.2 * k],
            [0.115, 0.105, 0.1, 0.095],
            [(16, 4, 0), (22, 0, 0)],
            "finger",
            (x, 0, 0.36),
            (0.5 * x, -0.15, 1),
            (0, -0.2, 1),
        )
        for x, k in ((-0.45, 0.9), (-0.15, 1.1), (0.15, 1.15), (0.45, 0.95))
    ]
    thumb = _limb(
        [0.34, 0.26], [0.14, 0.12, 0.11], [(20, 12, 0), (20, 0, 0)], "thumb", (-0.45, 0, -0.2), (-1, -0.3, 0.5)
    )
    wrist = _limb([0.35], [0.24, 0.22], [(15, 15, 0)], "wrist", (0, 0, -0.35), (0, 0, -1))
    return _ShapeClass("hand", _Part(_Box((1.16, 0.32, 0.9), 0.14), children=(*fingers, thumb, wrist)))


def _snake() -> _ShapeClass:
    head = _Part(_Blob((0.19, 0.13, 0.24)), (0, 0, 0.34), bend=(15, 15, 0), group="head", lift=0.12)
    radii = [0.07, 0.1, 0.12, 0.14, 0.15, 0.15, 0.14, 0.12, 0.1]
    return _ShapeClass(
        "snake", _limb([0.34] * 8, radii, [(0, 0, 0), (10, 46, 0)], "body", heading=(1, 0, 0), tip=(head,))
    )


def _plier() -> _ShapeClass:
    arms = []
    for s in (-1.0, 1.0):
        handle = _Arc(2.3, 0.55, 0.13, 0.11)
        grip = _Part(
            handle, turn=_aim((0, 0, -1)) @ Rotation.from_euler("z", -90 * s, degrees=True).as_matrix(), group="grip"
        )
        turn = Rotation.from_euler("y", 26 * s, degrees=True).as_matrix()
        arms.append(_Part(_Cone(0.62, 0.17, 0.09), turn=turn, bend=(0, 9, 0), group="jaw", children=(grip,)))
    return _ShapeClass("plier", _Part(_Blob((0.22, 0.16, 0.22)), children=tuple(arms)))


def _mug() -> _ShapeClass:
    turn = _aim((1, 0, 0))
    handle = _Part(_Arc(0.29, np.pi, 0.1, 0.1), (0.48, 0, 0.26), turn, (0, 6, 0), "handle", 0.05)
    return _ShapeClass("mug", _Part(_Shell(((0, 0), (0.48, 0), (0.5, 1.1)), 0.19), children=(handle,)), loops=1)


def _glasses() -> _ShapeClass:
    rims = [
        _Part(
            _Ring(0.36, 0.1),
            (0.5 * s, 0, 0),
            bend=(4, 6, 0),
            children=(
                _limb(
                    [0.55, 0.5, 0.2],
                    [0.1, 0.09, 0.09, 0.09],
                    [(8, 18, 0), (4, 8, 0), (5, 5, 0)],
                    "temple",
                    (0.38 * s, 0, 0),
                    (0.1 * s, 1, 0.0),
                    (0, -0.12, 1),
                ),
            ),
        )
        for s in (-1, 1)
    ]
    return _ShapeClass("glasses", _Part(_Blob((0.2, 0.1, 0.1)), group="bridge", children=tuple(rims)))


def _chair() -> _ShapeClass:
    legs = [
        _limb([0.75], [0.1, 0.09], [(8, 8, 0)], "leg", (0.36 * a, 0.36 * b, 0), (0.1 * a, 0.1 * b, -1))
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    back = _Part(_Box((0.9, 0.18, 0.95), 0.07), (0, 0.38, 0), bend=(14, 4, 4), group="back", lift=0.45)
    return _ShapeClass("chair", _Part(_Box((0.95, 0.95, 0.18), 0.07), children=(back, *legs)))


def _fish() -> _ShapeClass:
    lobes = tuple(
        _Part(_Blob((0.09, 0.15, 0.34)), (0, 0, 0.28), _aim((0, 0.75 * s, 1)), (12, 8, 0), "fluke", lift=0.22)
        for s in (-1, 1)
    )
    tail = _limb([0.34, 0.28], [0.22, 0.15, 0.11], [(8, 22, 0), (8, 25, 0)], "tail", (0, 0.45, 0), (0, 1, 0), tip=lobes)
    dorsal = _Part(_Blob((0.09, 0.34, 0.24)), (0, 0.0, 0.32), bend=(8, 8, 0), group="dorsal", lift=0.1)
    fins = [
        _Part(_Blob((0.16, 0.08, 0.3)), (0.16 * s, -0.25, -0.14), _aim((s, 0.6, -0.45)), (20, 20, 0), "fin", lift=0.22)
        for s in (-1, 1)
    ]
    return _ShapeClass("fish", _Part(_Blob((0.23, 0.72, 0.4)), blend=0.05, children=(tail, dorsal, *fins)))


def _bird() -> _ShapeClass:
    beak = _limb([0.25], [0.1, 0.07], [(8, 8, 0)], "beak", (0, 0, 0.28), (0, -1, 0.35))
    head = _Part(_Blob((0.18, 0.19, 0.18)), (0, 0, 0.28), bend=(15, 15, 0), group="head")
    neck = _limb([0.28], [0.16, 0.13], [(15, 15, 0)], "neck", (0, -0.48, 0.12), (0, -0.9, 0.8), tip=(head, beak))
    wings = []
    for s in (-1, 1):
        outer = _Part(_Blob((0.24, 0.085, 0.42)), (0, 0, 0.55), bend=(25, 10, 0), group="wing", lift=0.32)
        wings.append(
            _Part(
                _Blob((0.3, 0.1, 0.42)),
                (0.15 * s, 0, 0.08),
                _aim((s, 0.1, 0.15)),
                (30, 10, 0),
                "wing",
                lift=0.32,
                children=(outer,),
            )
        )
    tail = _Part(_Blob((0.26, 0.09, 0.36)), (0, 0.52, 0), _aim((0, 1, 0.1)), (15, 12, 0), "tail", lift=0.26)
    return _ShapeClass("bird", _Part(_Blob((0.26, 0.62, 0.26)), children=(neck, tail, *wings)))


_TEMPLATES: tuple[Callable[[], _ShapeClass], ...] = (
    _biped,
    _quadruped,
    _octopus,
    _spider,
    _hand,
    _snake,
    _plier,
    _mug,
    _glasses,
    _chair,
    _fish,
    _bird,
)


# -------------------------------------------------------------------------------------------------------------- grammar


def _circle(count: int, phase: float = 0.0) -> list[tuple[float, float]]:
    """Equally spaced points (cos, sin) of the unit circle."""
    return [(float(np.cos(a)), float(np.sin(a))) for a in phase + 2.0 * np.pi * np.arange(count) / count]


def _ending(kind: str, r: float, at: Vector, turn: Array, group: str) -> tuple[_Part, ...]:
    """What sits at the end of a limb of radius ``r``."""

    def part(solid: _Solid, lift: float, *, aim: Vector = (0, 0, 1)) -> _Part:
        return _Part(solid, at, turn @ _aim(aim), (14, 10, 0), f"{group}-{kind}", 0.4 * r, lift)

    match kind:
        case "plain":
            return ()
        case "knob":
            return (part(_Blob((2.0 * r, 2.0 * r, 2.1 * r)), 1.5 * r),)
        case "ring":
            return (part(_Ring(2.6 * r, 0.9 * r), 2.8 * r),)
        case "paddle":
            return (part(_Box((4.6 * r, 1.7 * r, 5.2 * r), 0.6 * r), 2.4 * r),)
        case "fork":
            return tuple(part(_Cone(4.2 * r, 0.95 * r, 0.85 * r), 0.0, aim=(s, 0, 1.1)) for s in (-1, 1))
        case "claw":
            return tuple(part(_Cone(3.6 * r, 0.95 * r, 0.85 * r), 0.0, aim=(c, s, 0.7)) for c, s in _circle(3))
        case "hook":
            return (part(_Arc(2.2 * r, 3.2, 0.95 * r, 0.85 * r), 0.0),)
        case "hammer":
            return (part(_Box((7.0 * r, 2.6 * r, 2.6 * r), 0.7 * r), 0.8 * r),)
        case "disc":
            return (part(_Prism(16, 3.2 * r, 1.8 * r, 0.6 * r), 0.4 * r),)
        case "cup":
            angles = np.linspace(0.0, 1.7, 7)
            bowl = tuple((float(3.2 * r * np.sin(a)), float(3.2 * r * (1.0 - np.cos(a)))) for a in angles)
            return (part(_Shell(bowl, 1.5 * r), 0.6 * r),)
    raise AssertionError(kind)


@dataclass(frozen=True)
class _LimbStyle:
    """What the limbs of one class have in common."""

    kind: str
    ending: str
    length: float
    start: float
    end: float
    curl: float  # radians; of a bent tube's sweep, or of a jointed limb's knee
    swing: float  # degrees

    @classmethod
    def draw(
        cls, g: np.random.Generator, kind: str, ending: str, length: float, radius: float, swing: float = 14.0
    ) -> _LimbStyle:
        """Draw the proportions around the given ones."""
        start = radius * g.uniform(0.95, 1.25)
        curl = g.uniform(0.8, 1.6) if kind == "bent" else g.choice([-1.0, 1.0]) * g.uniform(0.2, 0.9)
        return cls(kind, ending, length * g.uniform(0.8, 1.25), start, start * g.uniform(0.62, 0.95), curl, swing)

    def grow(self, at: Vector, heading: Vector, group: str = "limb", roll: float = 0.0) -> _Part:
        """One limb; ``roll`` turns its plane of bending around its own axis."""
        limits: list[Vector] = [(self.swing, 0.6 * self.swing, 0), (1.6 * self.swing, self.swing, 0)]
        if self.kind == "bent":
            arc = _Arc(self.length / self.curl, self.curl, self.start, self.end)
            turned = Rotation.from_euler("x", -self.curl).as_matrix()
            children = _ending(self.ending, self.end, arc.tip(), turned, group)
            turn = _aim(heading) @ Rotation.from_euler("z", roll).as_matrix()
            return _Part(arc, at, turn, limits[0], group, 0.5 * self.start, 0.0, children)
        count = {"stub": 1, "straight": 1, "jointed": 2, "tentacle": 3}[self.kind]
        length = self.length * (0.3 if self.kind == "stub" else 1.0) / count
        children = _ending(self.ending, self.end, (0, 0, length), np.eye(3), group)
        radii = np.linspace(self.start, self.end, count + 1).tolist()
        knee = (0.0, float(np.sin(self.curl)), float(np.cos(self.curl)))
        if self.kind == "tentacle":
            knee = (0.0, float(np.sin(0.5 * self.curl)), float(np.cos(0.5 * self.curl)))
        return _limb([length] * count, radii, limits, group, at, heading, knee, children, roll)


_Skeleton = tuple[_Part, int]


def _star(g: np.random.Generator, core: str, n: int, kind: str, ending: str) -> _Skeleton:
    """Limbs around a hub, with n-fold symmetry."""
    style = _LimbStyle.draw(g, kind, ending, float(np.clip(6.5 / n, 0.8, 1.4)), 0.13)
    radius = max(0.36, 0.5 * n * style.start) * g.uniform(0.95, 1.3)
    rise = g.uniform(-0.8, 0.8)
    roll = g.choice([0.0, 0.5 * np.pi, np.pi]) if kind == "bent" else 0.0
    solid: _Solid
    match core:
        case "orb":
            solid, seat = _Blob((radius, radius, radius * g.uniform(0.7, 1.3))), 0.75 * radius
        case "disc":
            solid, seat = _Prism(24, radius, 0.3, 0.1), 0.85 * radius
        case "hoop":
            solid, seat, rise = _Frame(24, radius * 1.15, 0.14), 1.15 * radius, max(rise, -0.3)
        case "drum":
            solid, seat = _Shell(((radius, -0.4), (radius, 0.4)), 0.2), radius
        case _:
            solid, seat = _Prism(n, radius * 1.2, 0.35 * g.uniform(0.9, 2.0), 0.08), 0.95 * radius
    limbs = tuple(style.grow((seat * c, seat * s, 0), (c, s, rise), roll=roll) for c, s in _circle(n))
    return _Part(solid, children=limbs), 0


def _tree(g: np.random.Generator, branches: int, twigs: int, ending: str, base: str) -> _Skeleton:
    """A trunk that branches once or twice."""
    twig = _LimbStyle.draw(g, "straight", ending, 0.42 if twigs else 0.3, 0.1, 10.0)
    rise, spread = g.uniform(0.2, 1.3), g.uniform(0.6, 1.0)
    length = g.uniform(0.4, 0.75)
    tops = []
    for c, s in _circle(branches, g.uniform(0, np.pi)):
        crown: tuple[_Part, ...] = tuple(
            twig.grow((0, 0, length), (spread * a, spread * b, 0.9), "twig") for a, b in _circle(twigs, 0.5)
        )
        crown = crown or _ending(ending, 0.11, (0, 0, length), np.eye(3), "twig")
        tops.append((c, s, crown))
    height = g.uniform(0.6, 1.3)
    limbs = [
        _limb([length], [0.14, 0.11], [(12, 9, 0)], "branch", (0, 0, height), (c, s, rise), tip=crown)
        for c, s, crown in tops
    ]
    match base:
        case "plate":
            limbs.append(_Part(_Prism(int(g.choice([3, 4, 6, 24])), g.uniform(0.4, 0.6), 0.22, 0.08), group="base"))
        case "bulb":
            limbs.append(_Part(_Blob((0.38, 0.38, g.uniform(0.3, 0.5))), group="base"))
        case "tripod":
            limbs += [_limb([0.5], [0.13, 0.1], [(8, 8, 0)], "root", (0, 0, 0.03), (c, s, -0.5)) for c, s in _circle(3)]
    return _Part(_Cone(height, 0.18, 0.15), group="trunk", bend=(0, 0, 0), children=tuple(limbs)), 0


def _beast(g: np.random.Generator, pairs: int, stance: str, head: str, tail: str) -> _Skeleton:
    """A body with pairs of legs, a head and a tail: bilateral symmetry."""
    half = 0.3 + 0.15 * pairs * g.uniform(0.9, 1.25)
    girth = g.uniform(0.22, 0.36)
    style = _LimbStyle.draw(
        g,
        {"fins": "straight", "stand": "jointed", "sprawl": "jointed"}[stance],
        "paddle" if stance == "fins" else "plain",
        0.85 if stance != "fins" else 0.4,
        0.12,
        10.0,
    )
    style = replace(style, curl=0.3 if stance == "stand" else -abs(style.curl) - 0.3)
    limbs = []
    for y in np.linspace(-0.72, 0.72, pairs) * half if pairs > 1 else [-0.2 * half]:
        room = girth * np.sqrt(1.0 - (y / half) ** 2)
        for s in (-1, 1):
            if stance == "stand":
                limbs.append(style.grow((0.62 * s * room, y, -0.4 * room), (0.2 * s, 0.0, -1.0)))
            else:
                limbs.append(style.grow((0.6 * s * room, y, 0.0), (s, 0.5 * y / half, 0.25)))
    front, back = (0.0, -0.85 * half, 0.1 * girth), (0.0, 0.88 * half, 0.1 * girth)
    neck = g.uniform(0.2, 0.35) if head != "long" else g.uniform(0.7, 0.9)
    rise = g.uniform(0.2, 1.2)
    top = (0.0, 0.0, neck)
    kind = {"horned": "fork", "bill": "paddle", "looped": "ring", "round": "knob", "long": "knob"}[head]
    limbs.append(
        _limb(
            [neck],
            [0.16, 0.12],
            [(16, 14, 0)],
            "neck",
            front,
            (0, -1, rise),
            tip=_ending(kind, 0.13 if head != "long" else 0.1, top, _aim((0, -0.3, 1)), "head"),
        )
    )
    if tail != "bare":
        shape = _LimbStyle.draw(
            g,
            "tentacle" if tail == "whip" else "straight",
            {"whip": "plain", "fluke": "paddle", "loop": "ring", "club": "knob"}[tail],
            0.9 if tail == "whip" else 0.4,
            0.12,
            16.0,
        )
        limbs.append(shape.grow(back, (0, 1, g.uniform(0.0, 0.8)), "tail"))
    return _Part(_Blob((girth * g.uniform(0.9, 1.3), half, girth)), children=tuple(limbs)), 0


def _chain(g: np.random.Generator, n: int, link: str, ending: str) -> _Skeleton:
    """Links in a row, with a joint between any two."""
    radius = g.uniform(0.22, 0.3)
    stiff = link in ("boxes", "plates", "tubes")  # edges of neighbours must not meet when the chain bends
    gap = g.uniform(0.08, 0.2) + {"boxes": 0.12, "plates": 0.16, "tubes": 0.14}.get(link, 0.0)
    bow = g.uniform(-8.0, 8.0) if stiff else g.uniform(-16.0, 16.0)
    side = g.uniform(0.0, 0.25)
    children: tuple[_Part, ...] = _ending(ending, 0.12, (0, 0, 0.0), np.eye(3), "end")
    for i in range(n):
        solid: _Solid
        long = 2.0 * radius
        match link:
            case "beads":
                solid = _Blob((radius, radius, radius))
            case "boxes":
                solid = _Box((1.8 * radius, 1.8 * radius, 2.0 * radius), 0.05)
            case "plates":
                solid, long = _Prism(24, 1.5 * radius, 0.22, 0.08), 0.2
            case "tubes":
                solid, long = _Prism(3, 1.5 * radius, 1.5 * radius, 0.05), 1.5 * radius
            case "shrinking":
                scale = 1.25 * 0.86**i
                solid, long = _Blob((scale * radius,) * 3), 2.0 * scale * radius
            case _:
                solid, long = _Ring(radius * 1.15, 0.11, side), 2.0 * (radius * 1.15 + side)
        quarter = 0.5 * np.pi if link == "crossed" else 0.0
        turn = Rotation.from_euler("z", quarter).as_matrix() @ Rotation.from_euler("x", bow, degrees=True).as_matrix()
        bridge = gap if link not in ("rings", "crossed") else 0.0
        children = tuple(replace(c, at=(0, 0, long + bridge)) for c in children)
        if bridge:
            children += (_Part(_Cone(bridge + 0.2, 0.11, 0.11), (0, 0, long - 0.1), group="bridge"),)
        limit = 10.0 if stiff else 16.0
        children = (_Part(solid, (0, 0, 0), turn, (limit, limit, 0), "link", 0.05, 0.5 * long, children),)
    root = children[0]
    return replace(root, children=root.children + _ending(ending, 0.12, (0, 0, 0), _aim((0, 0, -1)), "end")), 0


def _vessel(g: np.random.Generator, body: str, handles: int, foot: str, extra: str) -> _Skeleton:
    """A hollow body of revolution with handles, feet and a spout."""
    wide, high, wall = g.uniform(0.4, 0.6), g.uniform(0.95, 1.4), g.uniform(0.17, 0.21)
    match body:
        case "bowl":
            sweep = np.linspace(0.0, g.uniform(1.4, 1.9), 9)
            profile = [(1.6 * wide * np.sin(a), 1.6 * wide * (1.0 - np.cos(a))) for a in sweep]
        case "vase":
            waist = g.uniform(0.4, 0.6)
            profile = [
                (0, 0),
                (0.75 * wide, 0),
                (1.2 * wide, 0.4 * high),
                (waist * wide + 0.08, 0.8 * high),
                (0.9 * wide, high),
            ]
        case "bottle":
            profile = [(0, 0), (0.9 * wide, 0), (0.9 * wide, 0.6 * high), (0.24, 0.8 * high), (0.24, 1.15 * high)]
        case "pipe":
            profile = [(wide * g.uniform(0.6, 1.0), 0), (wide, high)]
        case _:
            profile = [(0, 0), (wide * g.uniform(0.6, 1.0), 0), (wide, high)]
    profile = [(float(r), float(z)) for r, z in profile]
    radii, heights = np.array(profile).T
    rising = slice(1, None) if radii[0] == 0.0 and heights[1] == 0.0 else slice(0, None)

    def wall_at(share: float) -> tuple[float, float]:
        z = share * heights[-1]
        return float(np.interp(z, heights[rising], radii[rising])), float(z)

    # Ears span a straight or hollow stretch of the wall: over a bulge nothing would be left of their opening.
    ends = {"bowl": (0.08, 0.93), "vase": (0.42, 0.98), "bottle": (0.35, 0.93)}.get(body, (0.18, 0.85))
    (r0, z0), (r1, z1) = (wall_at(share) for share in ends)
    ear = _Arc(0.5 * float(np.hypot(r1 - r0, z1 - z0)), np.pi, 0.1, 0.1)
    parts = [
        _Part(ear, (r0 * c, r0 * s, z0), _aim((c * (z1 - z0), s * (z1 - z0), r0 - r1)), (0, 5, 0), "handle", 0.04)
        for c, s in _circle(handles)
    ]
    if extra == "spout":
        r, z = wall_at(0.4)
        parts.append(_limb([0.45, 0.3], [0.15, 0.12, 0.1], [(12, 8, 0), (12, 8, 0)], "spout", (0, -r, z), (0, -1, 0.7)))
    if extra == "knobs":
        r, z = wall_at(0.5)
        parts += [
            _Part(_Blob((0.16, 0.16, 0.16)), (r * c, r * s, z), _aim((c, s, 0)), group="knob", lift=0.08)
            for c, s in _circle(5, 0.6)
        ]
    bottom = float(radii[0])
    match foot:
        case "legs":
            reach = max(bottom, 0.3)
            z = 0.0 if bottom else float(np.interp(reach, radii[:3], heights[:3]))
            parts += [
                _limb(
                    [0.5],
                    [0.12, 0.1],
                    [(9, 9, 0)],
                    "leg",
                    (reach * c, reach * s, z),
                    (0.4 * c, 0.4 * s, -1),
                )
                for c, s in _circle(3, 0.3)
            ]
        case "stem":
            plate = (_Part(_Prism(24, 0.42, 0.18, 0.07), (0, 0, 0.5), group="foot"),)
            parts.append(_limb([0.5], [0.13, 0.12], [(4, 4, 0)], "stem", (0, 0, 0), (0, 0, -1), tip=plate))
    return _Part(_Shell(tuple(profile), wall), blend=0.05, children=tuple(parts)), handles


def _wheel(g: np.random.Generator, n: int, spokes: int, limbs: str, ending: str) -> _Skeleton:
    """A rigid frame, with spokes inside and limbs at its corners."""
    spokes = min(spokes, n)
    radius = g.uniform(0.75, 0.95) * (1.0 + 0.07 * spokes)
    style = _LimbStyle.draw(g, "jointed" if limbs == "rays" else "straight", ending, 0.6, 0.11)
    parts = [
        _limb([radius], [0.1, 0.1], [(0, 0, 0)], "body", (0, 0, 0), (c, s, 0))
        for c, s in [_circle(n)[i * n // spokes] for i in range(spokes)]
    ]
    if spokes:
        parts.append(_Part(_Blob((0.2, 0.2, 0.15)), group="hub"))
    corners = _circle(n)
    match limbs:
        case "rays":
            parts += [style.grow((radius * c, radius * s, 0), (c, s, 0.3)) for c, s in corners]
        case "legs":
            parts += [style.grow((radius * c, radius * s, 0), (0.2 * c, 0.2 * s, -1)) for c, s in corners]
        case "mast":
            c, s = corners[0]
            parts += [replace(style, length=1.5 * style.length).grow((radius * c, radius * s, 0), (c, s, 0))]
    return _Part(_Frame(n, radius, 0.12), children=tuple(parts)), max(spokes - 1, 0)


def _table(g: np.random.Generator, top: str, legs: int, back: str) -> _Skeleton:
    """A plate on legs, with or without a back."""
    wide, thick = g.uniform(0.5, 0.75), g.uniform(0.17, 0.24)
    solid: _Solid
    reach = 0.72 * wide
    match top:
        case "round":
            solid = _Prism(24, wide, thick, 0.07)
        case "square":
            solid, reach = _Prism(4, 1.25 * wide, thick, 0.07), 0.95 * wide
        case "long":
            solid = _Box((1.5 * wide, 2.9 * wide, thick), 0.07)
        case "triangle":
            solid, reach = _Prism(3, 1.4 * wide, thick, 0.07), 0.9 * wide
        case _:
            solid, reach = _Frame(20, wide, 0.13), wide
    splay, high = g.uniform(0.0, 0.5), g.uniform(0.5, 1.1)
    style = _LimbStyle.draw(
        g, str(g.choice(["straight", "bent", "jointed"])), str(g.choice(["plain", "knob"])), high, 0.11, 8.0
    )
    style = replace(style, curl=g.uniform(0.4, 0.9))
    parts = []
    if legs == 1:
        plate = (_Part(_Prism(24, 0.8 * wide, 0.2, 0.08), (0, 0, high), group="foot", bend=(4, 4, 0)),)
        stem = _limb([high], [0.15, 0.15], [(4, 4, 0)], "stem", (0, 0, 0), (0, 0, -1), tip=plate)
        if top == "hoop":
            stem = replace(stem, at=(reach, 0, 0))
        parts.append(stem)
    else:
        for c, s in _circle(legs, np.pi / 4 if top == "long" else 0.0):
            stretch = 1.9 if top == "long" else 1.0
            parts.append(style.grow((reach * c, stretch * reach * s, 0), (splay * c, splay * s, -1)))
    place = {"round": 0.8 * wide, "square": 0.75 * wide, "long": 1.3 * wide, "triangle": 0.5 * wide, "hoop": wide}[top]
    match back:
        case "panel":
            parts.append(
                _Part(_Box((1.2 * wide, 0.18, 0.9), 0.07), (0, place, 0), bend=(12, 0, 0), group="back", lift=0.42)
            )
        case "arch":
            ring = _Ring(0.6 * wide, 0.11, 0.15)
            parts.append(_Part(ring, (0, place, 0), bend=(12, 0, 0), group="back", lift=0.6 * wide + 0.2))
        case "post":
            parts.append(
                _limb(
                    [0.8],
                    [0.12, 0.11],
                    [(12, 12, 0)],
                    "back",
                    (0, place, 0),
                    tip=_ending("knob", 0.1, (0, 0, 0.8), np.eye(3), "back"),
                )
            )
        case "horns":
            parts += [
                _limb(
                    [0.5, 0.3],
                    [0.12, 0.11, 0.1],
                    [(12, 12, 0)],
                    "back",
                    (s * 0.5 * wide if top != "hoop" else 0.0, place * (1 if top != "hoop" else s), 0),
                    (0.3 * s, 0.1, 1),
                )
                for s in (-1, 1)
            ]
    return _Part(solid, children=tuple(parts)), 0


def _tool(g: np.random.Generator, shaft: str, head: str, pommel: str) -> _Skeleton:
    """A shaft with a head and a pommel."""
    style = _LimbStyle.draw(g, shaft, head, g.uniform(1.1, 1.9), 0.13, 12.0)
    end = style.start * g.uniform(0.8, 1.25)
    style = replace(style, end=end, curl=0.6 * style.curl)
    root = style.grow((0, 0, 0), (0, 0, 1), "shaft")
    return replace(
        root, children=root.children + _ending(pommel, 0.95 * style.start, (0, 0, 0), _aim((0, 0, -1)), "pommel")
    ), 0


def _tongs(g: np.random.Generator, jaw: str, grip: str, arms: int) -> _Skeleton:
    """Two or three arms that cross at a pivot."""
    front, rear = g.uniform(0.6 if jaw in ("plain", "hook") else 0.85, 1.1), g.uniform(0.85, 1.3)
    opening = g.uniform(26.0, 38.0) if arms == 2 else g.uniform(38.0, 48.0)
    r = g.uniform(0.11, 0.14)
    parts = []
    for i in range(arms):
        tip = _ending(jaw, 0.8 * r, (0, 0, front), np.eye(3), "jaw")
        end = _ending("plain" if grip == "bow" else grip, 0.85 * r, (0, 0, rear), np.eye(3), "grip")
        turn = _aim((0, 0, -1))
        tail: _Solid = _Cone(rear, r, 0.85 * r)
        if grip == "bow":
            tail, turn = _Arc(rear, 1.0, r, 0.85 * r), turn @ Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
        arm_turn = Rotation.from_euler("ZY", (360.0 * i / arms, opening), degrees=True).as_matrix()
        grip_part = _Part(tail, turn=turn, group="grip", children=end)
        parts.append(
            _Part(
                _Cone(front, 1.1 * r, 0.8 * r), turn=arm_turn, bend=(0, 7, 0), group="jaw", children=(*tip, grip_part)
            )
        )
    return _Part(_Blob((0.2, 0.15, 0.2)), group="pivot", children=tuple(parts)), 0


def _stack(g: np.random.Generator, layers: tuple[str, ...], side: str) -> _Skeleton:
    """Layers on top of one another, with things at the side of the first."""
    children: tuple[_Part, ...] = ()
    for i, layer in reversed(list(enumerate(layers))):
        size = g.uniform(0.28, 0.5)
        solid: _Solid
        match layer:
            case "ball":
                solid, high = _Blob((size, size, size * g.uniform(0.7, 1.2))), 1.6 * size
            case "block":
                solid, high = _Box((1.7 * size, 1.7 * size * g.uniform(0.6, 1.0), 1.8 * size), 0.06), 1.7 * size
            case "plate":
                solid, high = _Prism(int(g.choice([3, 4, 6, 24])), 1.6 * size, 0.22, 0.08), 0.18
            case "post":
                solid, high = _Prism(24, 0.2, 1.2 * size, 0.06), 1.15 * size
            case _:
                solid, high = _Ring(size, 0.13), 2.0 * size + 0.1
        if i == 0:
            # A hoop carries its limbs left and right, where its tube is; a post is thin whatever its height.
            reach = {"hoop": size, "post": 0.12}.get(layer, 0.85 * size)
            count, kind, ending, length = {
                "bare": (0, "stub", "plain", 0.3),
                "arms": (2, "jointed", "knob", 0.9),
                "pegs": (2 if layer == "hoop" else 4, "straight", "plain", 0.5),
                "hoops": (2, "stub", "ring", 0.5),
            }[side]
            style = _LimbStyle.draw(g, kind, ending, length, 0.12)
            limbs = tuple(style.grow((reach * c, reach * s, 0.5 * high), (c, s, 0.3)) for c, s in _circle(count))
        children = tuple(replace(child, at=(0, 0, high)) for child in children) + (limbs if i == 0 else ())
        children = (_Part(solid, (0, 0, 0), bend=(7, 7, 12), group=f"layer{i}", lift=0.5 * high, children=children),)
    return children[0], 0


def _comb(g: np.random.Generator, n: int, sides: str, ending: str) -> _Skeleton:
    """A spine with teeth; a ladder where a second rail joins their ends."""
    step = g.uniform(0.34, 0.44) + {"knob": 0.15, "disc": 0.35}.get(ending, 0.0)
    reach = g.uniform(0.4, 0.7)
    spine = step * (n - 1)
    parts: list[_Part] = []
    if sides == "ladder":
        rail = (_limb([spine], [0.12, 0.12], [(0, 0, 0)], "body", (0, 0, reach), (1, 0, 0)),)
        for i in range(n):
            turn = Rotation.from_euler("y", 90.0, degrees=True).as_matrix()
            rung = _Part(_Cone(reach, 0.1, 0.1), (0, 0, i * step), turn, children=())
            if i == 0:
                rail = (_Part(_Cone(spine, 0.12, 0.12), (0, 0, reach), turn.T),)
                rung = replace(rung, children=rail)
            parts.append(rung)
        parts += _ending(ending, 0.12, (0, 0, spine), np.eye(3), "end")
        return _Part(_Cone(spine, 0.12, 0.12), children=tuple(parts)), n - 1
    style = _LimbStyle.draw(g, "straight", ending, reach, 0.1, 8.0)
    roll = 0.5 * np.pi if ending == "hook" else 0.0  # flat endings stand across the spine
    segments: tuple[_Part, ...] = ()
    for i in reversed(range(n)):
        headings = {"one": [1], "both": [-1, 1], "zigzag": [1 if i % 2 else -1]}[sides]
        teeth = tuple(style.grow((0, 0, 0.5 * step), (s, 0, 0.2), "tooth", roll) for s in headings)
        cone = _Cone(step, 0.14, 0.14)
        segments = (_Part(cone, (0, 0, step if i else 0.0), bend=(14, 5, 0), children=segments + teeth),)
    return segments[0], 0


def _serpent(g: np.random.Generator, n: int, ornament: str, head: str) -> _Skeleton:
    """A long body that bends, with an ornament on each second segment."""
    step, girth = g.uniform(0.3, 0.42), g.uniform(0.13, 0.2)
    taper = g.uniform(0.6, 0.9)
    parts: tuple[_Part, ...] = _ending(head, girth * 0.95, (0, 0, step), np.eye(3), "head")
    for i in reversed(range(n)):
        extras: tuple[_Part, ...] = ()
        if i % 2 or n < 5:
            match ornament:
                case "sail":
                    extras = (_Part(_Blob((0.09, 0.36, 0.2)), (0, 1.2 * girth, 0.5 * step), group="fin"),)
                case "fins":
                    extras = tuple(
                        _Part(
                            _Blob((0.13, 0.085, 0.24)),
                            (0.6 * girth * s, 0, 0.5 * step),
                            _aim((s, 0, -0.5)),
                            (14, 14, 0),
                            "fin",
                            lift=0.18,
                        )
                        for s in (-1, 1)
                    )
                case "bulge":
                    extras = (_Part(_Blob((2.0 * girth,) * 3), (0, 0, 0.5 * step), group="bulge"),)
                case "collar":
                    extras = (_Part(_Prism(24, 2.3 * girth, 0.18, 0.07), (0, 0, 0.5 * step), group="collar"),)
        radii = girth * np.interp([i, i + 1], [0, 0.5 * n, n], [taper, 1.0, 0.9])
        cone = _Cone(step, float(radii[0]), float(radii[1]))
        parts = (_Part(cone, (0, 0, step if i else 0.0), bend=(9, 24, 0), children=parts + extras, blend=0.05),)
    return parts[0], 0


_LAYERS = ("ball", "block", "plate", "post", "hoop")

_Option = tuple[Any, ...]


def _options(*choices: Sequence[Any], where: Callable[..., bool] = lambda *_: True) -> list[_Option]:
    """All combinations of the structural choices of a family that can be built."""
    return [option for option in itertools.product(*choices) if where(*option)]


# Every family: how to build one of its skeletons, and its structures. Two classes of a family differ in a choice.
_FAMILIES: dict[str, tuple[Callable[..., _Skeleton], list[_Option]]] = {
    "star": (
        _star,
        _options(
            ("orb", "disc", "hoop", "drum", "prism"),
            (3, 4, 5, 6, 7),
            ("straight", "jointed", "bent", "tentacle"),
            ("plain", "knob", "ring", "paddle", "fork", "hook"),
        ),
    ),
    "tree": (
        _tree,
        _options(
            (2, 3, 4, 5),
            (0, 2, 3),
            ("plain", "knob", "ring", "cup", "disc"),
            ("bare", "plate", "bulb", "tripod"),
            where=lambda branches, twigs, ending, _: branches * twigs <= (9 if ending == "plain" else 6),
        ),
    ),
    "beast": (
        _beast,
        _options(
            (1, 2, 3, 4),
            ("stand", "sprawl", "fins"),
            ("round", "horned", "bill", "looped", "long"),
            ("bare", "whip", "fluke", "loop", "club"),
        ),
    ),
    "chain": (
        _chain,
        _options(
            (3, 4, 5, 6, 7),
            ("beads", "boxes", "plates", "tubes", "shrinking", "rings", "crossed"),
            ("plain", "fork", "hook", "ring", "hammer"),
        ),
    ),
    "vessel": (
        _vessel,
        _options(
            ("cup", "bowl", "vase", "bottle", "pipe"),
            (0, 1, 2, 3),
            ("flat", "legs", "stem"),
            ("smooth", "spout", "knobs"),
            where=lambda body, _handles, foot, _extra: not (body == "pipe" and foot == "stem"),
        ),
    ),
    "wheel": (
        _wheel,
        _options(
            (3, 4, 5, 6),
            (0, 2, 3, 6),
            ("none", "rays", "legs", "mast"),
            ("plain", "knob", "fork"),
            where=lambda n, spokes, limbs, ending: spokes <= n and (limbs != "none" or ending == "plain"),
        ),
    ),
    "table": (
        _table,
        _options(
            ("round", "square", "long", "triangle", "hoop"), (1, 3, 4, 6), ("open", "panel", "arch", "post", "horns")
        ),
    ),
    "tool": (
        _tool,
        _options(
            ("straight", "bent", "jointed", "tentacle"),
            ("hammer", "fork", "ring", "paddle", "cup", "hook", "disc", "claw"),
            ("plain", "knob", "ring", "hammer", "fork"),
        ),
    ),
    "tongs": (
        _tongs,
        _options(
            ("plain", "hook", "paddle", "ring", "knob", "hammer", "fork"),
            ("plain", "ring", "knob", "bow", "paddle"),
            (2, 3),
        ),
    ),
    "stack": (
        _stack,
        _options(
            [*itertools.permutations(_LAYERS, 3), *itertools.permutations(_LAYERS, 4)],
            ("bare", "arms", "pegs", "hoops"),
        ),
    ),
    "comb": (
        _comb,
        _options((3, 4, 5), ("one", "both", "zigzag", "ladder"), ("plain", "knob", "ring", "paddle", "disc", "hook")),
    ),
    "serpent": (
        _serpent,
        _options(
            (3, 4, 5, 6, 7),
            ("sail", "fins", "bulge", "collar"),
            ("plain", "knob", "fork", "ring", "paddle", "claw"),
        ),
    ),
}


def _structure(seed: int, index: int) -> tuple[str, Callable[..., _Skeleton], _Option]:
    """Name, builder and structure of a class of the grammar."""
    turn, place = divmod(index - len(_TEMPLATES), len(_FAMILIES))
    family = list(_FAMILIES)[place]
    build, options = _FAMILIES[family]
    # One walk through the shuffled structures keeps classes of a family apart, however many are asked for.
    order = np.random.default_rng([seed, _FAMILY, place]).permutation(len(options))
    option = options[order[turn % len(options)]]
    words = [str(word) for choice in option for word in (choice if isinstance(choice, tuple) else (choice,))]
    return "-".join([family, *words, f"{index:03d}"]), build, option


def _class_name(seed: int, index: int) -> str:
    """The name of a class, without building it."""
    return _TEMPLATES[index]().name if index < len(_TEMPLATES) else _structure(seed, index)[0]


def _shape_class(seed: int, index: int) -> _ShapeClass:
    """The class of an index: a template, or its structure in the first proportions that pass a trial pose."""
    if index < len(_TEMPLATES):
        return _TEMPLATES[index]()
    name, build, option = _structure(seed, index)
    defect: str | None = None
    for draw in range(_MAX_ATTEMPTS):
        root, loops = build(np.random.default_rng([seed, _CLASS, index, draw]), *option)
        shape_class = _ShapeClass(name, root, loops)
        body = _pose(shape_class, np.random.default_rng([seed, _TRIAL, index, draw]), 1.0, np.eye(3))
        vertices, faces, _ = _mesh(body, _TRIAL_VERTICES)
        defect = _defect(vertices, faces, shape_class.genus, _TRIAL_VERTICES)
        if defect is None:
            return shape_class
        _log.debug("%s: draw %d: %s", name, draw + 1, defect)
    raise ValueError(
        f"seed={seed}: no sound class {name} in {_MAX_ATTEMPTS} draws, the last had {defect}; try another seed"
    )


# -------------------------------------------------------------------------------------------------------------- meshing


def _smooth_minimum(a: Array, b: Array, blend: float) -> Array:
    """The polynomial smooth union of two distances; differs from the minimum where they are closer than ``blend``."""
    overlap = np.maximum(blend - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap * overlap / (4.0 * blend)


def _distance(body: Sequence[_Placed], points: Array) -> Array:
    """The blended signed distance (V,) at points (V,3)."""
    x, y, z = points.T
    total = body[0].distance(x, y, z)
    for part in body[1:]:
        total = _smooth_minimum(total, part.distance(x, y, z), part.blend)
    return total


def _bounds(body: Sequence[_Placed]) -> tuple[Array, Array]:
    corners = np.array([part.bounds() for part in body])
    return corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)


def _sample(body: Sequence[_Placed], spacing: float) -> tuple[Array, Array]:
    """The grid's first corner (3,) and the blended distances on it; each solid is evaluated only near itself."""
    margin = max(part.blend for part in body) + 2.5 * spacing
    low, high = _bounds(body)
    low = low - margin
    shape = np.ceil((high + margin - low) / spacing).astype(int) + 1
    axes = [low[i] + spacing * np.arange(shape[i]) for i in range(3)]
    grid = np.full(shape, 1e3)
    for part in body:
        first, last = part.bounds()
        start = np.maximum(np.floor((first - margin - low) / spacing).astype(int), 0)
        stop = np.minimum(np.ceil((last + margin - low) / spacing).astype(int) + 1, shape)
        window = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        distance = part.distance(*np.ix_(*(axis[w] for axis, w in zip(axes, window, strict=True))))
        grid[window] = _smooth_minimum(grid[window], distance, part.blend)
    return low, grid


def _rough_area(body: Sequence[_Placed]) -> float:
    """Surface area from the volume of a band of half-width one coarse cell around the surface."""
    low, high = _bounds(body)
    spacing = float((np.prod(high - low) / _COARSE_CELLS) ** (1.0 / 3.0))
    _, grid = _sample(body, spacing)
    return float(np.count_nonzero(np.abs(grid) < spacing)) * spacing**2 / 2.0


def _vertex_normals(vertices: Array, faces: Faces) -> Array:
    """Area-weighted unit normals (V,3)."""
    corners = vertices[faces]
    area_vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    index = faces.ravel()
    repeated = np.repeat(area_vectors, 3, axis=0)
    normals = np.column_stack([np.bincount(index, repeated[:, i], len(vertices)) for i in range(3)])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _relax(body: Sequence[_Placed], vertices: Array, faces: Faces, spacing: float) -> Array:
    """Slide vertices (V,3) towards their neighbours' mean along the surface, and back onto the zero level set."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    adjacency = sparse.csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
    degree = np.bincount(edges[:, 0], minlength=len(vertices))[:, None]
    for _ in range(_RELAXATION_STEPS):
        normals = _vertex_normals(vertices, faces)
        step = (adjacency @ vertices) / degree - vertices
        step -= normals * (step * normals).sum(axis=1, keepdims=True)
        vertices = vertices + 0.7 * step
        vertices -= normals * np.clip(_distance(body, vertices), -0.5 * spacing, 0.5 * spacing)[:, None]
    return vertices


def _marching_cubes() -> Callable[..., tuple[Any, ...]]:
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise ImportError('generated shapes need scikit-image: pip install "interior-gps[shapes]"') from error
    return marching_cubes


def _mesh(body: Sequence[_Placed], target: int) -> tuple[Array, Faces, float]:
    """Vertices (V,3), outward faces (F,3) and the grid spacing, with V within about a tenth of ``target``."""
    marching_cubes = _marching_cubes()
    spacing = float(
        np.sqrt(1.5 * _rough_area(body) / target)
    )  # 1.5 crossings of grid lines an area of spacing², on average
    for _ in range(3):
        low, grid = _sample(body, spacing)
        # Snapped, no vertex comes close to a grid point: no two coincide, no face degenerates.
        near = np.abs(grid) < _SNAP * spacing
        grid[near] = np.where(grid[near] < 0.0, -_SNAP * spacing, _SNAP * spacing)
        points, faces, _, _ = marching_cubes(grid, 0.0, gradient_direction="descent")
        ratio = len(points) / target
        if abs(ratio - 1.0) < 0.1:
            break
        spacing *= float(np.sqrt(ratio))
    vertices = low + spacing * points.astype(np.float64)
    faces = faces.astype(np.int64)
    return _relax(body, vertices, faces, spacing), faces, spacing


def _roughen(vertices: Array, faces: Faces, amplitude: float, wavelength: float, rng: np.random.Generator) -> Array:
    """Move vertices (V,3) along their normals by a band-limited random field."""
    waves = rng.normal(size=(12, 3)) * (2.0 * np.pi / wavelength / np.sqrt(3.0))
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    noise = np.zeros(len(vertices))
    for wave, phase in zip(waves, phases, strict=True):
        noise += np.sin(vertices[:, 0] * wave[0] + vertices[:, 1] * wave[1] + vertices[:, 2] * wave[2] + phase)
    return vertices + _vertex_normals(vertices, faces) * (amplitude * noise / np.sqrt(6.0))[:, None]


def _smallest_angle(vertices: Array, faces: Faces) -> float:
    """The smallest corner angle in degrees."""
    corners = vertices[faces]
    smallest = np.inf
    for i in range(3):
        a, b = corners[:, (i + 1) % 3] - corners[:, i], corners[:, (i + 2) % 3] - corners[:, i]
        angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        smallest = min(smallest, float(np.degrees(angles.min())))
    return smallest


def _defect(vertices: Array, faces: Faces, genus: int, n_vertices: int) -> str | None:
    """What keeps a mesh out of the benchmark, in words, or None."""
    count = len(vertices)
    if abs(count / n_vertices - 1.0) > _VERTEX_TOLERANCE:
        return f"{count} vertices"
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward, backward = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    if len(np.unique(forward)) < len(forward) or not np.array_equal(np.sort(forward), np.sort(backward)):
        return "not a closed, oriented manifold"
    graph = sparse.csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    components = connected_components(graph, directed=False, return_labels=False)
    if components != 1:
        return f"{components} components"
    found = (2 - (count - len(faces) // 2)) // 2
    if found != genus:
        return f"genus {found} in place of {genus}"
    if np.linalg.det(vertices[faces]).sum() <= 0.0:
        return "inside out"
    angle = _smallest_angle(vertices, faces)
    if angle < _MIN_ANGLE:
        return f"a triangle with an angle of {angle:.2g} degrees"
    return None


# ------------------------------------------------------------------------------------------------------------ benchmark


@dataclass(frozen=True, eq=False)
class GeneratedShape:
    """One generated shape.

    vertices: (V,3) float64, in units of about half the height of a figure.
    faces: (F,3) int64, outward.
    label: name of the class.
    name: class and running number, such as ``biped/00``.
    genus: number of handles of the surface; V − E + F = 2 − 2 genus.
    """

    vertices: Array
    faces: Faces
    label: str
    name: str
    genus: int


class ArticulatedShapes:
    """A deterministic, labelled benchmark of closed manifold meshes of articulated bodies, class after class.

    A class index means the same class for the same seed whatever ``n_classes``, and a shape depends on its class, its
    number in the class, ``seed`` and ``n_vertices`` alone, so shapes may be made in any order and by many processes.

    Args:
        n_classes: number of classes; the first twelve are named templates, the rest are drawn from a grammar.
        n_per_class: number of shapes of each class.
        seed: seed of all random draws, not negative.
        n_vertices: vertices of a shape, kept within 40 percent.

    Raises:
        ValueError: an argument is out of range, or (on access) a shape cannot be made at this resolution.
        ImportError: (on access) scikit-image is missing.
    """

    def __init__(self, n_classes: int = 8, n_per_class: int = 10, seed: int = 0, n_vertices: int = 3000) -> None:
        for name, value, least in (
            ("n_classes", n_classes, 1),
            ("n_per_class", n_per_class, 1),
            ("seed", seed, 0),
            ("n_vertices", n_vertices, 500),
        ):
            if operator.index(value) < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        self.n_classes, self.n_per_class, self.seed, self.n_vertices = n_classes, n_per_class, seed, n_vertices
        self._classes: dict[int, _ShapeClass] = {}

    def __len__(self) -> int:
        return self.n_classes * self.n_per_class

    def __repr__(self) -> str:
        return (
            f"ArticulatedShapes({self.n_classes}, {self.n_per_class}, seed={self.seed}, n_vertices={self.n_vertices})"
        )

    @property
    def class_names(self) -> list[str]:
        """The unique names of the classes, in order."""
        return [_class_name(self.seed, index) for index in range(self.n_classes)]

    @property
    def labels(self) -> list[str]:
        """The class name of every shape."""
        return [name for name in self.class_names for _ in range(self.n_per_class)]

    @property
    def names(self) -> list[str]:
        """The unique name of every shape, ``class/number``."""
        return [f"{name}/{number:02d}" for name in self.class_names for number in range(self.n_per_class)]

    def __getitem__(self, index: int) -> GeneratedShape:
        """Generate one shape; costs a fraction of a second, nothing is kept.

        Raises:
            IndexError: there is no such shape.
            ValueError: no pose gave a valid mesh; names the class and what went wrong.
        """
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"index must lie in [{-len(self)}, {len(self)}), got {index}")
        return self._generate(*divmod(position % len(self), self.n_per_class))

    def _rotation(self, class_index: int, number: int) -> Array:
        rng = np.random.default_rng([self.seed, _MOTION, class_index, number])
        return np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix())

    def _generate(self, class_index: int, number: int) -> GeneratedShape:
        if class_index not in self._classes:
            self._classes[class_index] = _shape_class(self.seed, class_index)
        shape_class = self._classes[class_index]
        rotation = self._rotation(class_index, number)
        defect: str | None = None
        for attempt in range(_MAX_ATTEMPTS):
            rng = np.random.default_rng([self.seed, _POSE, class_index, number, attempt])
            target = int(self.n_vertices * rng.uniform(0.8, 1.25))
            # Later attempts bend less: most failures are limbs that touch.
            body = _pose(shape_class, rng, 1.0 - 0.8 * attempt / _MAX_ATTEMPTS, rotation)
            vertices, faces, spacing = _mesh(body, target)
            vertices = _roughen(vertices, faces, spacing * rng.uniform(0.0, 0.12), 10.0 * spacing, rng)
            defect = _defect(vertices, faces, shape_class.genus, self.n_vertices)
            if defect is None:
                name = f"{shape_class.name}/{number:02d}"
                _log.debug("%s: attempt %d", name, attempt + 1)
                shift = rng.uniform(-1.0, 1.0, 3)
                return GeneratedShape(vertices + shift, faces, shape_class.name, name, shape_class.genus)
            _log.debug("%s/%02d: attempt %d: %s", shape_class.name, number, attempt + 1, defect)
        raise ValueError(
            f"n_vertices={self.n_vertices}: no valid mesh of {shape_class.name}/{number:02d} in {_MAX_ATTEMPTS} "
            f"attempts, the last had {defect}; thin parts need a higher n_vertices, another seed gives other poses"
        )

    def write(self, root: str | os.PathLike[str], progress: bool = False) -> None:
        """Write every shape to ``root/<class>/<number>.off``, leaving out what is there already.

        Each file appears whole or not at all, so an interrupted run is resumed by the same call and several processes
        may write at once. ``root/shapes.json`` records the generator's settings; classes and shapes may be added later.

        Args:
            root: folder, made where absent.
            progress: show a progress bar.

        Raises:
            ValueError: ``root`` holds shapes of another seed, resolution or version.
        """
        folder = Path(root)
        settings = json.dumps(
            {"generator": type(self).__name__, "version": _VERSION, "seed": self.seed, "n_vertices": self.n_vertices}
        )
        manifest = folder / "shapes.json"
        if manifest.exists():
            found = manifest.read_text(encoding="utf-8")
            if found != settings:
                raise ValueError(
                    f"root={str(root)!r} holds shapes of {found}, not of {settings}; choose another folder"
                )
        else:
            folder.mkdir(parents=True, exist_ok=True)
            _write_whole(manifest, settings)
        for index, name in enumerate(tqdm(self.names, desc="shapes", unit="shape", disable=not progress)):
            path = folder / f"{name}.off"
            if not _is_whole_off(path):
                shape = self[index]
                path.parent.mkdir(parents=True, exist_ok=True)
                _write_whole(path, _off(shape.vertices, shape.faces))

    def contact_sheet(self, path: str | os.PathLike[str], n_shown: int = 1) -> None:
        """Save a picture of the first ``n_shown`` shapes of every class, all turned the same way.

        Raises:
            ValueError: ``n_shown`` is out of range.
            ImportError: matplotlib is missing.
        """
        if not 1 <= n_shown <= self.n_per_class:
            raise ValueError(f"n_shown must lie in [1, n_per_class={self.n_per_class}], got {n_shown}")
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.collections import PolyCollection
            from matplotlib.figure import Figure
        except ImportError as error:
            raise ImportError('contact sheets need matplotlib: pip install "interior-gps[plot]"') from error
        cells = [(c, i) for c in range(self.n_classes) for i in range(n_shown)]
        columns = min(len(cells), max(4, int(np.ceil(np.sqrt(1.6 * len(cells))))))
        rows = -(-len(cells) // columns)
        figure = Figure(figsize=(1.7 * columns, 1.85 * rows), dpi=110)
        FigureCanvasAgg(figure)
        figure.subplots_adjust(0.0, 0.0, 1.0, 0.98, 0.0, 0.12)
        for place, (c, i) in enumerate(cells):
            shape = self._generate(c, i)
            polygons, shades = _draw(shape, self._rotation(c, i))
            axes = figure.add_subplot(rows, columns, place + 1)
            colours = np.outer(shades, (0.55, 0.72, 0.95))
            axes.add_collection(PolyCollection(list(polygons), facecolors=colours, edgecolors=colours, linewidths=0.2))
            axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
            axes.set_axis_off()
            axes.set_title(shape.name if n_shown > 1 else shape.label, fontsize=5, pad=1)
        figure.savefig(Path(path))


def _draw(shape: GeneratedShape, rotation: Array) -> tuple[Array, Array]:
    """Projected front faces (F',3,2) from back to front, in the unit square, and their shades (F',)."""
    turned = Rotation.from_euler("zx", (-35.0, -70.0), degrees=True).as_matrix() @ rotation.T
    points = shape.vertices @ turned.T
    points -= 0.5 * (points.min(axis=0) + points.max(axis=0))
    points /= 1.05 * np.abs(points[:, :2]).max()
    corners = points[shape.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    light = np.array([0.35, 0.5, 0.79])
    shades = 0.25 + 0.75 * np.clip((normals * light).sum(axis=1), 0.0, 1.0)
    order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")
    order = order[normals[order, 2] > 0.0]
    return corners[order][:, :, :2], shades[order]


def _off(vertices: Array, faces: Faces) -> str:
    """A mesh in the Object File Format; 17 digits give the same float64 values back."""
    lines = [f"OFF\n{len(vertices)} {len(faces)} 0"]
    lines += [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return "\n".join(lines) + "\n"


def _is_whole_off(path: Path) -> bool:
    """Whether an OFF file is there with as many lines as its header promises."""
    if not path.is_file():
        return False
    text = path.read_bytes()
    header = text[:64].split()
    if len(header) < 3 or header[0] != b"OFF":
        return False
    return text.endswith(b"\n") and text.count(b"\n") == 2 + int(header[1]) + int(header[2])


def _write_whole(path: Path, text: str) -> None:
    """Write a file under another name and move it into place, so that nobody sees a part of it."""
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex}")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)

"""The solids of which bodies consist."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from igps._arrays import Floats

Vector = tuple[float, float, float]


class Solid(ABC):
    """A solid in its own frame, defined by a signed distance function."""

    @property
    def genus(self) -> int:
        """The number of handles of the solid's surface."""
        return 0

    @abstractmethod
    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return the signed distance (exact or a good approximation), negative inside; coordinates are broadcast."""

    @abstractmethod
    def box(self) -> tuple[Floats, Floats]:
        """Return the lower and upper corner of a box around the solid."""

    @abstractmethod
    def stretched(self, thick: float, length: float) -> Solid:
        """Return the solid with its thickness and length scaled by these factors."""

    def factors(self, thick: float, length: float) -> Floats:
        """Return the factors (3,) by which points attached to the solid move when it is stretched."""
        return np.array([thick, thick, length])


def _norm(x: Floats, y: Floats, z: Floats) -> Floats:
    return np.sqrt(x**2 + y**2 + z**2)


@dataclass(frozen=True)
class Cone(Solid):
    """A tapered capsule: the sweep of a sphere from radius ``start`` at the origin to ``end`` at (0, 0, length)."""

    length: float
    start: float
    end: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        radial = np.hypot(x, y)
        slope = (self.start - self.end) / self.length
        # The taper shifts the nearest sphere along the axis from the foot of the perpendicular.
        shift = radial * (slope / np.sqrt(1.0 - slope * slope))
        along = np.clip(z - shift, 0.0, self.length)
        radius = self.start - slope * along
        return np.hypot(radial, z - along) - radius

    def box(self) -> tuple[Floats, Floats]:
        wide = max(self.start, self.end)
        lower = np.array([-wide, -wide, -self.start])
        upper = np.array([wide, wide, self.length + self.end])
        return lower, upper

    def stretched(self, thick: float, length: float) -> Solid:
        return Cone(self.length * length, self.start * thick, self.end * thick)


@dataclass(frozen=True)
class Arc(Solid):
    """A bent tube: from the origin along +z, turning by ``angle`` radians towards +y on a circle of radius ``bend``."""

    bend: float
    angle: float
    start: float
    end: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        half = 0.5 * self.angle
        # The angle along the arc, from the middle of the arc, between −π and π.
        turned = np.arctan2(z, self.bend - y) - half
        turned = np.mod(turned + np.pi, 2.0 * np.pi) - np.pi
        turned = np.clip(turned, -half, half) + half
        centre_y, centre_z = self._centre_line(turned)
        growth = (self.end - self.start) / self.angle
        tube = self.start + growth * turned
        return _norm(x, y - centre_y, z - centre_z) - tube

    def box(self) -> tuple[Floats, Floats]:
        wide = max(self.start, self.end)
        y, z = self._centre_line(np.linspace(0.0, self.angle, 33))
        slack = wide + 0.01 * self.bend  # as the points may miss the ends of the arc's extent
        lower = np.array([-wide, y.min() - slack, z.min() - slack])
        upper = np.array([wide, y.max() + slack, z.max() + slack])
        return lower, upper

    def stretched(self, thick: float, length: float) -> Solid:
        return Arc(self.bend * length, self.angle, self.start * thick, self.end * thick)

    def factors(self, thick: float, length: float) -> Floats:
        return np.full(3, length)

    def tip(self) -> Vector:
        """Return the far end of the centre line."""
        y, z = self._centre_line(self.angle)
        return (0.0, y, z)

    def _centre_line(self, turned: Any) -> tuple[Any, Any]:
        """Return y and z of the centre line, after it has turned by these angles."""
        return self.bend * (1.0 - np.cos(turned)), self.bend * np.sin(turned)


@dataclass(frozen=True)
class Blob(Solid):
    """An ellipsoid around the origin."""

    radii: Vector

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        a, b, c = self.radii
        unit = _norm(x / a, y / b, z / c)
        gradient = _norm(x / a**2, y / b**2, z / c**2)
        # Exact to first order at the surface; the bound on the gradient keeps the centre finite and inside.
        return unit * (unit - 1.0) / np.maximum(gradient, 1e-9) - 1e-12

    def box(self) -> tuple[Floats, Floats]:
        upper = np.array(self.radii)
        return -upper, upper

    def stretched(self, thick: float, length: float) -> Solid:
        a, b, c = self.radii
        return Blob((a * thick, b * thick, c * length))


@dataclass(frozen=True)
class Box(Solid):
    """A box around the origin with edges rounded at the radius ``rounding``."""

    size: Vector
    rounding: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        beyond = []  # each side of the box without its rounding
        for coordinate, size in zip((x, y, z), self.size, strict=True):
            beyond.append(np.abs(coordinate) - (0.5 * size - self.rounding))
        a, b, c = beyond
        outside = _norm(np.maximum(a, 0.0), np.maximum(b, 0.0), np.maximum(c, 0.0))
        nearest = np.maximum(np.maximum(a, b), c)
        return outside + np.minimum(nearest, 0.0) - self.rounding

    def box(self) -> tuple[Floats, Floats]:
        upper = 0.5 * np.array(self.size)
        return -upper, upper

    def stretched(self, thick: float, length: float) -> Solid:
        a, b, c = self.size
        size = (a * thick, b * thick, c * length)
        return Box(size, self.rounding * min(thick, length))


@dataclass(frozen=True)
class Shell(Solid):
    """A hollow body of revolution around z, with a wall of thickness ``wall`` along the (radius, z) of ``profile``."""

    profile: tuple[tuple[float, float], ...]
    wall: float

    @property
    def genus(self) -> int:
        first_radius, _ = self.profile[0]
        # a profile that starts off the axis is a tube, open at both ends
        return 0 if first_radius == 0.0 else 1

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        radial = np.hypot(x, y)
        squared = np.full(radial.shape, np.inf)
        for (r0, z0), (r1, z1) in itertools.pairwise(self.profile):
            dr = r1 - r0
            dz = z1 - z0
            across = radial - r0
            up = z - z0
            projected = across * dr + up * dz
            along = np.clip(projected / (dr * dr + dz * dz), 0.0, 1.0)
            to_segment = (across - along * dr) ** 2 + (up - along * dz) ** 2
            squared = np.minimum(squared, to_segment)
        return np.sqrt(squared) - 0.5 * self.wall

    def box(self) -> tuple[Floats, Floats]:
        radii, heights = np.array(self.profile).T
        half = 0.5 * self.wall
        wide = radii.max() + half
        lower = np.array([-wide, -wide, heights.min() - half])
        upper = np.array([wide, wide, heights.max() + half])
        return lower, upper

    def stretched(self, thick: float, length: float) -> Solid:
        profile = tuple((r * thick, z * length) for r, z in self.profile)
        return Shell(profile, self.wall * thick)

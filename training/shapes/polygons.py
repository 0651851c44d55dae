"""Solids with corners: regular prisms and frames."""

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats
from igps.shapes.solids import Solid


@dataclass(frozen=True)
class Prism(Solid):
    """A regular prism about the z axis, with rounded edges; `radius` is the distance of its corners from the axis."""

    sides: int
    radius: float
    height: float
    rounding: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        inner = self.radius - self.rounding / np.cos(np.pi / self.sides)
        across, past_corner = _to_polygon(self.sides, inner, x, y)
        flat = np.where(across > 0.0, np.hypot(across, past_corner), across)
        return rounded(flat, z, self.height, self.rounding)

    def box(self) -> tuple[Floats, Floats]:
        upper = np.array([self.radius, self.radius, 0.5 * self.height])
        return -upper, upper

    def stretched(self, thick: float, length: float) -> Solid:
        rounding = self.rounding * min(thick, length)
        return Prism(self.sides, self.radius * thick, self.height * length, rounding)


@dataclass(frozen=True)
class Frame(Solid):
    """A tube of radius `tube` along a regular polygon about the z axis, with corners at the distance `radius`."""

    sides: int
    radius: float
    tube: float

    @property
    def genus(self) -> int:
        return 1

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        across, past_corner = _to_polygon(self.sides, self.radius, x, y)
        squares = across * across + past_corner * past_corner + z * z
        return np.sqrt(squares) - self.tube

    def box(self) -> tuple[Floats, Floats]:
        wide = self.radius + self.tube
        upper = np.array([wide, wide, self.tube])
        return -upper, upper

    def stretched(self, thick: float, length: float) -> Solid:
        return Frame(self.sides, self.radius * length, self.tube * thick)

    def factors(self, thick: float, length: float) -> Floats:
        return np.full(3, length)


def rounded(flat: Floats, z: Floats, height: float, rounding: float) -> Floats:
    """Return signed distances from a prism about z = 0 with rounded edges.

    Args:
        flat: signed distances from its outline in the x-y plane, smaller all around by `rounding`.
        z: coordinates.
        height: its height.
        rounding: radius of its edges.
    """
    upright = np.abs(z) - (0.5 * height - rounding)
    outside = np.hypot(np.maximum(flat, 0.0), np.maximum(upright, 0.0))
    inside = np.minimum(np.maximum(flat, upright), 0.0)
    return outside + inside - rounding


def _to_polygon(sides: int, radius: float, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Signed distances of points from the line of the nearest side (negative inside), and lengths beyond its corner."""
    sector = np.pi / sides
    folded = np.mod(np.arctan2(y, x), 2.0 * sector) - sector
    radial = np.hypot(x, y)
    along = radial * np.abs(np.sin(folded))
    past_corner = np.maximum(along - radius * np.sin(sector), 0.0)
    across = radial * np.cos(folded) - radius * np.cos(sector)
    return across, past_corner

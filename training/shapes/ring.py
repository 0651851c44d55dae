"""A ring, which other solids are joined to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats
from igps.shapes.solids import Solid


@dataclass(frozen=True)
class Ring(Solid):
    """A torus around the y axis, elongated along z by straight sides of half length ``side``."""

    radius: float
    tube: float
    side: float = 0.0

    @property
    def genus(self) -> int:
        return 1

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        beyond_side = np.maximum(np.abs(z) - self.side, 0.0)
        from_ring = np.hypot(x, beyond_side) - self.radius
        return np.hypot(from_ring, y) - self.tube

    def box(self) -> tuple[Floats, Floats]:
        wide = self.radius + self.tube
        upper = np.array([wide, self.tube, wide + self.side])
        return -upper, upper

    def stretched(self, thick: float, length: float) -> Solid:
        return Ring(
            radius=self.radius * length,
            tube=self.tube * thick,
            side=self.side * length,
        )

    def factors(self, thick: float, length: float) -> Floats:
        return np.full(3, length)

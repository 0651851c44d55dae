"""Springs: a wire around a helix, and its builder."""

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats
from igps.shapes.skeleton import Part, Skeleton
from igps.shapes.solids import Blob, Solid, Vector
from training.shapes.polygons import Prism


@dataclass(frozen=True)
class Helix(Solid):
    """A tube of radius `tube` along a helix about z that starts at (radius, 0, 0); turns are `pitch` apart."""

    radius: float
    pitch: float
    turns: float
    tube: float

    def at(self, share: float) -> Vector:
        """Return the point of the centre line at a share of its length."""
        angle = 2.0 * np.pi * self.turns * share
        x = self.radius * float(np.cos(angle))
        y = self.radius * float(np.sin(angle))
        return x, y, self.pitch * self.turns * share

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        around = 2.0 * np.pi * self.radius
        slope = self.pitch / around
        here = np.arctan2(y, x) / (2.0 * np.pi)
        squared = np.full(np.broadcast_shapes(x.shape, y.shape, z.shape), np.inf)
        base = np.round(z / self.pitch - here)
        for step in (-1.0, 0.0, 1.0):  # the nearest turn, and the turns below and above
            turn = here + base + step
            # The nearest point of the helix is shifted along the wire from the point at the same angle.
            above = z - turn * self.pitch
            turn = turn + above * slope / (1.0 + slope**2) / around
            turn = np.clip(turn, 0.0, self.turns)
            angle = 2.0 * np.pi * turn
            dx = x - self.radius * np.cos(angle)
            dy = y - self.radius * np.sin(angle)
            dz = z - turn * self.pitch
            to_turn = dx**2 + dy**2 + dz**2
            squared = np.minimum(squared, to_turn)
        for end in (0.0, 1.0):
            end_x, end_y, end_z = self.at(end)
            to_end = (x - end_x) ** 2 + (y - end_y) ** 2 + (z - end_z) ** 2
            squared = np.minimum(squared, to_end)
        return np.sqrt(squared) - self.tube

    def box(self) -> tuple[Floats, Floats]:
        wide = self.radius + self.tube
        high = self.pitch * self.turns + self.tube
        lower = np.array([-wide, -wide, -self.tube])
        upper = np.array([wide, wide, high])
        return lower, upper

    def stretched(self, thick: float, length: float) -> Solid:
        return Helix(
            radius=self.radius * length,
            pitch=self.pitch * length,
            turns=self.turns,
            tube=min(self.tube * thick, 0.4 * self.pitch),
        )

    def factors(self, thick: float, length: float) -> Floats:
        return np.full(3, length)


def coil(g: np.random.Generator, turns: float, end: str) -> Skeleton:
    """Build a spring: a wire wound around z, with or without parts at its ends."""
    radius = g.uniform(0.4, 0.6)
    pitch = g.uniform(0.34, 0.46)
    tube = g.uniform(0.1, 0.125)
    solid = Helix(radius, pitch, turns, tube)
    if end == "plain":
        return Skeleton(Part(solid, "coil"))
    end_solid = Blob((0.2, 0.2, 0.2)) if end == "knob" else Prism(16, 0.3, 0.2, 0.07)
    children = tuple(Part(end_solid, "end", at=solid.at(share)) for share in (0.0, 1.0))
    return Skeleton(Part(solid, "coil", children=children))

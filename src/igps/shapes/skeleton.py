"""Skeletons: trees of solids connected by ball joints, and their poses.

In the world, z is up and y points backwards. A limb extends along its own +z. The limits of a joint are degrees about
its own x (raise), y (swing) and z (twist).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats
from igps.shapes.solids import Cone, Solid, Vector

ORIGIN: Vector = (0.0, 0.0, 0.0)
UP: Vector = (0.0, 0.0, 1.0)
DOWN: Vector = (0.0, 0.0, -1.0)

# Largest differences of thickness and of length between bodies of a class, in logarithms
_PROPORTIONS = (0.1, 0.13)


@dataclass(frozen=True)
class Part:
    """A solid and the joint that connects it to its parent."""

    solid: Solid
    group: str = "body"  # parts of one group share their proportions
    bend: Vector = ORIGIN  # limits of the joint (raise, swing, twist), degrees
    at: Vector = ORIGIN  # position of the joint in the frame of the parent
    # Frame of the joint at rest, in that of the parent
    turn: Floats = field(default_factory=lambda: np.eye(3))
    blend: float = 0.06  # distance within which the union with other solids is smooth
    lift: float = 0.0  # distance of the origin of the solid from the joint, along z
    children: tuple[Part, ...] = ()

    def joined(self, at: Vector, heading: Vector = UP, roll: float = 0.0) -> Part:
        """Return a copy at another place, with +z along ``heading``, rotated around it by ``roll`` radians."""
        return replace(self, at=at, turn=aim(heading, roll))

    def on_both_sides(self, at: Vector, heading: Vector) -> tuple[Part, Part]:
        """Return a copy at another place, see `joined`, and before it one at the mirror image of that place in x."""
        x, y, z = at
        across, back, up = heading
        mirrored = self.joined((-x, y, z), (-across, back, up))
        return mirrored, self.joined(at, heading)

    def walk(self) -> Iterator[Part]:
        """Iterate over this part and its descendants."""
        yield self
        for child in self.children:
            yield from child.walk()


@dataclass(frozen=True)
class Skeleton:
    """A tree of parts; ``loops`` counts the handles that limbs form where they meet."""

    root: Part
    loops: int = 0

    @property
    def genus(self) -> int:
        """The number of handles of all shapes of this skeleton."""
        return self.loops + sum(part.solid.genus for part in self.root.walk())


@dataclass(frozen=True)
class Placed:
    """A solid in the world: ``world = rotation @ local + offset``."""

    solid: Solid
    rotation: Floats
    offset: Floats
    blend: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return the signed distance of the solid at world coordinates."""
        # Not a matrix product, which may sum in another order on another number of threads.
        a, b, c = self.offset
        x = x - a
        y = y - b
        z = z - c
        local = []
        for across, back, up in self.rotation.T:
            local.append(across * x + back * y + up * z)
        return self.solid.distance(*local)

    def bounds(self) -> tuple[Floats, Floats]:
        """Return the lower and upper corner of a box around the solid, along the axes of the world."""
        low, high = self.solid.box()
        local_centre = 0.5 * (low + high)
        local_half = 0.5 * (high - low)
        turned_centre = self.rotation * local_centre
        turned_half = np.abs(self.rotation) * local_half
        centre = turned_centre.sum(axis=1) + self.offset
        half = turned_half.sum(axis=1)
        return centre - half, centre + half


def aim(heading: Vector, roll: float = 0.0) -> Floats:
    """Return a rotation of +z to ``heading``; before the roll, x is level, or close to x if the heading is steep."""
    z = np.array(heading) / np.linalg.norm(heading)
    across, back, up = z
    x = np.array([-back, across, 0.0])
    if abs(up) > 0.9:
        x = np.array([1.0, 0.0, 0.0]) - across * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    rolled = Rotation.from_euler("z", roll)
    return np.column_stack([x, y, z]) @ rolled.as_matrix()


def turned(axes: str, *degrees: float) -> Floats:
    """Return a rotation by Euler angles, see `scipy.spatial.transform.Rotation.from_euler`."""
    rotation = Rotation.from_euler(axes, degrees, degrees=True)
    return np.asarray(rotation.as_matrix()).reshape(3, 3)


def circle(count: int, phase: float = 0.0) -> list[tuple[float, float]]:
    """Return equally spaced points (cos, sin) of the unit circle."""
    angles = phase + 2.0 * np.pi * np.arange(count) / count
    x = np.cos(angles).tolist()
    y = np.sin(angles).tolist()
    return list(zip(x, y, strict=True))


def limb(
    group: str,
    lengths: Sequence[float],
    radii: Sequence[float],
    bends: Sequence[tuple[float, float]],
    tip: Sequence[Part] = (),
    knee: Vector = UP,
) -> Part:
    """Return a chain of tapered capsules with the parts ``tip`` at its end.

    Args:
        radii: radii where segments begin, meet and end, one more than ``lengths``.
        bends: (raise, swing) limits of the joints; further joints have the limits of the last pair.
        tip: parts on the last segment.
        knee: heading of each segment but the first, in the frame of the segment before it.
    """
    children = tuple(tip)
    for i in reversed(range(len(lengths))):
        raising, swinging = bends[min(i, len(bends) - 1)]
        part = Part(
            Cone(lengths[i], radii[i], radii[i + 1]),
            group,
            bend=(raising, swinging, 0.0),
            blend=0.5 * radii[i],
            children=children,
        )
        if i > 0:
            part = part.joined((0.0, 0.0, lengths[i - 1]), knee)
        children = (part,)
    return children[0]


def pose(
    skeleton: Skeleton, rng: np.random.Generator, flex: float, rotation: Floats
) -> list[Placed]:
    """Draw proportions and joint angles, up to ``flex`` times their limits, and place all solids."""
    proportions: dict[str, tuple[float, float]] = {}
    placed: list[Placed] = []

    def place(part: Part, frame: Floats, origin: Floats) -> None:
        if part.group not in proportions:
            logarithms = rng.uniform(-1.0, 1.0, 2) * _PROPORTIONS
            thickness, length = np.exp(logarithms).tolist()
            proportions[part.group] = (thickness, length)
        own = proportions[part.group]
        limits = flex * np.array(part.bend)
        angles = limits * rng.uniform(-1.0, 1.0, 3)
        frame = frame @ part.turn @ turned("xyz", *angles)
        solid = part.solid.stretched(*own)
        factors = part.solid.factors(*own)
        lift = frame[:, 2] * (part.lift * factors[2])
        placed.append(Placed(solid, frame, origin + lift, part.blend))
        for child in part.children:
            joint = frame @ (factors * np.array(child.at))
            place(child, frame, origin + joint)

    place(skeleton.root, rotation, np.zeros(3))
    return placed

"""Limbs of generated bodies, and the parts at their ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats
from igps.shapes.skeleton import ORIGIN, UP, Part, aim, circle, limb
from igps.shapes.solids import Arc, Blob, Box, Cone, Shell, Solid, Vector
from training.shapes.polygons import Prism
from training.shapes.ring import Ring


def ending(
    kind: str, r: float, group: str, at: Vector = ORIGIN, turn: Floats | None = None
) -> tuple[Part, ...]:
    """Return the parts at the end `at` of a limb of radius `r` whose frame is `turn`, upright if None."""
    frame = np.eye(3) if turn is None else turn

    def part(solid: Solid, lift: float, heading: Vector = UP) -> Part:
        return Part(
            solid,
            f"{group}-{kind}",
            bend=(14, 10, 0),
            at=at,
            turn=frame @ aim(heading),
            blend=0.4 * r,
            lift=lift,
        )

    match kind:
        case "plain":
            return ()
        case "knob":
            return (part(Blob((2.0 * r, 2.0 * r, 2.1 * r)), 1.5 * r),)
        case "ring":
            return (part(Ring(2.6 * r, 0.9 * r), 2.8 * r),)
        case "paddle":
            return (part(Box((4.6 * r, 1.7 * r, 5.2 * r), 0.6 * r), 2.4 * r),)
        case "fork":
            prong = Cone(4.2 * r, 0.95 * r, 0.85 * r)
            return (part(prong, 0.0, (-1, 0, 1.1)), part(prong, 0.0, (1, 0, 1.1)))
        case "claw":
            finger = Cone(3.6 * r, 0.95 * r, 0.85 * r)
            return tuple(part(finger, 0.0, (x, y, 0.7)) for x, y in circle(3))
        case "hook":
            return (part(Arc(2.2 * r, 3.2, 0.95 * r, 0.85 * r), 0.0),)
        case "hammer":
            return (part(Box((7.0 * r, 2.6 * r, 2.6 * r), 0.7 * r), 0.8 * r),)
        case "disc":
            return (part(Prism(16, 3.2 * r, 1.8 * r, 0.6 * r), 0.4 * r),)
        case "cup":
            angles = np.linspace(0.0, 1.7, 7)
            radii = 3.2 * r * np.sin(angles)
            heights = 3.2 * r * (1.0 - np.cos(angles))
            bowl = tuple(zip(radii.tolist(), heights.tolist(), strict=True))
            return (part(Shell(bowl, 1.5 * r), 0.6 * r),)
    raise AssertionError(kind)


def around(
    part: Part,
    directions: Sequence[tuple[float, float]],
    radius: float,
    height: float,
    heading: tuple[float, float],
    roll: float = 0.0,
) -> tuple[Part, ...]:
    """Return copies of a part around z.

    Args:
        part: the part.
        directions: (x, y) from z to each copy, see `circle`.
        radius: distance of the joints from z.
        height: z of the joints.
        heading: how far outward and how far upward the copies point.
        roll: rotation about their own z, radians.
    """
    outward, upward = heading
    copies = []
    for x, y in directions:
        place = (radius * x, radius * y, height)
        copies.append(part.joined(place, (outward * x, outward * y, upward), roll))
    return tuple(copies)


@dataclass(frozen=True)
class LimbStyle:
    """The common properties of the limbs of a body."""

    kind: str  # stub, straight, bent, jointed or tentacle
    ending: str  # kind of the parts at the end, see `ending`
    length: float  # of the whole limb; a stub is 0.3 times as long
    start: float  # radius at the root
    end: float  # radius at the end
    # Angle at rest, radians: of the arc of a bent limb, or of the joints of other limbs
    curl: float
    swing: float  # limit of the first joint, degrees; other joints bend more

    @classmethod
    def draw(
        cls,
        g: np.random.Generator,
        kind: str,
        ending: str,
        length: float,
        radius: float,
        swing: float = 14.0,
    ) -> LimbStyle:
        """Draw proportions near the given length and radius."""
        start = radius * g.uniform(0.95, 1.25)
        if kind == "bent":
            curl = g.uniform(0.8, 1.6)
        else:
            side = g.choice([-1.0, 1.0])
            curl = side * g.uniform(0.2, 0.9)
        return cls(
            kind,
            ending,
            length=length * g.uniform(0.8, 1.25),
            start=start,
            end=start * g.uniform(0.62, 0.95),
            curl=curl,
            swing=swing,
        )

    def grow(self, group: str = "limb") -> Part:
        """Return a limb that curls towards its own y, to be joined to a body."""
        aside = 0.6 * self.swing
        if self.kind == "bent":
            arc = Arc(self.length / self.curl, self.curl, self.start, self.end)
            tangent = Rotation.from_euler("x", -self.curl).as_matrix()
            tip = ending(self.ending, self.end, group, arc.tip(), tangent)
            bend = (self.swing, aside, 0)
            return Part(arc, group, bend, blend=0.5 * self.start, children=tip)
        whole = 0.3 * self.length if self.kind == "stub" else self.length
        curl = 0.5 * self.curl if self.kind == "tentacle" else self.curl
        n_bones = {"stub": 1, "straight": 1, "jointed": 2, "tentacle": 3}[self.kind]
        length = whole / n_bones
        return limb(
            group,
            [length] * n_bones,
            radii=np.linspace(self.start, self.end, n_bones + 1).tolist(),
            bends=[(self.swing, aside), (1.6 * self.swing, self.swing)],
            tip=ending(self.ending, self.end, group, (0, 0, length)),
            knee=(0.0, float(np.sin(curl)), float(np.cos(curl))),
        )

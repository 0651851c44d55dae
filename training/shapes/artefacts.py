"""Builders of artefacts: vessels, wheels, tables, tools, tongs and stacks.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from igps._arrays import Floats
from igps.shapes.skeleton import DOWN, ORIGIN, Part, Skeleton, aim, circle, limb, turned
from igps.shapes.solids import Arc, Blob, Box, Cone, Shell, Solid
from training.shapes.limbs import LimbStyle, around, ending
from training.shapes.polygons import Frame, Prism
from training.shapes.ring import Ring

# Shares of the height at which the handles of a vessel end
_HANDLE_ENDS = {"bowl": (0.08, 0.93), "vase": (0.42, 0.98), "bottle": (0.35, 0.93)}
# Distances of legs and back from the centre of a table, over its width
_PLACES = {
    "round": (0.72, 0.8),
    "square": (0.95, 0.75),
    "long": (0.72, 1.3),
    "triangle": (0.9, 0.5),
    "hoop": (1.0, 1.0),
}


def vessel(g: np.random.Generator, body: str, handles: int, foot: str, extra: str) -> Skeleton:
    """Build a hollow body of revolution with handles, a foot, and a spout or knobs."""
    wide = g.uniform(0.4, 0.6)
    high = g.uniform(0.95, 1.4)
    thick = g.uniform(0.17, 0.21)
    profile = [(float(r), float(z)) for r, z in _profile(g, body, wide, high)]
    wall = _Wall(*np.array(profile).T)
    parts = [*_handles(wall, body, handles)]
    match extra:
        case "spout":
            r, z = wall.at(0.4)
            spout = limb(
                "spout",
                lengths=[0.45, 0.3],
                radii=[0.15, 0.12, 0.1],
                bends=[(12, 8)],
            )
            parts.append(spout.joined((0, -r, z), (0, -1, 0.7)))
        case "knobs":
            r, z = wall.at(0.5)
            knob = Part(Blob((0.16, 0.16, 0.16)), "knob", lift=0.08)
            parts += around(knob, circle(5, 0.6), r, z, (1.0, 0.0))
    match foot:
        case "legs":
            bottom = float(wall.radii[0])
            reach = max(bottom, 0.3)
            z = 0.0
            if not bottom:
                z = float(np.interp(reach, wall.radii[:3], wall.heights[:3]))
            leg = limb(
                "leg",
                lengths=[0.5],
                radii=[0.12, 0.1],
                bends=[(9, 9)],
            )
            parts += around(leg, circle(3, 0.3), reach, z, (0.4, -1.0))
        case "stem":
            disc = Prism(24, 0.42, 0.18, 0.07)
            plate = Part(disc, "foot", at=(0, 0, 0.5))
            stem = limb(
                "stem",
                lengths=[0.5],
                radii=[0.13, 0.12],
                bends=[(4, 4)],
                tip=[plate],
            )
            parts.append(stem.joined(ORIGIN, DOWN))
    shell = Shell(tuple(profile), thick)
    return Skeleton(Part(shell, blend=0.05, children=tuple(parts)), handles)


class _Wall(NamedTuple):
    """The wall of a vessel by radii and heights, from the bottom up."""

    radii: Floats
    heights: Floats

    def at(self, share: float) -> tuple[float, float]:
        """Return the radius and the height of the wall at a share of its height."""
        has_flat_bottom = self.radii[0] == 0.0 and self.heights[1] == 0.0
        start = 1 if has_flat_bottom else 0
        height = share * self.heights[-1]
        radius = np.interp(height, self.heights[start:], self.radii[start:])
        return float(radius), float(height)


def _handles(wall: _Wall, body: str, n: int) -> tuple[Part, ...]:
    """Return handles on a straight or concave part of the wall, because a bulge would fill their opening."""
    lower, upper = _HANDLE_ENDS.get(body, (0.18, 0.85))
    start_radius, start = wall.at(lower)
    end_radius, end = wall.at(upper)
    rise = end - start
    span = float(np.hypot(end_radius - start_radius, rise))
    arc = Arc(0.5 * span, np.pi, 0.1, 0.1)
    handle = Part(arc, "handle", (0, 5, 0), blend=0.04)
    heading = (rise, start_radius - end_radius)
    return around(handle, circle(n), start_radius, start, heading)


def _profile(
    g: np.random.Generator, body: str, wide: float, high: float
) -> list[tuple[float, float]]:
    """The wall of a vessel: points (radius, height) from the bottom up."""
    match body:
        case "bowl":
            sweep = np.linspace(0.0, g.uniform(1.4, 1.9), 9)
            radius = 1.6 * wide
            return [(radius * np.sin(a), radius * (1.0 - np.cos(a))) for a in sweep]
        case "vase":
            waist = g.uniform(0.4, 0.6) * wide + 0.08
            return [
                (0, 0),
                (0.75 * wide, 0),
                (1.2 * wide, 0.4 * high),
                (waist, 0.8 * high),
                (0.9 * wide, high),
            ]
        case "bottle":
            return [
                (0, 0),
                (0.9 * wide, 0),
                (0.9 * wide, 0.6 * high),
                (0.24, 0.8 * high),
                (0.24, 1.15 * high),
            ]
    narrow = wide * g.uniform(0.6, 1.0)
    if body == "pipe":
        return [(narrow, 0), (wide, high)]
    return [(0, 0), (narrow, 0), (wide, high)]


def wheel(g: np.random.Generator, n: int, spokes: int, limbs: str, end: str) -> Skeleton:
    """Build a rigid frame with spokes inside and limbs at its corners."""
    radius = g.uniform(0.75, 0.95) * (1.0 + 0.07 * spokes)
    kind = "jointed" if limbs == "rays" else "straight"
    style = LimbStyle.draw(g, kind, end, 0.6, 0.11)
    corners = circle(n)
    spoke = limb(
        "body",
        lengths=[radius],
        radii=[0.1, 0.1],
        bends=[(0, 0)],
    )
    ends = [corners[i * n // spokes] for i in range(spokes)]
    parts = [*around(spoke, ends, 0.0, 0.0, (1.0, 0.0))]
    if spokes:
        hub = Blob((0.2, 0.2, 0.15))
        parts.append(Part(hub, "hub"))
    arm = style.grow()
    match limbs:
        case "rays":
            parts += around(arm, corners, radius, 0.0, (1.0, 0.3))
        case "legs":
            parts += around(arm, corners, radius, 0.0, (0.2, -1.0))
        case "mast":
            mast = replace(style, length=1.5 * style.length).grow()
            parts.append(mast.joined((radius, 0, 0), (1, 0, 0)))
    frame = Frame(n, radius, 0.12)
    n_loops = max(spokes - 1, 0)
    return Skeleton(Part(frame, children=tuple(parts)), n_loops)


def table(g: np.random.Generator, top: str, legs: int, back: str) -> Skeleton:
    """Build a plate on legs, with or without a back."""
    wide = g.uniform(0.5, 0.75)
    thick = g.uniform(0.17, 0.24)
    hoop = top == "hoop"
    long = top == "long"
    legs_at, back_at = _PLACES[top]
    reach = legs_at * wide
    rear = back_at * wide
    splay = g.uniform(0.0, 0.5)
    high = g.uniform(0.5, 1.1)
    kind = str(g.choice(["straight", "bent", "jointed"]))
    end = str(g.choice(["plain", "knob"]))
    style = LimbStyle.draw(g, kind, end, high, 0.11, 8.0)
    curl = g.uniform(0.4, 0.9)
    if legs == 1:
        disc = Prism(24, 0.8 * wide, 0.2, 0.08)
        foot = Part(disc, "foot", (4, 4, 0), (0, 0, high))
        stem = limb(
            "stem",
            lengths=[high],
            radii=[0.15, 0.15],
            bends=[(4, 4)],
            tip=[foot],
        )
        aside = reach if hoop else 0.0
        parts = [stem.joined((aside, 0, 0), DOWN)]
    else:
        leg = replace(style, curl=curl).grow()
        stretch = 1.9 if long else 1.0
        parts = []
        for x, y in circle(legs, np.pi / 4 if long else 0.0):
            corner = (reach * x, stretch * reach * y, 0)
            parts.append(leg.joined(corner, (splay * x, splay * y, -1)))
    parts += _back(back, wide, rear, hoop)
    return Skeleton(Part(_top(top, wide, thick), children=tuple(parts)))


def _top(kind: str, wide: float, thick: float) -> Solid:
    """The plate of a table."""
    match kind:
        case "round":
            return Prism(24, wide, thick, 0.07)
        case "square":
            return Prism(4, 1.25 * wide, thick, 0.07)
        case "long":
            return Box((1.5 * wide, 2.9 * wide, thick), 0.07)
        case "triangle":
            return Prism(3, 1.4 * wide, thick, 0.07)
        case _:
            return Frame(20, wide, 0.13)


def _back(kind: str, wide: float, rear: float, hoop: bool) -> list[Part]:
    """The back of a table of some width, at a distance behind its centre; none of an unknown kind."""
    place = (0, rear, 0)
    bend = (12, 0, 0)
    match kind:
        case "panel":
            panel = Box((1.2 * wide, 0.18, 0.9), 0.07)
            return [Part(panel, "back", bend, place, lift=0.42)]
        case "arch":
            arch = Ring(0.6 * wide, 0.11, 0.15)
            lift = 0.6 * wide + 0.2
            return [Part(arch, "back", bend, place, lift=lift)]
        case "post":
            knob = ending("knob", 0.1, "back", (0, 0, 0.8))
            post = limb(
                "back",
                lengths=[0.8],
                radii=[0.12, 0.11],
                bends=[(12, 12)],
                tip=knob,
            )
            return [post.joined(place)]
        case "horns":
            horn = limb(
                "back",
                lengths=[0.5, 0.3],
                radii=[0.12, 0.11, 0.1],
                bends=[(12, 12)],
            )
            horns = []
            for side in (-1, 1):
                seat = (0.5 * wide * side, rear, 0)
                if hoop:  # in front and behind, where it has its tube
                    seat = (0, rear * side, 0)
                horns.append(horn.joined(seat, (0.3 * side, 0.1, 1)))
            return horns
    return []


def tool(g: np.random.Generator, shaft: str, head: str, pommel: str) -> Skeleton:
    """Build a shaft with a head and a pommel."""
    length = g.uniform(1.1, 1.9)
    style = LimbStyle.draw(g, shaft, head, length, 0.13, 12.0)
    end = style.start * g.uniform(0.8, 1.25)
    root = replace(style, end=end, curl=0.6 * style.curl).grow("shaft")
    butt = ending(pommel, 0.95 * style.start, "pommel", ORIGIN, aim(DOWN))
    return Skeleton(replace(root, children=root.children + butt))


def tongs(g: np.random.Generator, jaw: str, grip: str, arms: int) -> Skeleton:
    """Build two or three arms that cross at a pivot."""
    shortest = 0.6 if jaw in ("plain", "hook") else 0.85
    front = g.uniform(shortest, 1.1)
    rear = g.uniform(0.85, 1.3)
    opening = g.uniform(26.0, 38.0) if arms == 2 else g.uniform(38.0, 48.0)
    radius = g.uniform(0.11, 0.14)
    thin = 0.85 * radius
    if grip == "bow":
        bow = Arc(rear, 1.0, radius, thin)
        tail = Part(bow, "grip").joined(ORIGIN, DOWN, roll=0.5 * np.pi)
    else:
        handle = Cone(rear, radius, thin)
        end = ending(grip, thin, "grip", (0, 0, rear))
        tail = Part(handle, "grip", children=end).joined(ORIGIN, DOWN)
    blade = Cone(front, 1.1 * radius, 0.8 * radius)
    tip = ending(jaw, 0.8 * radius, "jaw", (0, 0, front))
    arm = Part(blade, "jaw", (0, 7, 0), children=(*tip, tail))
    parts = []
    for i in range(arms):
        turn = turned("ZY", 360.0 * i / arms, opening)
        parts.append(replace(arm, turn=turn))
    pivot = Blob((0.2, 0.15, 0.2))
    return Skeleton(Part(pivot, "pivot", children=tuple(parts)))


# Number, kind, end and length of the limbs at the sides of a stack
_STACKED_LIMBS = {
    "bare": (0, "stub", "plain", 0.3),
    "arms": (2, "jointed", "knob", 0.9),
    "pegs": (4, "straight", "plain", 0.5),
    "hoops": (2, "stub", "ring", 0.5),
}


def stack(g: np.random.Generator, layers: tuple[str, ...], side: str) -> Skeleton:
    """Build layers on top of each other, with limbs at the sides of the first layer."""
    children: tuple[Part, ...] = ()
    for i, layer in reversed(list(enumerate(layers))):
        size = g.uniform(0.28, 0.5)
        solid, high = _layer(g, layer, size)
        top = (0, 0, high)
        middle = 0.5 * high
        children = tuple(replace(child, at=top) for child in children)
        if i == 0:
            # A hoop has its limbs on the left and right, where it has its tube. Posts are thin whatever their height.
            reach = {"hoop": size, "post": 0.12}.get(layer, 0.85 * size)
            count, kind, end, length = _STACKED_LIMBS[side]
            if side == "pegs" and layer == "hoop":
                count = 2
            arm = LimbStyle.draw(g, kind, end, length, 0.12).grow()
            children += around(arm, circle(count), reach, middle, (1.0, 0.3))
        part = Part(solid, f"layer{i}", (7, 7, 12), lift=middle, children=children)
        children = (part,)
    return Skeleton(part)


def _layer(g: np.random.Generator, kind: str, size: float) -> tuple[Solid, float]:
    """Draw a layer of a stack; also return the height at which the next one begins."""
    match kind:
        case "ball":
            upright = size * g.uniform(0.7, 1.2)
            return Blob((size, size, upright)), 1.6 * size
        case "block":
            wide = 1.7 * size
            deep = wide * g.uniform(0.6, 1.0)
            return Box((wide, deep, 1.8 * size), 0.06), wide
        case "plate":
            n_sides = int(g.choice([3, 4, 6, 24]))
            return Prism(n_sides, 1.6 * size, 0.22, 0.08), 0.18
        case "post":
            return Prism(24, 0.2, 1.2 * size, 0.06), 1.15 * size
        case _:
            return Ring(size, 0.13), 2.0 * size + 0.1

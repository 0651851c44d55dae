"""Builders of artefacts: vessels, wheels, tables, tools, tongs and stacks.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

from dataclasses import replace

import numpy as np

from igps.shapes.skeleton import DOWN, ORIGIN, Part, Skeleton, aim, circle, limb, turned
from igps.shapes.solids import Arc, Blob, Box, Cone, Shell, Solid
from training.shapes.limbs import LimbStyle, ending
from training.shapes.polygons import Frame, Prism
from training.shapes.ring import Ring

# Shares of the height at which the handles of a vessel end
_HANDLE_ENDS = {"bowl": (0.08, 0.93), "vase": (0.42, 0.98), "bottle": (0.35, 0.93)}


def vessel(g: np.random.Generator, body: str, handles: int, foot: str, extra: str) -> Skeleton:
    """Build a hollow body of revolution with handles, a foot, and a spout or knobs."""
    wide = g.uniform(0.4, 0.6)
    high = g.uniform(0.95, 1.4)
    wall = g.uniform(0.17, 0.21)
    profile = [(float(r), float(z)) for r, z in _profile(g, body, wide, high)]
    radii, heights = np.array(profile).T
    has_flat_bottom = radii[0] == 0.0 and heights[1] == 0.0
    rising = slice(1 if has_flat_bottom else 0, None)

    def wall_at(share: float) -> tuple[float, float]:
        z = share * heights[-1]
        return float(np.interp(z, heights[rising], radii[rising])), float(z)

    # Handles span a straight or concave part of the wall, because a bulge would fill their opening.
    lower, upper = _HANDLE_ENDS.get(body, (0.18, 0.85))
    r0, z0 = wall_at(lower)
    r1, z1 = wall_at(upper)
    rise = z1 - z0
    span = float(np.hypot(r1 - r0, rise))
    arc = Arc(0.5 * span, np.pi, 0.1, 0.1)
    ear = Part(arc, "handle", (0, 5, 0), blend=0.04)
    parts = []
    for c, s in circle(handles):
        place = (r0 * c, r0 * s, z0)
        heading = (c * rise, s * rise, r0 - r1)
        parts.append(ear.joined(place, heading))
    match extra:
        case "spout":
            r, z = wall_at(0.4)
            spout = limb("spout", [0.45, 0.3], [0.15, 0.12, 0.1], [(12, 8)])
            parts.append(spout.joined((0, -r, z), (0, -1, 0.7)))
        case "knobs":
            r, z = wall_at(0.5)
            knob = Part(Blob((0.16, 0.16, 0.16)), "knob", lift=0.08)
            for c, s in circle(5, 0.6):
                parts.append(knob.joined((r * c, r * s, z), (c, s, 0)))
    match foot:
        case "legs":
            bottom = float(radii[0])
            reach = max(bottom, 0.3)
            z = 0.0 if bottom else float(np.interp(reach, radii[:3], heights[:3]))
            leg = limb("leg", [0.5], [0.12, 0.1], [(9, 9)])
            for c, s in circle(3, 0.3):
                place = (reach * c, reach * s, z)
                parts.append(leg.joined(place, (0.4 * c, 0.4 * s, -1)))
        case "stem":
            plate = Part(Prism(24, 0.42, 0.18, 0.07), "foot", at=(0, 0, 0.5))
            stem = limb("stem", [0.5], [0.13, 0.12], [(4, 4)], [plate])
            parts.append(stem.joined(ORIGIN, DOWN))
    shell = Shell(tuple(profile), wall)
    return Skeleton(Part(shell, blend=0.05, children=tuple(parts)), handles)


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
            belly = (1.2 * wide, 0.4 * high)
            return [(0, 0), (0.75 * wide, 0), belly, (waist, 0.8 * high), (0.9 * wide, high)]
        case "bottle":
            return [
                (0, 0),
                (0.9 * wide, 0),
                (0.9 * wide, 0.6 * high),
                (0.24, 0.8 * high),
                (0.24, 1.15 * high),
            ]
        case "pipe":
            return [(wide * g.uniform(0.6, 1.0), 0), (wide, high)]
        case _:
            return [(0, 0), (wide * g.uniform(0.6, 1.0), 0), (wide, high)]


def wheel(g: np.random.Generator, n: int, spokes: int, limbs: str, end: str) -> Skeleton:
    """Build a rigid frame with spokes inside and limbs at its corners."""
    radius = g.uniform(0.75, 0.95) * (1.0 + 0.07 * spokes)
    kind = "jointed" if limbs == "rays" else "straight"
    style = LimbStyle.draw(g, kind, end, 0.6, 0.11)
    corners = circle(n)
    spoke = limb("body", [radius], [0.1, 0.1], [(0, 0)])
    parts = []
    for i in range(spokes):
        c, s = corners[i * n // spokes]
        parts.append(spoke.joined(ORIGIN, (c, s, 0)))
    if spokes:
        parts.append(Part(Blob((0.2, 0.2, 0.15)), "hub"))
    arm = style.grow()
    match limbs:
        case "rays":
            for c, s in corners:
                parts.append(arm.joined((radius * c, radius * s, 0), (c, s, 0.3)))
        case "legs":
            for c, s in corners:
                heading = (0.2 * c, 0.2 * s, -1)
                parts.append(arm.joined((radius * c, radius * s, 0), heading))
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
    solid: Solid
    match top:  # the plate, and the distances of legs and back from its centre
        case "round":
            solid = Prism(24, wide, thick, 0.07)
            reach = 0.72 * wide
            rear = 0.8 * wide
        case "square":
            solid = Prism(4, 1.25 * wide, thick, 0.07)
            reach = 0.95 * wide
            rear = 0.75 * wide
        case "long":
            solid = Box((1.5 * wide, 2.9 * wide, thick), 0.07)
            reach = 0.72 * wide
            rear = 1.3 * wide
        case "triangle":
            solid = Prism(3, 1.4 * wide, thick, 0.07)
            reach = 0.9 * wide
            rear = 0.5 * wide
        case _:
            solid = Frame(20, wide, 0.13)
            reach = wide
            rear = wide
    splay = g.uniform(0.0, 0.5)
    high = g.uniform(0.5, 1.1)
    kind = str(g.choice(["straight", "bent", "jointed"]))
    end = str(g.choice(["plain", "knob"]))
    style = LimbStyle.draw(g, kind, end, high, 0.11, 8.0)
    leg = replace(style, curl=g.uniform(0.4, 0.9)).grow()
    if legs == 1:
        plate = Part(Prism(24, 0.8 * wide, 0.2, 0.08), "foot", (4, 4, 0), (0, 0, high))
        stem = limb("stem", [high], [0.15, 0.15], [(4, 4)], [plate])
        aside = reach if hoop else 0.0
        parts = [stem.joined((aside, 0, 0), DOWN)]
    else:
        corners = circle(legs, np.pi / 4 if long else 0.0)
        stretch = 1.9 if long else 1.0
        parts = []
        for c, s in corners:
            corner = (reach * c, stretch * reach * s, 0)
            parts.append(leg.joined(corner, (splay * c, splay * s, -1)))
    parts += _back(back, wide, rear, hoop)
    return Skeleton(Part(solid, children=tuple(parts)))


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
            post = limb("back", [0.8], [0.12, 0.11], [(12, 12)], knob)
            return [post.joined(place)]
        case "horns":
            horn = limb("back", [0.5, 0.3], [0.12, 0.11, 0.1], [(12, 12)])
            horns = []
            for s in (-1, 1):
                seat = (0.5 * wide * s, rear, 0)
                if hoop:  # in front and behind, where it has its tube
                    seat = (0, rear * s, 0)
                horns.append(horn.joined(seat, (0.3 * s, 0.1, 1)))
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
    least, most = (26.0, 38.0) if arms == 2 else (38.0, 48.0)
    opening = g.uniform(least, most)
    r = g.uniform(0.11, 0.14)
    tip = ending(jaw, 0.8 * r, "jaw", (0, 0, front))
    if grip == "bow":
        bow = Arc(rear, 1.0, r, 0.85 * r)
        tail = Part(bow, "grip").joined(ORIGIN, DOWN, roll=0.5 * np.pi)
    else:
        end = ending(grip, 0.85 * r, "grip", (0, 0, rear))
        handle = Cone(rear, r, 0.85 * r)
        tail = Part(handle, "grip", children=end).joined(ORIGIN, DOWN)
    blade = Cone(front, 1.1 * r, 0.8 * r)
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
        solid: Solid
        match layer:
            case "ball":
                upright = size * g.uniform(0.7, 1.2)
                solid = Blob((size, size, upright))
                high = 1.6 * size
            case "block":
                wide = 1.7 * size
                deep = wide * g.uniform(0.6, 1.0)
                solid = Box((wide, deep, 1.8 * size), 0.06)
                high = 1.7 * size
            case "plate":
                n_sides = int(g.choice([3, 4, 6, 24]))
                solid = Prism(n_sides, 1.6 * size, 0.22, 0.08)
                high = 0.18
            case "post":
                solid = Prism(24, 0.2, 1.2 * size, 0.06)
                high = 1.15 * size
            case _:
                solid = Ring(size, 0.13)
                high = 2.0 * size + 0.1
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
            for c, s in circle(count):
                place = (reach * c, reach * s, middle)
                children += (arm.joined(place, (c, s, 0.3)),)
        part = Part(solid, f"layer{i}", (7, 7, 12), lift=middle, children=children)
        children = (part,)
    return Skeleton(children[0])

"""Builders of creatures: limbs around a hub, along a spine, or on a trunk.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

from dataclasses import replace

import numpy as np

from igps.shapes.skeleton import DOWN, ORIGIN, Part, Skeleton, aim, circle, limb, turned
from igps.shapes.solids import Blob, Box, Cone, Shell, Solid
from training.shapes.limbs import LimbStyle, around, ending
from training.shapes.polygons import Frame, Prism
from training.shapes.ring import Ring

_HEADS = {
    "horned": "fork",
    "bill": "paddle",
    "looped": "ring",
    "round": "knob",
    "long": "knob",
}
_TAILS = {"whip": "plain", "fluke": "paddle", "loop": "ring", "club": "knob"}
# What links and teeth that are wide need beyond the gaps and steps of others
_WIDER_GAPS = {"boxes": 0.12, "plates": 0.16, "tubes": 0.14}
_WIDER_STEPS = {"knob": 0.15, "disc": 0.35}


def star(g: np.random.Generator, core: str, n: int, kind: str, end: str) -> Skeleton:
    """Build a hub with `n` limbs, with n-fold symmetry."""
    length = float(np.clip(6.5 / n, 0.8, 1.4))
    style = LimbStyle.draw(g, kind, end, length, 0.13)
    least = max(0.36, 0.5 * n * style.start)
    radius = least * g.uniform(0.95, 1.3)
    rise = g.uniform(-0.8, 0.8)
    roll = 0.0
    if kind == "bent":
        roll = g.choice([0.0, 0.5 * np.pi, np.pi])
    solid: Solid
    match core:
        case "orb":
            high = radius * g.uniform(0.7, 1.3)
            solid = Blob((radius, radius, high))
            seat = 0.75 * radius
        case "disc":
            solid = Prism(24, radius, 0.3, 0.1)
            seat = 0.85 * radius
        case "hoop":
            seat = 1.15 * radius
            solid = Frame(24, seat, 0.14)
            rise = max(rise, -0.3)
        case "drum":
            profile = ((radius, -0.4), (radius, 0.4))
            solid = Shell(profile, 0.2)
            seat = radius
        case _:
            thick = 0.35 * g.uniform(0.9, 2.0)
            solid = Prism(n, radius * 1.2, thick, 0.08)
            seat = 0.95 * radius
    arms = around(style.grow(), circle(n), seat, 0.0, (1.0, rise), roll)
    return Skeleton(Part(solid, children=arms))


def tree(g: np.random.Generator, branches: int, twigs: int, end: str, base: str) -> Skeleton:
    """Build a trunk that branches once or twice."""
    twig_length = 0.42 if twigs else 0.3
    style = LimbStyle.draw(g, "straight", end, twig_length, 0.1, 10.0)
    rise = g.uniform(0.2, 1.3)
    spread = g.uniform(0.6, 1.0)
    length = g.uniform(0.4, 0.75)
    directions = circle(branches, g.uniform(0, np.pi))
    height = g.uniform(0.6, 1.3)
    twig = style.grow("twig")
    tips = around(twig, circle(twigs, 0.5), 0.0, length, (spread, 0.9))
    if not twigs:
        tips = ending(end, 0.11, "twig", (0, 0, length))
    branch = limb(
        "branch",
        lengths=[length],
        radii=[0.14, 0.11],
        bends=[(12, 9)],
        tip=tips,
    )
    parts = [*around(branch, directions, 0.0, height, (1.0, rise))]
    match base:
        case "plate":
            n_sides = int(g.choice([3, 4, 6, 24]))
            radius = g.uniform(0.4, 0.6)
            plate = Prism(n_sides, radius, 0.22, 0.08)
            parts.append(Part(plate, "base"))
        case "bulb":
            high = g.uniform(0.3, 0.5)
            bulb = Blob((0.38, 0.38, high))
            parts.append(Part(bulb, "base"))
        case "tripod":
            root = limb(
                "root",
                lengths=[0.5],
                radii=[0.13, 0.1],
                bends=[(8, 8)],
            )
            parts += around(root, circle(3), 0.0, 0.03, (1.0, -0.5))
    trunk = Cone(height, 0.18, 0.15)
    return Skeleton(Part(trunk, "trunk", children=tuple(parts)))


def beast(g: np.random.Generator, pairs: int, stance: str, head: str, tail: str) -> Skeleton:
    """Build a body with bilateral symmetry: pairs of legs, a head and a tail."""
    half = 0.3 + 0.15 * pairs * g.uniform(0.9, 1.25)
    girth = g.uniform(0.22, 0.36)
    parts = _legs(g, pairs, stance, half, girth)
    if head == "long":
        reach = g.uniform(0.7, 0.9)
        wide = 0.1
    else:
        reach = g.uniform(0.2, 0.35)
        wide = 0.13
    forward = aim((0, -0.3, 1))
    tip = ending(_HEADS[head], wide, "head", (0, 0, reach), forward)
    neck = limb(
        "neck",
        lengths=[reach],
        radii=[0.16, 0.12],
        bends=[(16, 14)],
        tip=tip,
    )
    front = (0, -0.85 * half, 0.1 * girth)
    rise = g.uniform(0.2, 1.2)
    parts.append(neck.joined(front, (0, -1, rise)))
    if tail != "bare":
        is_whip = tail == "whip"
        kind = "tentacle" if is_whip else "straight"
        length = 0.9 if is_whip else 0.4
        style = LimbStyle.draw(g, kind, _TAILS[tail], length, 0.12, 16.0)
        back = (0, 0.88 * half, 0.1 * girth)
        rise = g.uniform(0.0, 0.8)
        rear = style.grow("tail")
        parts.append(rear.joined(back, (0, 1, rise)))
    wide = girth * g.uniform(0.9, 1.3)
    trunk = Blob((wide, half, girth))
    return Skeleton(Part(trunk, children=tuple(parts)))


def _legs(g: np.random.Generator, pairs: int, stance: str, half: float, girth: float) -> list[Part]:
    """Draw pairs of legs along a trunk of some half length and girth."""
    if stance == "fins":
        style = LimbStyle.draw(g, "straight", "paddle", 0.4, 0.12, 10.0)
    else:
        style = LimbStyle.draw(g, "jointed", "plain", 0.85, 0.12, 10.0)
    stands = stance == "stand"
    curl = 0.3 if stands else -abs(style.curl) - 0.3
    leg = replace(style, curl=curl).grow()
    places = np.array([-0.2 * half])
    if pairs > 1:
        places = np.linspace(-0.72, 0.72, pairs) * half
    legs = []
    for y in places.tolist():
        room = girth * np.sqrt(1.0 - (y / half) ** 2)
        for side in (-1, 1):
            if stands:
                place = (0.62 * side * room, y, -0.4 * room)
                heading = (0.2 * side, 0.0, -1.0)
            else:
                place = (0.6 * side * room, y, 0)
                heading = (float(side), 0.5 * y / half, 0.25)
            legs.append(leg.joined(place, heading))
    return legs


def chain(g: np.random.Generator, n: int, link: str, end: str) -> Skeleton:
    """Build a row of `n` links with joints between them."""
    radius = g.uniform(0.22, 0.3)
    # Their edges must not meet when the chain bends
    is_stiff = link in _WIDER_GAPS
    gap = g.uniform(0.08, 0.2) + _WIDER_GAPS.get(link, 0.0)
    bow = g.uniform(-8.0, 8.0) if is_stiff else g.uniform(-16.0, 16.0)
    side = g.uniform(0.0, 0.25)
    if link in ("rings", "crossed"):  # rings touch; other links are connected by bridges
        gap = 0.0
    bridge = Cone(gap + 0.2, 0.11, 0.11)
    limit = 10.0 if is_stiff else 16.0
    roll = 90.0 if link == "crossed" else 0.0
    turn = turned("z", roll) @ turned("x", bow)
    children = ending(end, 0.12, "end")
    for i in range(n):
        scale = 1.25 * 0.86**i
        solid, length = _link(link, radius, side, scale)
        top = (0, 0, length + gap)
        children = tuple(replace(child, at=top) for child in children)
        if gap:
            children += (Part(bridge, "bridge", at=(0, 0, length - 0.1)),)
        part = Part(
            solid,
            "link",
            bend=(limit, limit, 0),
            turn=turn,
            blend=0.05,
            lift=0.5 * length,
            children=children,
        )
        children = (part,)
    last = ending(end, 0.12, "end", ORIGIN, aim(DOWN))
    return Skeleton(replace(part, children=part.children + last))


def _link(kind: str, radius: float, side: float, scale: float) -> tuple[Solid, float]:
    """A link of a chain, and its length; `side` elongates rings, and `scale` is the size of shrinking links."""
    match kind:
        case "beads":
            return Blob((radius,) * 3), 2.0 * radius
        case "boxes":
            wide = 1.8 * radius
            high = 2.0 * radius
            return Box((wide, wide, high), 0.05), high
        case "plates":
            return Prism(24, 1.5 * radius, 0.22, 0.08), 0.2
        case "tubes":
            high = 1.5 * radius
            return Prism(3, high, high, 0.05), high
        case "shrinking":
            return Blob((scale * radius,) * 3), 2.0 * scale * radius
        case _:
            wide = radius * 1.15
            return Ring(wide, 0.11, side), 2.0 * (wide + side)


def comb(g: np.random.Generator, n: int, sides: str, end: str) -> Skeleton:
    """Build a spine with `n` teeth, or a ladder with `n` rungs between two rails."""
    step = g.uniform(0.34, 0.44) + _WIDER_STEPS.get(end, 0.0)
    reach = g.uniform(0.4, 0.7)
    if sides == "ladder":
        return _ladder(n, step, reach, end)
    style = LimbStyle.draw(g, "straight", end, reach, 0.1, 8.0)
    tooth = style.grow("tooth")
    roll = 0.5 * np.pi if end == "hook" else 0.0  # hooks stand across the spine
    bone = Cone(step, 0.14, 0.14)
    middle = (0, 0, 0.5 * step)
    left = tooth.joined(middle, (-1, 0, 0.2), roll)
    right = tooth.joined(middle, (1, 0, 0.2), roll)
    children: tuple[Part, ...] = ()
    for i in reversed(range(n)):
        has_left = sides == "both" or (sides == "zigzag" and i % 2 == 0)
        has_right = sides in ("both", "one") or (sides == "zigzag" and i % 2 == 1)
        if has_left:
            children += (left,)
        if has_right:
            children += (right,)
        place = (0, 0, step if i else 0.0)
        segment = Part(bone, "body", (14, 5, 0), place, children=children)
        children = (segment,)
    return Skeleton(segment)


def _ladder(n: int, step: float, reach: float, end: str) -> Skeleton:
    rail = Cone(step * (n - 1), 0.12, 0.12)
    across = turned("y", 90.0)
    rung = Part(Cone(reach, 0.1, 0.1), turn=across)
    second_rail = Part(rail, at=(0, 0, reach), turn=across.T)
    rungs = [replace(rung, children=(second_rail,))]
    for i in range(1, n):
        rungs.append(replace(rung, at=(0, 0, i * step)))
    tip = ending(end, 0.12, "end", (0, 0, rail.length))
    return Skeleton(Part(rail, children=(*rungs, *tip)), n - 1)


def serpent(g: np.random.Generator, n: int, ornament: str, head: str) -> Skeleton:
    """Build a long flexible body of `n` segments with ornaments: on every second segment, or on all if `n` < 5."""
    step = g.uniform(0.3, 0.42)
    girth = g.uniform(0.13, 0.2)
    neck = g.uniform(0.6, 0.9)
    radii = girth * np.interp(range(n + 1), [0, 0.5 * n, n], [neck, 1.0, 0.9])
    middle = (0, 0, 0.5 * step)
    match ornament:
        case "sail":
            sail = Blob((0.09, 0.36, 0.2))
            extras = [Part(sail, "fin", at=(0, 1.2 * girth, 0.5 * step))]
        case "fins":
            blade = Blob((0.13, 0.085, 0.24))
            fin = Part(blade, "fin", (14, 14, 0), lift=0.18)
            extras = []
            for side in (-1, 1):
                place = (0.6 * girth * side, 0, 0.5 * step)
                extras.append(fin.joined(place, (side, 0, -0.5)))
        case "bulge":
            bulge = Blob((2.0 * girth,) * 3)
            extras = [Part(bulge, "bulge", at=middle)]
        case _:
            collar = Prism(24, 2.3 * girth, 0.18, 0.07)
            extras = [Part(collar, "collar", at=middle)]
    children = ending(head, girth * 0.95, "head", (0, 0, step))
    for i in reversed(range(n)):
        bone = Cone(step, float(radii[i]), float(radii[i + 1]))
        if i % 2 or n < 5:
            children = (*children, *extras)
        place = (0, 0, step if i else 0.0)
        segment = Part(bone, "body", (9, 24, 0), place, blend=0.05, children=children)
        children = (segment,)
    return Skeleton(segment)

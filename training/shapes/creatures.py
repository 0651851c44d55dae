"""Builders of creatures: limbs around a hub, along a spine, or on a trunk.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

from dataclasses import replace

import numpy as np

from igps.shapes.skeleton import DOWN, ORIGIN, Part, Skeleton, aim, circle, limb, turned
from igps.shapes.solids import Blob, Box, Cone, Shell, Solid
from training.shapes.limbs import LimbStyle, ending
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
_WIDER_GAPS = {"boxes": 0.12, "plates": 0.16, "tubes": 0.14}


def star(g: np.random.Generator, core: str, n: int, kind: str, end: str) -> Skeleton:
    """Build a hub with `n` limbs, with n-fold symmetry."""
    length = float(np.clip(6.5 / n, 0.8, 1.4))
    style = LimbStyle.draw(g, kind, end, length, 0.13)
    least = max(0.36, 0.5 * n * style.start)
    radius = least * g.uniform(0.95, 1.3)
    rise = g.uniform(-0.8, 0.8)
    roll = g.choice([0.0, 0.5 * np.pi, np.pi]) if kind == "bent" else 0.0
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
            solid = Frame(24, radius * 1.15, 0.14)
            seat = 1.15 * radius
            rise = max(rise, -0.3)
        case "drum":
            profile = ((radius, -0.4), (radius, 0.4))
            solid = Shell(profile, 0.2)
            seat = radius
        case _:
            thick = 0.35 * g.uniform(0.9, 2.0)
            solid = Prism(n, radius * 1.2, thick, 0.08)
            seat = 0.95 * radius
    arm = style.grow()
    arms = []
    for c, s in circle(n):
        place = (seat * c, seat * s, 0)
        arms.append(arm.joined(place, (c, s, rise), roll))
    return Skeleton(Part(solid, children=tuple(arms)))


def tree(g: np.random.Generator, branches: int, twigs: int, end: str, base: str) -> Skeleton:
    """Build a trunk that branches once or twice."""
    twig_length = 0.42 if twigs else 0.3
    style = LimbStyle.draw(g, "straight", end, twig_length, 0.1, 10.0)
    rise = g.uniform(0.2, 1.3)
    spread = g.uniform(0.6, 1.0)
    length = g.uniform(0.4, 0.75)
    directions = circle(branches, g.uniform(0, np.pi))
    height = g.uniform(0.6, 1.3)
    top = (0, 0, length)
    twig = style.grow("twig")
    crown = []
    for a, b in circle(twigs, 0.5):
        heading = (spread * a, spread * b, 0.9)
        crown.append(twig.joined(top, heading))
    tips = tuple(crown) or ending(end, 0.11, "twig", top)
    branch = limb("branch", [length], [0.14, 0.11], [(12, 9)], tips)
    fork = (0, 0, height)
    parts = [branch.joined(fork, (c, s, rise)) for c, s in directions]
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
            root = limb("root", [0.5], [0.13, 0.1], [(8, 8)])
            foot = (0, 0, 0.03)
            parts += [root.joined(foot, (c, s, -0.5)) for c, s in circle(3)]
    return Skeleton(Part(Cone(height, 0.18, 0.15), "trunk", children=tuple(parts)))


def beast(g: np.random.Generator, pairs: int, stance: str, head: str, tail: str) -> Skeleton:
    """Build a body with bilateral symmetry: pairs of legs, a head and a tail."""
    half = 0.3 + 0.15 * pairs * g.uniform(0.9, 1.25)
    girth = g.uniform(0.22, 0.36)
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
    parts = []
    for y in places.tolist():
        room = girth * np.sqrt(1.0 - (y / half) ** 2)
        for s in (-1, 1):
            if stands:
                place = (0.62 * s * room, y, -0.4 * room)
                heading = (0.2 * s, 0.0, -1.0)
            else:
                place = (0.6 * s * room, y, 0)
                heading = (float(s), 0.5 * y / half, 0.25)
            parts.append(leg.joined(place, heading))
    long = head == "long"
    reach = g.uniform(0.7, 0.9) if long else g.uniform(0.2, 0.35)
    wide = 0.1 if long else 0.13
    tip = ending(_HEADS[head], wide, "head", (0, 0, reach), aim((0, -0.3, 1)))
    neck = limb("neck", [reach], [0.16, 0.12], [(16, 14)], tip)
    front = (0, -0.85 * half, 0.1 * girth)
    rise = g.uniform(0.2, 1.2)
    parts.append(neck.joined(front, (0, -1, rise)))
    if tail != "bare":
        is_whip = tail == "whip"
        kind = "tentacle" if is_whip else "straight"
        length = 0.9 if is_whip else 0.4
        rear = LimbStyle.draw(g, kind, _TAILS[tail], length, 0.12, 16.0).grow("tail")
        back = (0, 0.88 * half, 0.1 * girth)
        rise = g.uniform(0.0, 0.8)
        parts.append(rear.joined(back, (0, 1, rise)))
    wide = girth * g.uniform(0.9, 1.3)
    return Skeleton(Part(Blob((wide, half, girth)), children=tuple(parts)))


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
    limit = 10.0 if is_stiff else 16.0
    roll = 90.0 if link == "crossed" else 0.0
    turn = turned("z", roll) @ turned("x", bow)
    children = ending(end, 0.12, "end")
    for i in range(n):
        solid, length = _link(link, radius, side, 1.25 * 0.86**i)
        top = (0, 0, length + gap)
        children = tuple(replace(child, at=top) for child in children)
        if gap:
            bridge = Cone(gap + 0.2, 0.11, 0.11)
            children += (Part(bridge, "bridge", at=(0, 0, length - 0.1)),)
        bend = (limit, limit, 0)
        child = Part(solid, "link", bend, ORIGIN, turn, 0.05, 0.5 * length, children)
        children = (child,)
    root = children[0]
    last = ending(end, 0.12, "end", ORIGIN, aim(DOWN))
    return Skeleton(replace(root, children=root.children + last))


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
            return Prism(3, 1.5 * radius, 1.5 * radius, 0.05), 1.5 * radius
        case "shrinking":
            return Blob((scale * radius,) * 3), 2.0 * scale * radius
        case _:
            wide = radius * 1.15
            return Ring(wide, 0.11, side), 2.0 * (wide + side)


def comb(g: np.random.Generator, n: int, sides: str, end: str) -> Skeleton:
    """Build a spine with `n` teeth, or a ladder with `n` rungs between two rails."""
    step = g.uniform(0.34, 0.44) + {"knob": 0.15, "disc": 0.35}.get(end, 0.0)
    reach = g.uniform(0.4, 0.7)
    if sides == "ladder":
        rail = Cone(step * (n - 1), 0.12, 0.12)
        across = turned("y", 90.0)
        second = Part(rail, at=(0, 0, reach), turn=across.T)
        rung = Part(Cone(reach, 0.1, 0.1), turn=across)
        rungs = []
        for i in range(n):
            carried = () if i else (second,)
            rungs.append(replace(rung, at=(0, 0, i * step), children=carried))
        tip = ending(end, 0.12, "end", (0, 0, rail.length))
        return Skeleton(Part(rail, children=(*rungs, *tip)), n - 1)
    tooth = LimbStyle.draw(g, "straight", end, reach, 0.1, 8.0).grow("tooth")
    roll = 0.5 * np.pi if end == "hook" else 0.0  # hooks stand across the spine
    segments: tuple[Part, ...] = ()
    segment = Cone(step, 0.14, 0.14)
    middle = (0, 0, 0.5 * step)
    for i in reversed(range(n)):
        headings = [-1, 1]
        if sides == "one":
            headings = [1]
        elif sides == "zigzag":
            headings = [1 if i % 2 else -1]
        teeth = tuple(tooth.joined(middle, (s, 0, 0.2), roll) for s in headings)
        place = (0, 0, step if i else 0.0)
        part = Part(segment, "body", (14, 5, 0), place, children=segments + teeth)
        segments = (part,)
    return Skeleton(segments[0])


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
            fin = Part(Blob((0.13, 0.085, 0.24)), "fin", (14, 14, 0), lift=0.18)
            extras = []
            for s in (-1, 1):
                place = (0.6 * girth * s, 0, 0.5 * step)
                extras.append(fin.joined(place, (s, 0, -0.5)))
        case "bulge":
            bulge = Blob((2.0 * girth,) * 3)
            extras = [Part(bulge, "bulge", at=middle)]
        case _:
            collar = Prism(24, 2.3 * girth, 0.18, 0.07)
            extras = [Part(collar, "collar", at=middle)]
    parts = ending(head, girth * 0.95, "head", (0, 0, step))
    for i in reversed(range(n)):
        cone = Cone(step, float(radii[i]), float(radii[i + 1]))
        children = (*parts, *extras) if i % 2 or n < 5 else parts
        place = (0, 0, step if i else 0.0)
        part = Part(cone, "body", (9, 24, 0), place, blend=0.05, children=children)
        parts = (part,)
    return Skeleton(parts[0])

"""The twelve classes: skeletons of animals and things, designed by hand."""

from collections.abc import Callable

import numpy as np

from igps.shapes.skeleton import DOWN, ORIGIN, Part, Skeleton, circle, limb, turned
from igps.shapes.solids import Arc, Blob, Box, Cone, Ring, Shell


def biped() -> Skeleton:
    foot = limb("foot", [0.22], [0.11, 0.1], [(12, 8)]).joined((0, 0, 0.52), (0, 1, 0.1))
    hand = Part(Blob((0.14, 0.11, 0.17)), "hand", (15, 15, 0), (0, 0, 0.42), lift=0.08)
    arm = limb(
        "arm", [0.44, 0.42], [0.13, 0.11, 0.1], [(40, 30), (35, 15)], [hand], knee=(0, -0.15, 1)
    )
    leg = limb(
        "leg", [0.55, 0.52], [0.17, 0.13, 0.11], [(28, 8), (25, 0)], [foot], knee=(0, -0.12, 1)
    )
    neck = limb("neck", [0.2], [0.12, 0.11], [(5, 5)]).joined((0, 0, 0.8))
    head = Part(Blob((0.21, 0.24, 0.27)), "head", (20, 15, 0), (0, 0, 0.85), lift=0.3)
    arms = [arm.joined((0.3 * s, 0, 0.72), (s, -0.15, -0.35)) for s in (-1, 1)]
    legs = [leg.joined((0.17 * s, 0, -0.02), (0.2 * s, 0, -1)) for s in (-1, 1)]
    return Skeleton(Part(Cone(0.75, 0.25, 0.29), children=(neck, head, *arms, *legs)))


def quadruped() -> Skeleton:
    head = limb("head", [0.32], [0.18, 0.12], [(20, 15)]).joined((0, 0, 0.42), (0, -1, 0.35))
    ear = limb("ear", [0.2], [0.09, 0.08], [(10, 10)])
    ears = [ear.joined((0.1 * s, 0, 0.5), (0.5 * s, 0.2, 1)) for s in (-1, 1)]
    neck = limb("neck", [0.42], [0.19, 0.15], [(18, 15)], [head, *ears]).joined(
        (0, -0.55, 0.08), (0, -0.8, 1)
    )
    tail = limb("tail", [0.3, 0.3], [0.1, 0.09, 0.08], [(20, 25)]).joined(
        (0, 0.62, 0.1), (0, 1, 0.1)
    )
    bones, radii, bends = [0.42, 0.42], [0.15, 0.11, 0.1], [(22, 6), (22, 0)]
    pairs = [
        (limb(group, bones, radii, bends, knee=(0, 0.15, 1)), y)
        for group, y in (("fore", -0.48), ("hind", 0.48))
    ]
    legs = [
        leg.joined((0.18 * s, y, -0.12), (0.12 * s, 0, -1)) for s in (-1, 1) for leg, y in pairs
    ]
    return Skeleton(Part(Blob((0.29, 0.75, 0.31)), children=(neck, tail, *legs)))


def octopus() -> Skeleton:
    bends = [(18, 8), (28, 18), (35, 25)]
    arm = limb("arm", [0.42, 0.4, 0.38], [0.16, 0.13, 0.1, 0.08], bends, knee=(0, 0.12, 1))
    arms = tuple(arm.joined((0.24 * c, 0.24 * s, 0.0), (c, s, -0.35)) for c, s in circle(8))
    return Skeleton(Part(Blob((0.4, 0.4, 0.52)), lift=0.25, blend=0.1, children=arms))


def spider() -> Skeleton:
    abdomen = Part(Blob((0.4, 0.48, 0.36)), "abdomen", (8, 0, 6), (0, 0.62, 0.08))
    leg = limb("leg", [0.5, 0.75], [0.1, 0.09, 0.08], [(12, 5), (14, 6)], knee=(0, -3, 0.5))
    fang = limb("fang", [0.22], [0.09, 0.08], [(15, 10)])
    legs = [
        leg.joined((0.16 * s, y, 0), (s, 4.0 * y, 0.9))
        for s in (-1, 1)
        for y in (-0.27, -0.09, 0.09, 0.27)
    ]
    fangs = [fang.joined((0.1 * s, -0.25, 0), (0.3 * s, -1, -0.4)) for s in (-1, 1)]
    return Skeleton(Part(Blob((0.27, 0.36, 0.22)), children=(abdomen, *legs, *fangs)))


def hand() -> Skeleton:
    radii, bends = [0.115, 0.105, 0.1, 0.095], [(16, 4), (22, 0)]
    fingers = []
    for x, k in ((-0.45, 0.9), (-0.15, 1.1), (0.15, 1.15), (0.45, 0.95)):
        finger = limb("finger", [0.3 * k, 0.24 * k, 0.2 * k], radii, bends, knee=(0, -0.2, 1))
        fingers.append(finger.joined((x, 0, 0.36), (0.5 * x, -0.15, 1)))
    thumb = limb("thumb", [0.34, 0.26], [0.14, 0.12, 0.11], [(20, 12), (20, 0)])
    thumb = thumb.joined((-0.45, 0, -0.2), (-1, -0.3, 0.5))
    wrist = limb("wrist", [0.35], [0.24, 0.22], [(15, 15)]).joined((0, 0, -0.35), DOWN)
    return Skeleton(Part(Box((1.16, 0.32, 0.9), 0.14), children=(*fingers, thumb, wrist)))


def snake() -> Skeleton:
    head = Part(Blob((0.19, 0.13, 0.24)), "head", (15, 15, 0), (0, 0, 0.34), lift=0.12)
    radii = [0.07, 0.1, 0.12, 0.14, 0.15, 0.15, 0.14, 0.12, 0.1]
    return Skeleton(
        limb("body", [0.34] * 8, radii, [(0, 0), (10, 46)], [head]).joined(ORIGIN, (1, 0, 0))
    )


def plier() -> Skeleton:
    arms = []
    for s in (-1, 1):
        grip = Part(Arc(2.3, 0.55, 0.13, 0.11), "grip").joined(ORIGIN, DOWN, roll=-0.5 * np.pi * s)
        arms.append(
            Part(
                Cone(0.62, 0.17, 0.09), "jaw", (0, 9, 0), turn=turned("y", 26 * s), children=(grip,)
            )
        )
    return Skeleton(Part(Blob((0.22, 0.16, 0.22)), children=tuple(arms)))


def mug() -> Skeleton:
    handle = Part(Arc(0.29, np.pi, 0.1, 0.1), "handle", (0, 6, 0), blend=0.05).joined(
        (0.48, 0, 0.26), (1, 0, 0)
    )
    return Skeleton(Part(Shell(((0, 0), (0.48, 0), (0.5, 1.1)), 0.19), children=(handle,)), loops=1)


def glasses() -> Skeleton:
    bends = [(8, 18), (4, 8), (5, 5)]
    temple = limb("temple", [0.55, 0.5, 0.2], [0.1, 0.09, 0.09, 0.09], bends, knee=(0, -0.12, 1))
    rims = []
    for s in (-1, 1):
        side = temple.joined((0.38 * s, 0, 0), (0.1 * s, 1, 0))
        rims.append(Part(Ring(0.36, 0.1), "body", (4, 6, 0), (0.5 * s, 0, 0), children=(side,)))
    return Skeleton(Part(Blob((0.2, 0.1, 0.1)), "bridge", children=tuple(rims)))


def chair() -> Skeleton:
    back = Part(Box((0.9, 0.18, 0.95), 0.07), "back", (14, 4, 4), (0, 0.38, 0), lift=0.45)
    leg = limb("leg", [0.75], [0.1, 0.09], [(8, 8)])
    legs = [
        leg.joined((0.36 * a, 0.36 * b, 0), (0.1 * a, 0.1 * b, -1))
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    return Skeleton(Part(Box((0.95, 0.95, 0.18), 0.07), children=(back, *legs)))


def fish() -> Skeleton:
    fluke = Part(Blob((0.09, 0.15, 0.34)), "fluke", (12, 8, 0), lift=0.22)
    lobes = [fluke.joined((0, 0, 0.28), (0, 0.75 * s, 1)) for s in (-1, 1)]
    tail = limb("tail", [0.34, 0.28], [0.22, 0.15, 0.11], [(8, 22), (8, 25)], lobes).joined(
        (0, 0.45, 0), (0, 1, 0)
    )
    dorsal = Part(Blob((0.09, 0.34, 0.24)), "dorsal", (8, 8, 0), (0, 0, 0.32), lift=0.1)
    fin = Part(Blob((0.16, 0.08, 0.3)), "fin", (20, 20, 0), lift=0.22)
    fins = [fin.joined((0.16 * s, -0.25, -0.14), (s, 0.6, -0.45)) for s in (-1, 1)]
    return Skeleton(Part(Blob((0.23, 0.72, 0.4)), blend=0.05, children=(tail, dorsal, *fins)))


def bird() -> Skeleton:
    beak = limb("beak", [0.25], [0.1, 0.07], [(8, 8)]).joined((0, 0, 0.28), (0, -1, 0.35))
    head = Part(Blob((0.18, 0.19, 0.18)), "head", (15, 15, 0), (0, 0, 0.28))
    neck = limb("neck", [0.28], [0.16, 0.13], [(15, 15)], [head, beak]).joined(
        (0, -0.48, 0.12), (0, -0.9, 0.8)
    )
    outer = Part(Blob((0.24, 0.085, 0.42)), "wing", (25, 10, 0), (0, 0, 0.55), lift=0.32)
    wing = Part(Blob((0.3, 0.1, 0.42)), "wing", (30, 10, 0), lift=0.32, children=(outer,))
    wings = [wing.joined((0.15 * s, 0, 0.08), (s, 0.1, 0.15)) for s in (-1, 1)]
    tail = Part(Blob((0.26, 0.09, 0.36)), "tail", (15, 12, 0), lift=0.26).joined(
        (0, 0.52, 0), (0, 1, 0.1)
    )
    return Skeleton(Part(Blob((0.26, 0.62, 0.26)), children=(neck, tail, *wings)))


_ALL = (biped, quadruped, octopus, spider, hand, snake, plier, mug, glasses, chair, fish, bird)
TEMPLATES: dict[str, Callable[[], Skeleton]] = {build.__name__: build for build in _ALL}

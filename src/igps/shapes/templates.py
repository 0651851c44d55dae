"""The eight classes: skeletons of animals and things, designed by hand."""

from collections.abc import Callable, Mapping

import numpy as np

from igps.shapes.skeleton import DOWN, ORIGIN, Part, Skeleton, circle, limb, turned
from igps.shapes.solids import Arc, Blob, Box, Cone, Shell


def biped() -> Skeleton:
    foot = limb(
        "foot",
        lengths=[0.22],
        radii=[0.11, 0.1],
        bends=[(12, 8)],
    ).joined((0, 0, 0.52), heading=(0, 1, 0.1))
    hand = Part(
        Blob((0.14, 0.11, 0.17)),
        group="hand",
        bend=(15, 15, 0),
        at=(0, 0, 0.42),
        lift=0.08,
    )
    arm = limb(
        "arm",
        lengths=[0.44, 0.42],
        radii=[0.13, 0.11, 0.1],
        bends=[(40, 30), (35, 15)],
        tip=[hand],
        knee=(0, -0.15, 1),
    )
    leg = limb(
        "leg",
        lengths=[0.55, 0.52],
        radii=[0.17, 0.13, 0.11],
        bends=[(28, 8), (25, 0)],
        tip=[foot],
        knee=(0, -0.12, 1),
    )
    neck = limb(
        "neck",
        lengths=[0.2],
        radii=[0.12, 0.11],
        bends=[(5, 5)],
    ).joined((0, 0, 0.8))
    head = Part(
        Blob((0.21, 0.24, 0.27)),
        group="head",
        bend=(20, 15, 0),
        at=(0, 0, 0.85),
        lift=0.3,
    )
    arms = arm.on_both_sides((0.3, 0, 0.72), heading=(1, -0.15, -0.35))
    legs = leg.on_both_sides((0.17, 0, -0.02), heading=(0.2, 0, -1))
    return Skeleton(
        Part(
            Cone(0.75, 0.25, 0.29),
            children=(neck, head, *arms, *legs),
        )
    )


def quadruped() -> Skeleton:
    head = limb(
        "head",
        lengths=[0.32],
        radii=[0.18, 0.12],
        bends=[(20, 15)],
    ).joined((0, 0, 0.42), heading=(0, -1, 0.35))
    ear = limb(
        "ear",
        lengths=[0.2],
        radii=[0.09, 0.08],
        bends=[(10, 10)],
    )
    ears = ear.on_both_sides((0.1, 0, 0.5), heading=(0.5, 0.2, 1))
    neck = limb(
        "neck",
        lengths=[0.42],
        radii=[0.19, 0.15],
        bends=[(18, 15)],
        tip=[head, *ears],
    ).joined((0, -0.55, 0.08), heading=(0, -0.8, 1))
    tail = limb(
        "tail",
        lengths=[0.3, 0.3],
        radii=[0.1, 0.09, 0.08],
        bends=[(20, 25)],
    ).joined((0, 0.62, 0.1), heading=(0, 1, 0.1))
    bones = [0.42, 0.42]
    radii = [0.15, 0.11, 0.1]
    bends = [(22, 6), (22, 0)]
    legs = []
    for s in (-1, 1):
        for group, y in (("fore", -0.48), ("hind", 0.48)):
            leg = limb(
                group,
                lengths=bones,
                radii=radii,
                bends=bends,
                knee=(0, 0.15, 1),
            )
            legs.append(leg.joined((0.18 * s, y, -0.12), heading=(0.12 * s, 0, -1)))
    return Skeleton(
        Part(
            Blob((0.29, 0.75, 0.31)),
            children=(neck, tail, *legs),
        )
    )


def octopus() -> Skeleton:
    bends = [(18, 8), (28, 18), (35, 25)]
    arm = limb(
        "arm",
        lengths=[0.42, 0.4, 0.38],
        radii=[0.16, 0.13, 0.1, 0.08],
        bends=bends,
        knee=(0, 0.12, 1),
    )
    arms = []
    for c, s in circle(8):
        arms.append(arm.joined((0.24 * c, 0.24 * s, 0.0), heading=(c, s, -0.35)))
    return Skeleton(
        Part(
            Blob((0.4, 0.4, 0.52)),
            lift=0.25,
            blend=0.1,
            children=tuple(arms),
        )
    )


def spider() -> Skeleton:
    abdomen = Part(
        Blob((0.4, 0.48, 0.36)),
        group="abdomen",
        bend=(8, 0, 6),
        at=(0, 0.62, 0.08),
    )
    leg = limb(
        "leg",
        lengths=[0.5, 0.75],
        radii=[0.1, 0.09, 0.08],
        bends=[(12, 5), (14, 6)],
        knee=(0, -3, 0.5),
    )
    fang = limb(
        "fang",
        lengths=[0.22],
        radii=[0.09, 0.08],
        bends=[(15, 10)],
    )
    legs = [
        leg.joined((0.16 * s, y, 0), heading=(s, 4.0 * y, 0.9))
        for s in (-1, 1)
        for y in (-0.27, -0.09, 0.09, 0.27)
    ]
    fangs = fang.on_both_sides((0.1, -0.25, 0), heading=(0.3, -1, -0.4))
    return Skeleton(
        Part(
            Blob((0.27, 0.36, 0.22)),
            children=(abdomen, *legs, *fangs),
        )
    )


def hand() -> Skeleton:
    radii = [0.115, 0.105, 0.1, 0.095]
    bends = [(16, 4), (22, 0)]
    fingers = []
    for x, k in ((-0.45, 0.9), (-0.15, 1.1), (0.15, 1.15), (0.45, 0.95)):
        finger = limb(
            "finger",
            lengths=[0.3 * k, 0.24 * k, 0.2 * k],
            radii=radii,
            bends=bends,
            knee=(0, -0.2, 1),
        )
        fingers.append(finger.joined((x, 0, 0.36), heading=(0.5 * x, -0.15, 1)))
    thumb = limb(
        "thumb",
        lengths=[0.34, 0.26],
        radii=[0.14, 0.12, 0.11],
        bends=[(20, 12), (20, 0)],
    )
    thumb = thumb.joined((-0.45, 0, -0.2), heading=(-1, -0.3, 0.5))
    wrist = limb(
        "wrist",
        lengths=[0.35],
        radii=[0.24, 0.22],
        bends=[(15, 15)],
    ).joined((0, 0, -0.35), heading=DOWN)
    return Skeleton(
        Part(
            Box((1.16, 0.32, 0.9), 0.14),
            children=(*fingers, thumb, wrist),
        )
    )


def snake() -> Skeleton:
    head = Part(
        Blob((0.19, 0.13, 0.24)),
        group="head",
        bend=(15, 15, 0),
        at=(0, 0, 0.34),
        lift=0.12,
    )
    radii = [0.07, 0.1, 0.12, 0.14, 0.15, 0.15, 0.14, 0.12, 0.1]
    return Skeleton(
        limb(
            "body",
            lengths=[0.34] * 8,
            radii=radii,
            bends=[(0, 0), (10, 46)],
            tip=[head],
        ).joined(ORIGIN, heading=(1, 0, 0))
    )


def plier() -> Skeleton:
    arms = []
    for s in (-1, 1):
        grip = Part(
            Arc(2.3, 0.55, 0.13, 0.11),
            group="grip",
        ).joined(ORIGIN, heading=DOWN, roll=-0.5 * np.pi * s)
        arms.append(
            Part(
                Cone(0.62, 0.17, 0.09),
                group="jaw",
                bend=(0, 9, 0),
                turn=turned("y", 26 * s),
                children=(grip,),
            )
        )
    return Skeleton(
        Part(
            Blob((0.22, 0.16, 0.22)),
            children=tuple(arms),
        )
    )


def mug() -> Skeleton:
    handle = Part(
        Arc(0.29, np.pi, 0.1, 0.1),
        group="handle",
        bend=(0, 6, 0),
        blend=0.05,
    ).joined((0.48, 0, 0.26), heading=(1, 0, 0))
    return Skeleton(
        Part(
            Shell(((0, 0), (0.48, 0), (0.5, 1.1)), 0.19),
            children=(handle,),
        ),
        loops=1,
    )


Template = Callable[[], Skeleton]
"""Makes the skeleton of a class."""

_ALL = (biped, quadruped, octopus, spider, hand, snake, plier, mug)
TEMPLATES: Mapping[str, Template] = {build.__name__: build for build in _ALL}

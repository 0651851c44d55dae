"""The eight classes of `igps.ArticulatedShapes` and four more, designed by hand."""

from collections.abc import Mapping

from igps.shapes import templates
from igps.shapes.skeleton import Part, Skeleton, limb
from igps.shapes.solids import Blob, Box
from igps.shapes.templates import Template
from training.shapes.ring import Ring


def glasses() -> Skeleton:
    bends = [(8, 18), (4, 8), (5, 5)]
    temple = limb(
        "temple",
        lengths=[0.55, 0.5, 0.2],
        radii=[0.1, 0.09, 0.09, 0.09],
        bends=bends,
        knee=(0, -0.12, 1),
    )
    rims = []
    for s in (-1, 1):
        side = temple.joined((0.38 * s, 0, 0), heading=(0.1 * s, 1, 0))
        rims.append(
            Part(
                Ring(0.36, 0.1),
                group="body",
                bend=(4, 6, 0),
                at=(0.5 * s, 0, 0),
                children=(side,),
            )
        )
    return Skeleton(
        Part(
            Blob((0.2, 0.1, 0.1)),
            group="bridge",
            children=tuple(rims),
        )
    )


def chair() -> Skeleton:
    back = Part(
        Box((0.9, 0.18, 0.95), 0.07),
        group="back",
        bend=(14, 4, 4),
        at=(0, 0.38, 0),
        lift=0.45,
    )
    leg = limb(
        "leg",
        lengths=[0.75],
        radii=[0.1, 0.09],
        bends=[(8, 8)],
    )
    legs = [
        leg.joined((0.36 * a, 0.36 * b, 0), heading=(0.1 * a, 0.1 * b, -1))
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    return Skeleton(
        Part(
            Box((0.95, 0.95, 0.18), 0.07),
            children=(back, *legs),
        )
    )


def fish() -> Skeleton:
    fluke = Part(
        Blob((0.09, 0.15, 0.34)),
        group="fluke",
        bend=(12, 8, 0),
        lift=0.22,
    )
    lobes = [fluke.joined((0, 0, 0.28), heading=(0, 0.75 * s, 1)) for s in (-1, 1)]
    tail = limb(
        "tail",
        lengths=[0.34, 0.28],
        radii=[0.22, 0.15, 0.11],
        bends=[(8, 22), (8, 25)],
        tip=lobes,
    ).joined((0, 0.45, 0), heading=(0, 1, 0))
    dorsal = Part(
        Blob((0.09, 0.34, 0.24)),
        group="dorsal",
        bend=(8, 8, 0),
        at=(0, 0, 0.32),
        lift=0.1,
    )
    fin = Part(
        Blob((0.16, 0.08, 0.3)),
        group="fin",
        bend=(20, 20, 0),
        lift=0.22,
    )
    fins = [fin.joined((0.16 * s, -0.25, -0.14), heading=(s, 0.6, -0.45)) for s in (-1, 1)]
    return Skeleton(
        Part(
            Blob((0.23, 0.72, 0.4)),
            blend=0.05,
            children=(tail, dorsal, *fins),
        )
    )


def bird() -> Skeleton:
    beak = limb(
        "beak",
        lengths=[0.25],
        radii=[0.1, 0.07],
        bends=[(8, 8)],
    ).joined((0, 0, 0.28), heading=(0, -1, 0.35))
    head = Part(
        Blob((0.18, 0.19, 0.18)),
        group="head",
        bend=(15, 15, 0),
        at=(0, 0, 0.28),
    )
    neck = limb(
        "neck",
        lengths=[0.28],
        radii=[0.16, 0.13],
        bends=[(15, 15)],
        tip=[head, beak],
    ).joined((0, -0.48, 0.12), heading=(0, -0.9, 0.8))
    outer = Part(
        Blob((0.24, 0.085, 0.42)),
        group="wing",
        bend=(25, 10, 0),
        at=(0, 0, 0.55),
        lift=0.32,
    )
    wing = Part(
        Blob((0.3, 0.1, 0.42)),
        group="wing",
        bend=(30, 10, 0),
        lift=0.32,
        children=(outer,),
    )
    wings = [wing.joined((0.15 * s, 0, 0.08), heading=(s, 0.1, 0.15)) for s in (-1, 1)]
    tail = Part(
        Blob((0.26, 0.09, 0.36)),
        group="tail",
        bend=(15, 12, 0),
        lift=0.26,
    ).joined((0, 0.52, 0), heading=(0, 1, 0.1))
    return Skeleton(
        Part(
            Blob((0.26, 0.62, 0.26)),
            children=(neck, tail, *wings),
        )
    )


_MORE = (glasses, chair, fish, bird)
TEMPLATES: Mapping[str, Template] = {
    **templates.TEMPLATES,
    **{build.__name__: build for build in _MORE},
}

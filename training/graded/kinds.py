"""The classes of the graded shapes: kinds of bodies, how they move, and which resemble the classes of SHREC'07.

A class is a kind and some of its builder's structural choices. Its bodies draw the other choices and all proportions,
so that two bodies of a class differ as two chairs do, and two poses of a body as a cat does from itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from igps.shapes.skeleton import Skeleton
from igps.shapes.templates import TEMPLATES
from training.graded.grammar import FAMILIES
from training.graded.plates import MACHINES, SHEETS, coil, machine, sheet

Motion = Literal["limbs", "hinges", "sheet", "rigid"]

LOOK_ALIKE_TEMPLATES = {
    "biped": "human, teddy, armadillo",
    "quadruped": "four legs",
    "octopus": "octopus",
    "spider": "ant",
    "hand": "hand",
    "snake": "none closely",
    "plier": "plier",
    "mug": "cup",
    "glasses": "glasses",
    "chair": "chair",
    "fish": "fish",
    "bird": "bird, airplane",
}
"""The named templates, and the classes of SHREC'07 that each resembles."""

LOOK_ALIKE_FAMILIES = {
    "star": "octopus",
    "beast": "four legs, ant, fish",
    "vessel": "cup, vase",
    "table": "table, chair",
    "tongs": "plier",
    "machine": "mechanical part, bearing",
    "coil": "spring",
}
"""The families some of whose classes resemble classes of SHREC'07, and which."""


class Kind(NamedTuple):
    """A way to build bodies.

    build: of a random generator and a structure.
    structures: all that can be built.
    loose: positions of the choices in a structure that are a body's own and not its class's.
    motion: how the bodies of a structure move.
    """

    build: Callable[..., Skeleton]
    structures: Sequence[tuple[Any, ...]]
    loose: tuple[int, ...]
    motion: Callable[[tuple[Any, ...]], Motion]


class BodyClass(NamedTuple):
    """A class: its name, kind, and the structures that its bodies may have."""

    name: str
    kind: Kind
    structures: Sequence[tuple[Any, ...]]

    def draw(self, g: np.random.Generator) -> tuple[Skeleton, Motion]:
        """The skeleton of a body, and how it moves."""
        structure = self.structures[int(g.integers(len(self.structures)))]
        return self.kind.build(g, *structure), self.kind.motion(structure)


def body_classes(seed: int, look_alikes: bool = True) -> list[BodyClass]:
    """All classes in order: the named templates, then the kinds in turn, each in an order of its own.

    Args:
        seed: of those orders.
        look_alikes: with the templates and families that resemble classes of SHREC'07, or with others in their place.
    """
    found: list[BodyClass] = []
    if look_alikes:
        found += [BodyClass(name, _template(name), [()]) for name in TEMPLATES]
    queues = []
    for place, (name, kind) in enumerate(KINDS.items()):
        if not look_alikes and name in LOOK_ALIKE_FAMILIES:
            continue
        groups: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
        for structure in kind.structures:
            groups.setdefault(tuple(c for i, c in enumerate(structure) if i not in kind.loose), []).append(structure)
        order = np.random.default_rng([seed, place]).permutation(len(groups))
        keys = list(groups)
        queues.append([(name, kind, keys[i], groups[keys[i]]) for i in order])
    for turn in itertools.zip_longest(*queues):
        for name, kind, key, structures in (one for one in turn if one is not None):
            words = [str(word) for choice in key for word in (choice if isinstance(choice, tuple) else (choice,))]
            found.append(BodyClass("-".join([name, *words, f"{len(found):03d}"]), kind, structures))
    return found


def _template(name: str) -> Kind:
    motions: dict[str, Motion] = {"plier": "hinges", "mug": "rigid", "chair": "rigid"}
    return Kind(lambda _: TEMPLATES[name](), [()], (), lambda _: motions.get(name, "limbs"))


def _of(family: str, loose: tuple[int, ...], motion: Motion | Callable[[tuple[Any, ...]], Motion]) -> Kind:
    build, structures = FAMILIES[family]
    return Kind(build, structures, loose, motion if callable(motion) else lambda _: motion)


def _tool(structure: tuple[Any, ...]) -> Motion:
    return "limbs" if structure[0] in ("jointed", "tentacle") else "rigid"


def _comb(structure: tuple[Any, ...]) -> Motion:
    return "rigid" if structure[1] == "ladder" else "limbs"


KINDS: dict[str, Kind] = {
    "star": _of("star", (0,), "limbs"),
    "tree": _of("tree", (3,), "limbs"),
    "beast": _of("beast", (3,), "limbs"),
    "chain": _of("chain", (0,), "limbs"),
    "vessel": _of("vessel", (2,), "rigid"),
    "wheel": _of("wheel", (3,), "limbs"),
    "table": _of("table", (0,), "rigid"),
    "tool": _of("tool", (2,), _tool),
    "tongs": _of("tongs", (1,), "hinges"),
    "stack": _of("stack", (1,), "rigid"),
    "comb": _of("comb", (0,), _comb),
    "serpent": _of("serpent", (0,), "limbs"),
    "sheet": Kind(sheet, list(itertools.product(SHEETS, (0, 1, 2, 4))), (), lambda _: "sheet"),
    "machine": Kind(
        machine,
        list(itertools.product(MACHINES, ("plain", "collar", "shaft", "ear", "pins"), (2, 3, 4))),
        (2,),
        lambda _: "rigid",
    ),
    "coil": Kind(coil, list(itertools.product((1.5, 2.5, 3.5, 4.5), ("plain", "knob", "disc"))), (), lambda _: "limbs"),
}
"""The kinds of bodies by name."""

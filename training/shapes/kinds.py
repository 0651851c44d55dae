"""The classes of the graded shapes: kinds of bodies, their motion, and their resemblance to classes of SHREC'07.

A class is a kind with fixed structural choices, except at most one that each body draws for itself, together with all
proportions. Two bodies of a class differ like two chairs, and two poses of a body like two postures of a cat.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from igps.shapes.skeleton import Skeleton
from training.shapes.artefacts import stack, table, tongs, tool, vessel, wheel
from training.shapes.creatures import beast, chain, comb, serpent, star, tree
from training.shapes.plates import MACHINES, SHEETS, machine, sheet
from training.shapes.springs import coil
from training.shapes.templates import TEMPLATES

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
"""Classes of SHREC'07 that each named template resembles."""

LOOK_ALIKE_FAMILIES = {
    "star": "octopus",
    "beast": "four legs, ant, fish",
    "vessel": "cup, vase",
    "table": "table, chair",
    "tongs": "plier",
    "machine": "mechanical part, bearing",
    "coil": "spring",
}
"""Classes of SHREC'07 that some classes of each family resemble."""


class Kind(NamedTuple):
    """A family of classes with the same builder."""

    # Builder, called with a random generator and the choices of a structure
    build: Callable[..., Skeleton]
    structures: Sequence[tuple[Any, ...]]  # valid combinations of structural choices
    loose: int | None  # position of the choice that varies within a class; None if there is none
    motion: Callable[[tuple[Any, ...]], Motion]  # motion of the bodies of a structure


class BodyClass(NamedTuple):
    """A class: its name, its kind, and the possible structures of its bodies."""

    name: str
    kind: Kind
    structures: Sequence[tuple[Any, ...]]

    def draw(self, g: np.random.Generator) -> tuple[Skeleton, Motion]:
        """Draw the skeleton of a body, and return it with its motion."""
        structure = self.structures[int(g.integers(len(self.structures)))]
        return self.kind.build(g, *structure), self.kind.motion(structure)


def body_classes(seed: int, look_alikes: bool = True) -> list[BodyClass]:
    """Return all classes: the named templates, then one class of each kind in turn, in a random order within a kind.

    Args:
        seed: seed of the order.
        look_alikes: whether to include the templates and families that resemble classes of SHREC'07.
    """
    classes: list[BodyClass] = []
    if look_alikes:
        classes += [BodyClass(name, _template(name), [()]) for name in TEMPLATES]
    queues = []
    for number, (name, kind) in enumerate(KINDS.items()):
        if not look_alikes and name in LOOK_ALIKE_FAMILIES:
            continue
        groups: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
        for structure in kind.structures:
            fixed = tuple(choice for i, choice in enumerate(structure) if i != kind.loose)
            groups.setdefault(fixed, []).append(structure)
        keys = list(groups)
        order = np.random.default_rng([seed, number]).permutation(len(keys))
        queues.append([(name, kind, keys[i], groups[keys[i]]) for i in order])
    for turn in itertools.zip_longest(*queues):
        for name, kind, fixed, structures in filter(None, turn):
            words = [name]
            for choice in fixed:
                words += map(str, choice) if isinstance(choice, tuple) else [str(choice)]
            words.append(f"{len(classes):03d}")
            classes.append(BodyClass("-".join(words), kind, structures))
    return classes


def _template(name: str) -> Kind:
    motions: dict[str, Motion] = {"plier": "hinges", "mug": "rigid", "chair": "rigid"}
    motion = motions.get(name, "limbs")
    return Kind(lambda _: TEMPLATES[name](), [()], None, lambda _: motion)


def _kind(
    build: Callable[..., Skeleton],
    *choices: Sequence[Any],
    loose: int | None = None,
    motion: Motion | Callable[[tuple[Any, ...]], Motion] = "limbs",
    where: Callable[..., bool] = lambda *_: True,
) -> Kind:
    """Make a kind of all combinations of choices that meet `where`; `loose` is the position of the loose choice."""
    structures = [structure for structure in itertools.product(*choices) if where(*structure)]
    return Kind(build, structures, loose, motion if callable(motion) else lambda _: motion)


def _tool(structure: tuple[Any, ...]) -> Motion:
    return "limbs" if structure[0] in ("jointed", "tentacle") else "rigid"


def _comb(structure: tuple[Any, ...]) -> Motion:
    return "rigid" if structure[1] == "ladder" else "limbs"


_LAYERS = ("ball", "block", "plate", "post", "hoop")
_ALL = (
    _kind(
        star,
        ("orb", "disc", "hoop", "drum", "prism"),
        (3, 4, 5, 6, 7),
        ("straight", "jointed", "bent", "tentacle"),
        ("plain", "knob", "ring", "paddle", "fork", "hook"),
        loose=0,
    ),
    _kind(
        tree,
        (2, 3, 4, 5),
        (0, 2, 3),
        ("plain", "knob", "ring", "cup", "disc"),
        ("bare", "plate", "bulb", "tripod"),
        where=lambda branches, twigs, end, _: branches * twigs <= (9 if end == "plain" else 6),
        loose=3,
    ),
    _kind(
        beast,
        (1, 2, 3, 4),
        ("stand", "sprawl", "fins"),
        ("round", "horned", "bill", "looped", "long"),
        ("bare", "whip", "fluke", "loop", "club"),
        loose=3,
    ),
    _kind(
        chain,
        (3, 4, 5, 6, 7),
        ("beads", "boxes", "plates", "tubes", "shrinking", "rings", "crossed"),
        ("plain", "fork", "hook", "ring", "hammer"),
        loose=0,
    ),
    _kind(
        vessel,
        ("cup", "bowl", "vase", "bottle", "pipe"),
        (0, 1, 2, 3),
        ("flat", "legs", "stem"),
        ("smooth", "spout", "knobs"),
        where=lambda body, _handles, foot, _extra: not (body == "pipe" and foot == "stem"),
        loose=2,
        motion="rigid",
    ),
    _kind(
        wheel,
        (3, 4, 5, 6),
        (0, 2, 3, 6),
        ("none", "rays", "legs", "mast"),
        ("plain", "knob", "fork"),
        where=lambda n, spokes, limbs, end: spokes <= n and (limbs != "none" or end == "plain"),
        loose=3,
    ),
    _kind(
        table,
        ("round", "square", "long", "triangle", "hoop"),
        (1, 3, 4, 6),
        ("open", "panel", "arch", "post", "horns"),
        loose=0,
        motion="rigid",
    ),
    _kind(
        tool,
        ("straight", "bent", "jointed", "tentacle"),
        ("hammer", "fork", "ring", "paddle", "cup", "hook", "disc", "claw"),
        ("plain", "knob", "ring", "hammer", "fork"),
        loose=2,
        motion=_tool,
    ),
    _kind(
        tongs,
        ("plain", "hook", "paddle", "ring", "knob", "hammer", "fork"),
        ("plain", "ring", "knob", "bow", "paddle"),
        (2, 3),
        loose=1,
        motion="hinges",
    ),
    _kind(
        stack,
        [*itertools.permutations(_LAYERS, 3), *itertools.permutations(_LAYERS, 4)],
        ("bare", "arms", "pegs", "hoops"),
        loose=1,
        motion="rigid",
    ),
    _kind(
        comb,
        (3, 4, 5),
        ("one", "both", "zigzag", "ladder"),
        ("plain", "knob", "ring", "paddle", "disc", "hook"),
        loose=0,
        motion=_comb,
    ),
    _kind(
        serpent,
        (3, 4, 5, 6, 7),
        ("sail", "fins", "bulge", "collar"),
        ("plain", "knob", "fork", "ring", "paddle", "claw"),
        loose=0,
    ),
    _kind(sheet, SHEETS, (0, 1, 2, 4), motion="sheet"),
    _kind(
        machine,
        MACHINES,
        ("plain", "collar", "shaft", "ear", "pins"),
        (2, 3, 4),
        loose=2,
        motion="rigid",
    ),
    _kind(coil, (1.5, 2.5, 3.5, 4.5), ("plain", "knob", "disc")),
)
KINDS = {kind.build.__name__: kind for kind in _ALL}
"""The kinds of bodies by the name of their builder."""

"""Classes of articulated shapes beyond the named templates: one structure after another of the grammar's families.

The grammar's classes are tried out when they are made, since drawn proportions may let limbs touch.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from igps.shapes import ArticulatedShapes
from igps.shapes.meshing import defect, mesh
from igps.shapes.skeleton import Skeleton, pose
from igps.shapes.templates import TEMPLATES
from training.graded.artefacts import stack, table, tongs, tool, vessel, wheel
from training.graded.creatures import beast, chain, comb, serpent, star, tree

_MAX_DRAWS = 20
_CLASS, _FAMILY, _TRIAL = 2, 3, 4  # what a random stream is for, beside those of `ArticulatedShapes`
_TRIAL_VERTICES = 3000  # the same whatever resolution is asked for: a class does not depend on it
_LAYERS = ("ball", "block", "plate", "post", "hoop")

_log = logging.getLogger(__name__)


class Family(NamedTuple):
    """A way to build skeletons, and its structures: two classes of a family differ in a choice."""

    build: Callable[..., Skeleton]
    structures: list[tuple[Any, ...]]


def _family(
    build: Callable[..., Skeleton], *choices: Sequence[Any], where: Callable[..., bool] = lambda *_: True
) -> Family:
    """The family of all combinations of structural choices that can be built."""
    return Family(build, [structure for structure in itertools.product(*choices) if where(*structure)])


_ALL = (
    _family(
        star,
        ("orb", "disc", "hoop", "drum", "prism"),
        (3, 4, 5, 6, 7),
        ("straight", "jointed", "bent", "tentacle"),
        ("plain", "knob", "ring", "paddle", "fork", "hook"),
    ),
    _family(
        tree,
        (2, 3, 4, 5),
        (0, 2, 3),
        ("plain", "knob", "ring", "cup", "disc"),
        ("bare", "plate", "bulb", "tripod"),
        where=lambda branches, twigs, end, _: branches * twigs <= (9 if end == "plain" else 6),
    ),
    _family(
        beast,
        (1, 2, 3, 4),
        ("stand", "sprawl", "fins"),
        ("round", "horned", "bill", "looped", "long"),
        ("bare", "whip", "fluke", "loop", "club"),
    ),
    _family(
        chain,
        (3, 4, 5, 6, 7),
        ("beads", "boxes", "plates", "tubes", "shrinking", "rings", "crossed"),
        ("plain", "fork", "hook", "ring", "hammer"),
    ),
    _family(
        vessel,
        ("cup", "bowl", "vase", "bottle", "pipe"),
        (0, 1, 2, 3),
        ("flat", "legs", "stem"),
        ("smooth", "spout", "knobs"),
        where=lambda body, _handles, foot, _extra: not (body == "pipe" and foot == "stem"),
    ),
    _family(
        wheel,
        (3, 4, 5, 6),
        (0, 2, 3, 6),
        ("none", "rays", "legs", "mast"),
        ("plain", "knob", "fork"),
        where=lambda n, spokes, limbs, end: spokes <= n and (limbs != "none" or end == "plain"),
    ),
    _family(
        table, ("round", "square", "long", "triangle", "hoop"), (1, 3, 4, 6), ("open", "panel", "arch", "post", "horns")
    ),
    _family(
        tool,
        ("straight", "bent", "jointed", "tentacle"),
        ("hammer", "fork", "ring", "paddle", "cup", "hook", "disc", "claw"),
        ("plain", "knob", "ring", "hammer", "fork"),
    ),
    _family(
        tongs,
        ("plain", "hook", "paddle", "ring", "knob", "hammer", "fork"),
        ("plain", "ring", "knob", "bow", "paddle"),
        (2, 3),
    ),
    _family(
        stack,
        [*itertools.permutations(_LAYERS, 3), *itertools.permutations(_LAYERS, 4)],
        ("bare", "arms", "pegs", "hoops"),
    ),
    _family(comb, (3, 4, 5), ("one", "both", "zigzag", "ladder"), ("plain", "knob", "ring", "paddle", "disc", "hook")),
    _family(
        serpent,
        (3, 4, 5, 6, 7),
        ("sail", "fins", "bulge", "collar"),
        ("plain", "knob", "fork", "ring", "paddle", "claw"),
    ),
)
FAMILIES = {family.build.__name__: family for family in _ALL}


class GrammarShapes(ArticulatedShapes):
    """`ArticulatedShapes` with further classes, which are drawn from the grammar."""

    most_classes = None

    def _class_name(self, index: int) -> str:
        return super()._class_name(index) if index < len(TEMPLATES) else _structure(self.seed, index)[0]

    def _skeleton(self, index: int) -> Skeleton:
        return super()._skeleton(index) if index < len(TEMPLATES) else _sound_skeleton(self.seed, index)


def _sound_skeleton(seed: int, index: int) -> Skeleton:
    """The structure of a class in the first proportions that pass a trial pose.

    Raises:
        ValueError: no proportions did.
    """
    name, build, structure = _structure(seed, index)
    found: str | None = None
    for draw in range(_MAX_DRAWS):
        skeleton = build(np.random.default_rng([seed, _CLASS, index, draw]), *structure)
        body = pose(skeleton, np.random.default_rng([seed, _TRIAL, index, draw]), 1.0, np.eye(3))
        vertices, faces, _ = mesh(body, _TRIAL_VERTICES)
        found = defect(vertices, faces, skeleton.genus, _TRIAL_VERTICES)
        if found is None:
            return skeleton
        _log.debug("%s: draw %d: %s", name, draw + 1, found)
    raise ValueError(
        f"seed={seed}: no sound class {name} in {_MAX_DRAWS} draws, the last had {found}; try another seed"
    )


def _structure(seed: int, index: int) -> tuple[str, Callable[..., Skeleton], tuple[Any, ...]]:
    """Name, builder and structure of a class of the grammar."""
    turn, place = divmod(index - len(TEMPLATES), len(FAMILIES))
    family, (build, structures) = list(FAMILIES.items())[place]
    # One walk through the shuffled structures keeps classes of a family apart, however many are asked for.
    order = np.random.default_rng([seed, _FAMILY, place]).permutation(len(structures))
    structure = structures[order[turn % len(structures)]]
    words = [str(word) for choice in structure for word in (choice if isinstance(choice, tuple) else (choice,))]
    return "-".join([family, *words, f"{index:03d}"]), build, structure

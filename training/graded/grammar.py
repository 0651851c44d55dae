"""The grammar: families of skeletons, each a builder and the structures that it can build."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from igps.shapes.skeleton import Skeleton
from training.graded.artefacts import stack, table, tongs, tool, vessel, wheel
from training.graded.creatures import beast, chain, comb, serpent, star, tree

_LAYERS = ("ball", "block", "plate", "post", "hoop")


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

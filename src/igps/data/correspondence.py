"""Places of two bodies that correspond to each other by what their files say, such as residues of one chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igps._arrays import Floats, Integers
from igps.mesh.formats import field_packages
from igps.mesh.loading import BodyRef


@dataclass(frozen=True, eq=False)
class Places:
    """The R places of a body, and the A points that belong to them, in coordinates of its file."""

    names: tuple[str, ...]  # (R,) such as "A 12 LEU"
    positions: Floats  # (R, 3)
    points: Floats  # (A, 3) such as atoms
    place_of: Integers  # (A,) index of the place of each point
    suffix: str  # of the file that `save` writes
    # Writes the body to a file with a value for each place, after a rotation (3, 3) and a shift (3,)
    save: Callable[[Path, Floats, Floats, Floats], None]


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Places of two bodies, and M pairs of them."""

    kind: str  # what the places are, in the plural
    places: tuple[Places, Places]
    pairs: Integers  # (M, 2) indices of corresponding places in both bodies


def correspondence(one: BodyRef, other: BodyRef) -> Correspondence | None:
    """Return the places of two bodies that correspond, if a field knows them; None otherwise."""
    for package in field_packages():
        find = getattr(package, "CORRESPONDENCE", None)
        found = None if find is None else find(one, other)
        if found is not None:
            return found
    return None

"""A molecule: balls and residues."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers

BETWEEN_CHAINS = 1000.0
"""Difference of the places of residues of two chains at least: more than that of any pair that is compared."""

_SPAN = 3.8  # Å, between the Cα atoms of neighbours; n residues span n times as much at most
# Å; the latter for nucleotides, and if the numbers say that two residues are neighbours
_BOND = 4.3
_LONG_BOND = 8.0
_MAX_GAP = 300  # residues; a larger jump of the numbers is another way of numbering


@dataclass(frozen=True, eq=False)
class Molecule:
    """A body of A balls, which are atoms or stand for missing ones, and R residues."""

    name: str  # file name, with the model, chain or assembly
    positions: Floats  # (A, 3) Å
    radii: Floats  # (A,) van der Waals radii, Å
    charges: Floats  # (A,) elementary charges
    residue_of: Integers  # (A,) index of the residue of each ball
    residue_names: tuple[
        str, ...
    ]  # codes of three letters; a modified amino acid has the code of its parent
    residue_positions: (
        Floats  # (R, 3) Å, positions of Cα, or of a residue without Cα the mean of its atoms
    )
    b_factors: (
        Floats  # (R,) means over atoms: B-factors, Å², or pLDDT of predicted models; NaN if unknown
    )
    notes: tuple[str, ...] = ()  # remarks on how the structure was read
    # (R,) places along the chain: neighbours differ by 1, the ends of a gap by more, chains by `BETWEEN_CHAINS`;
    # NaN for a residue of no polymer
    places: Floats = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not len(self.places):
            object.__setattr__(self, "places", np.arange(len(self.residue_names), dtype=float))

    def __repr__(self) -> str:
        return (
            f"Molecule({self.name!r}, {len(self.residue_names)} residues, {len(self.radii)} balls)"
        )


def chain_places(positions: Floats, numbers: Floats, chains: NDArray[np.str_]) -> Floats:
    """Return the places (R,) of residues along their chains, in the order of the file.

    Residues that are bound to each other differ by 1, whatever their numbers are. At a gap, the numbers tell how many
    residues are missing; if they tell too few to span the distance, or more than 300, then the distance does.

    Args:
        positions: (R, 3) Å.
        numbers: (R,) in the file; NaN for a residue of no polymer.
        chains: (R,) names.
    """
    places = np.full(len(numbers), np.nan)
    linked = np.flatnonzero(np.isfinite(numbers))
    if not len(linked):
        return places
    distance = np.linalg.norm(np.diff(positions[linked], axis=0), axis=1)
    told = np.diff(numbers[linked])
    fewest = np.maximum(np.ceil(distance / _SPAN), 1)
    is_bound = (distance <= _BOND) | ((told == 1) & (distance <= _LONG_BOND))
    is_told = (told >= fewest) & (told <= _MAX_GAP)
    steps = np.where(is_bound, 1, np.where(is_told, told, fewest))
    names = chains[linked]
    steps[names[1:] != names[:-1]] = BETWEEN_CHAINS
    places[linked] = np.cumsum(np.r_[0.0, steps])
    return places

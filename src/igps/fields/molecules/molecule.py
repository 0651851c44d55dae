"""A molecule: balls and residues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Floats, Integers

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
    # Codes of three letters; a modified amino acid has the code of its parent
    residue_names: tuple[str, ...]
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
    residue_labels: tuple[str, ...] = ()  # (R,) chain and number in the file, as "A 12"

    def __post_init__(self) -> None:
        n_residues = len(self.residue_names)
        if not len(self.places):
            object.__setattr__(self, "places", np.arange(n_residues, dtype=float))
        if not self.residue_labels:
            labels = tuple(str(number + 1) for number in range(n_residues))
            object.__setattr__(self, "residue_labels", labels)

    def subset(self, is_kept: Booleans, note: str) -> Molecule:
        """Return the molecule of some of its residues, (R,), with a note of why."""
        balls = is_kept[self.residue_of]
        of_all = [f"of {len(is_kept)} residues: {text}" for text in self.notes]
        new_index = np.cumsum(is_kept) - 1
        return replace(
            self,
            positions=self.positions[balls],
            radii=self.radii[balls],
            charges=self.charges[balls],
            residue_of=new_index[self.residue_of[balls]],
            residue_names=tuple(compress(self.residue_names, is_kept)),
            residue_positions=self.residue_positions[is_kept],
            b_factors=self.b_factors[is_kept],
            places=self.places[is_kept],
            residue_labels=tuple(compress(self.residue_labels, is_kept)),
            notes=(*of_all, note),
        )

    def __repr__(self) -> str:
        return (
            f"Molecule({self.name!r}, {len(self.residue_names)} residues, {len(self.radii)} balls)"
        )


def joined(molecules: Sequence[Molecule]) -> Molecule:
    """Return one molecule of several, such as the models of a file."""
    if len(molecules) == 1:
        return molecules[0]
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(molecule, name) for molecule in molecules])
        for name in ("positions", "radii", "charges", "residue_positions", "b_factors")
    }
    residues = []
    places = []
    n_residues = 0
    last_place = 0.0
    for molecule in molecules:
        residues.append(molecule.residue_of + n_residues)
        places.append(molecule.places + last_place)
        n_residues += len(molecule.residue_names)
        last_place += np.nanmax(molecule.places, initial=0.0) + BETWEEN_CHAINS
    return replace(
        molecules[0],
        residue_of=np.concatenate(residues),
        places=np.concatenate(places),
        residue_names=tuple(chain.from_iterable(each.residue_names for each in molecules)),
        residue_labels=tuple(chain.from_iterable(each.residue_labels for each in molecules)),
        **arrays,
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

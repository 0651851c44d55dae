"""A molecule: balls and residues."""

from dataclasses import dataclass

from igps._arrays import Floats, Integers


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

    def __repr__(self) -> str:
        return (
            f"Molecule({self.name!r}, {len(self.residue_names)} residues, {len(self.radii)} balls)"
        )

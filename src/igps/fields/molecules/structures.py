"""Molecules of structure files, as balls of atoms; a body is a chain, a model or an assembly."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from igps._arrays import Floats
from igps._parameters import check_one_of
from igps.fields.molecules._gemmi import (
    SUFFIXES,
    gemmi_module,
    parts_of,
    read_structures,
    suffix_of,
)
from igps.fields.molecules.molecule import Molecule, chain_places
from igps.fields.molecules.residues import (
    BACKBONE,
    CHARGED_ATOMS,
    PHOSPHATES,
    STANDARD,
    WATER,
    missing_share,
    residue_ball,
    side_chain_ball,
)
from igps.mesh.errors import MeshError

if TYPE_CHECKING:
    import gemmi

logger = logging.getLogger(__name__)

MoleculeBodies = Literal["chains", "models", "assembly"]

# By the first letter of an atom's name, if the file states no element
_INFERRED_ELEMENTS = frozenset("HCNOSP")
# Elements of residues with standard names; selenium is that of selenomethionine.
_STANDARD_ELEMENTS = frozenset({*_INFERRED_ELEMENTS, "D", "Se"})
_UNKNOWN_RADIUS = 1.7  # Å, of atoms of unknown elements: that of carbon

_NOTES = {
    "alternative": "{} alternative locations: the one of the highest occupancy was used",
    "nowhere": "{} atoms without a position were left out",
    "named": "{} atoms without an element: it was inferred from their names",
    "element": f"{{}} atoms of an unknown element: a radius of {_UNKNOWN_RADIUS} Å was used",
    "residue": "{} residues of an unknown name",
    "stranger": "{} residues of an unknown name that are no amino acids, such as lipids or detergents: "
    "they are part of the body; delete them from the file if they should not be",
    "side chain": "{} residues were completed: balls stand for missing atoms of side chains",
    "alpha": "{} residues of Cα alone: a ball of the residue's volume was used",
    "repeated": "{} residues repeat a number: all were kept",
    "ligand": "{} ligands were left out",
}


def is_structure(path: str | Path) -> bool:
    """Return whether a file has a suffix of PDB, mmCIF, BinaryCIF or PQR, gzipped or not."""
    return suffix_of(Path(path)) in SUFFIXES


def read_molecule(
    path: str | Path,
    bodies: MoleculeBodies = "chains",
    *,
    ligands: bool = False,
) -> list[Molecule]:
    """Read the bodies of a structure file: PDB, mmCIF, BinaryCIF or PQR, gzipped or not.

    Each model of an ensemble, and each data block of mmCIF with atoms, yields separate bodies. Water and hydrogens are
    left out. The alternative location with the highest occupancy is used, the first one of a tie. Radii are van der
    Waals radii of the elements (Bondi 1964), and charges those of residues at pH 7, without the ends of chains. Radii,
    charges and hydrogens of a PQR file are used as they are.

    Backbones and Cα traces can be read, too (volumes of Zamyatnin 1972): for atoms that a side chain lacks, a ball with
    their share of its volume and their charge touches the last atom that is there, in the direction of the side chain.
    A residue of Cα alone becomes a ball of its volume.

    Example:
        >>> import tempfile
        >>> line = "HETATM    1 ZN    ZN A   1      11.104   6.134  -6.504  1.00 20.00          ZN\\n"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/zinc.pdb").write_text(line)
        ...     (zinc,) = read_molecule(f"{folder}/zinc.pdb", ligands=True)
        >>> zinc.residue_names, zinc.radii.round(2).tolist()
        (('ZN',), [1.39])

    Args:
        bodies: "chains", "models", or "assembly" for the first biological assembly of the file, made from each model.
            Bodies without usable atoms are left out with a warning in the log.
        ligands: keep residues that belong to no polymer. They are always kept if the file has no polymers.

    Raises:
        ValueError: unknown `bodies`.
        MeshError: the file is missing, cut short, unreadable, or holds no molecule.
        ImportError: gemmi is not installed.
    """
    path = Path(path)
    check_one_of(get_args(MoleculeBodies), bodies=bodies)
    parts = list(parts_of(read_structures(path), bodies, path))
    is_pqr = suffix_of(path) == ".pqr"
    molecules, left_out = _molecules(parts, ligands, is_pqr)
    if not molecules and not ligands:
        molecules, left_out = _molecules(parts, True, is_pqr)
    if not molecules:
        fault = f"{path}: no atoms of a molecule with positions, in {len(parts)} {bodies}."
        raise MeshError(f"{fault} Check that the file is complete, and not of water alone.")
    for name in left_out:
        logger.warning(
            "%s: no atoms of a polymer, left out. Read it with ligands=True, or check the file.",
            name,
        )
    return molecules


def _molecules(
    parts: list[tuple[str, list[gemmi.Chain], list[str]]],
    ligands: bool,
    is_pqr: bool,
) -> tuple[list[Molecule], list[str]]:
    """Build the molecules of parts; return also the names of parts without usable atoms."""
    molecules = []
    left_out = []
    for name, chains, notes in parts:
        builder = _Builder(ligands, is_pqr)
        for chain in chains:
            builder.add_chain(chain)
        if any(radius > 0 for _, radius, _, _ in builder.balls):
            molecules.append(builder.molecule(name, notes))
        else:
            left_out.append(name)
    return molecules, left_out


class _Builder:
    def __init__(self, ligands: bool, is_pqr: bool) -> None:
        self.ligands = ligands
        self.is_pqr = is_pqr
        self.balls: list[tuple[Floats, float, float, int]] = []  # position, radius, charge, residue
        # Name, position, B-factor, number (NaN outside polymers), chain and label
        self._residues: list[tuple[str, Floats, float, float, str, str]] = []
        self._count: Counter[str] = Counter()

    def molecule(self, name: str, notes: list[str]) -> Molecule:
        remarks = list(notes)
        if self.is_pqr:
            remarks.append("radii and charges are those of the PQR file")
        for key, text in _NOTES.items():
            if self._count[key]:
                remarks.append(text.format(self._count[key]))
        positions, radii, charges, residue_of = map(np.array, zip(*self.balls, strict=True))
        names, centres, b_factors, numbers, chains, labels = zip(*self._residues, strict=True)
        places = chain_places(np.array(centres), np.array(numbers), np.array(chains))
        return Molecule(
            name,
            positions,
            radii,
            charges,
            residue_of,
            names,
            np.array(centres),
            np.array(b_factors),
            tuple(remarks),
            places,
            labels,
        )

    def add_chain(self, chain: gemmi.Chain) -> None:
        seen: set[str] = set()
        for residue in self._conformers(chain):
            if residue.is_water() or residue.name in WATER:
                continue
            atoms = self._atoms(residue)
            if self._add_residue(residue, atoms, chain.name):
                number = str(residue.seqid)
                self._count["repeated"] += number in seen
                seen.add(number)

    def _add_residue(self, residue: gemmi.Residue, atoms: list[gemmi.Atom], chain: str) -> bool:
        """Add the balls of a residue, unless it is a ligand to be left out; return whether it was added."""
        gemmi = gemmi_module()
        kind = gemmi.find_tabulated_residue(residue.name)
        name = _standard(residue.name, kind)
        named = {atom.name for atom in atoms}
        is_known = name != residue.name or (kind.is_amino_acid() or kind.is_nucleic_acid())
        # A single atom is an ion of an unknown name, unless it is Cα or P; the ion of calcium has the name of Cα
        is_ion = len(atoms) == 1 and (not named & {"CA", "P"} or atoms[0].element.name == "Ca")
        is_linked = residue.het_flag == "A" or residue.entity_type == gemmi.EntityType.Polymer
        in_polymer = is_known or {"N", "CA", "C"} <= named or (is_linked and not is_ion)
        if not atoms or not (in_polymer or self.ligands):
            self._count["ligand"] += bool(atoms)
            return False
        if in_polymer and not is_known:
            is_amino_acid = {"N", "CA", "C"} <= named
            self._count["residue" if is_amino_acid else "stranger"] += 1
        positions = np.array([atom.pos.tolist() for atom in atoms])
        alpha = (
            next((i for i, atom in enumerate(atoms) if atom.name == "CA"), None)
            if in_polymer
            else None
        )
        b_factor = np.nan if self.is_pqr else float(np.mean([atom.b_iso for atom in atoms]))
        position = positions.mean(axis=0) if alpha is None else positions[alpha]
        number = np.nan
        if in_polymer and residue.seqid.num is not None:
            number = float(residue.seqid.num)
        label = f"{chain} {residue.seqid}".strip()
        self._residues.append((name, position, b_factor, number, chain, label))
        charged: dict[str, float] = {}
        if in_polymer:
            own_or_parent = CHARGED_ATOMS.get(residue.name, CHARGED_ATOMS.get(name, {}))
            charged = PHOSPHATES if kind.is_nucleic_acid() else own_or_parent
        if alpha is not None and not self.is_pqr:
            lacking = sum(charged.values()) - sum(charged.get(atom, 0.0) for atom in named)
            if named == {"CA"}:
                self._count["alpha"] += 1
                self._add_ball(positions[alpha], residue_ball(name), lacking)
                return True
            self._complete(name, atoms, positions, lacking)
        for atom, position in zip(atoms, positions, strict=True):
            if self.is_pqr:
                self._add_ball(position, atom.b_iso, atom.occ)
            else:
                self._add_ball(position, self._radius(atom), charged.get(atom.name, 0.0))
        return True

    def _radius(self, atom: gemmi.Atom) -> float:
        """Return the van der Waals radius of the atom's element, inferred from its name if need be."""
        if atom.element.atomic_number:
            return float(atom.element.vdw_r)
        letter = _first_letter(atom)
        if letter in _INFERRED_ELEMENTS:
            self._count["named"] += 1
            return float(gemmi_module().Element(letter).vdw_r)
        self._count["element"] += 1
        return _UNKNOWN_RADIUS

    def _add_ball(self, position: Floats, radius: float, charge: float) -> None:
        self.balls.append((position, radius, charge, len(self._residues) - 1))

    def _complete(
        self, name: str, atoms: list[gemmi.Atom], positions: Floats, charge: float
    ) -> None:
        """Add a ball with the charge and the share of the volume of the atoms that a side chain lacks, if any."""
        heavy = [i for i, atom in enumerate(atoms) if not _is_hydrogen(atom)]
        side = [i for i in heavy if atoms[i].name not in BACKBONE]
        share = missing_share(name, len(side))
        if not share:
            return
        self._count["side chain"] += 1
        position_of = {atoms[i].name: positions[i] for i in heavy}
        alpha = position_of["CA"]
        end = alpha
        direction = np.zeros(3)
        if side:
            distances = np.linalg.norm(positions[side] - alpha, axis=1)
            end = positions[side[int(distances.argmax())]]
            direction = end - alpha
        elif {"N", "C"} <= position_of.keys():
            # The direction of Cβ in ideal tetrahedral geometry
            b = alpha - position_of["N"]
            c = position_of["C"] - alpha
            direction = -0.58273431 * np.cross(b, c) + 0.56802827 * b - 0.54067466 * c
        length = max(float(np.linalg.norm(direction)), 1e-9)
        radius = side_chain_ball(name, share)
        self._add_ball(end + radius / length * direction, radius, charge)

    def _conformers(self, chain: gemmi.Chain) -> Iterator[gemmi.Residue]:
        """Yield the residues; of alternative ones in the same place only the one of the highest occupancy."""

        def key(numbered: tuple[int, gemmi.Residue]) -> str | int:
            number, residue = numbered
            is_alternative = len(residue) > 0 and all(atom.has_altloc() for atom in residue)
            return str(residue.seqid) if is_alternative else number

        for _, group in groupby(enumerate(chain), key):
            residues = [residue for _, residue in group]
            self._count["alternative"] += len(residues) - 1
            yield max(
                residues, key=lambda residue: max((atom.occ for atom in residue), default=0.0)
            )

    def _atoms(self, residue: gemmi.Residue) -> list[gemmi.Atom]:
        """Return the atoms that have a position, each at its alternative location of the highest occupancy."""
        chosen: dict[Any, Any] = {}
        gemmi = gemmi_module()
        is_standard = (
            residue.name in STANDARD or gemmi.find_tabulated_residue(residue.name).is_standard()
        )
        for number, atom in enumerate(residue):
            # If names begin in the wrong column, gemmi takes Cα for calcium
            if is_standard and atom.element.name not in _STANDARD_ELEMENTS:
                atom.element = gemmi.Element("X")
            if not self.is_pqr and _is_hydrogen(atom):
                continue
            if not math.isfinite(atom.pos.length()):
                self._count["nowhere"] += 1
                continue
            # Programs that complete side chains may leave an atom twice, without a letter
            key = atom.name if is_standard or atom.has_altloc() else number
            self._count["alternative"] += key in chosen
            if key not in chosen or atom.occ > chosen[key].occ:
                chosen[key] = atom
        return list(chosen.values())


def _is_hydrogen(atom: gemmi.Atom) -> bool:
    is_unnamed = not atom.element.atomic_number
    return bool(atom.is_hydrogen() or (is_unnamed and _first_letter(atom) == "H"))


def _first_letter(atom: gemmi.Atom) -> str:
    """Return the first letter of an atom's name, which digits may precede."""
    return str(atom.name).lstrip("0123456789'\"*").upper()[:1]


def _standard(name: str, kind: gemmi.ResidueInfo) -> str:
    """Return the name of the parent of a modified amino acid; other names are returned unchanged."""
    if name in STANDARD:
        return STANDARD[name]
    if kind.is_standard() or not kind.is_amino_acid():
        return name
    gemmi = gemmi_module()
    return gemmi.expand_one_letter(kind.one_letter_code.upper(), gemmi.ResidueKind.AA) or name

"""Molecules: the balls of atoms that a structure file holds, by chain, by model or by assembly."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from igps._arrays import Floats, Integers
from igps._parameters import check_one_of
from igps.mesh.formats._format import Format, RawBody, made_later, stamp_of
from igps.mesh.formats._structures import SUFFIXES, gemmi_module, parts_of, read_structures, suffix
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.mesh.residues import BACKBONE, CHARGED_ATOMS, PHOSPHATES, STANDARD, WATER, residue_ball, side_chain_ball

if TYPE_CHECKING:
    import gemmi

logger = logging.getLogger(__name__)

MoleculeBodies = Literal["chains", "models", "assembly"]

# Elements that the first letter of an atom's name gives where the file does not.
_ELEMENTS = frozenset("HCNOSP")
# The elements of residues with standard names, with the selenium of a methionine; and deuterium.
_OF_STANDARD = frozenset({*_ELEMENTS, "D", "Se"})
# Radius of an atom whose element is not known, carbon's.
_UNKNOWN_RADIUS = 1.7

_NOTES = {
    "alternative": "{} alternative locations: that of the highest occupancy was taken",
    "nowhere": "{} atoms without a position were left out",
    "named": "{} atoms without an element: their names tell it",
    "element": f"{{}} atoms of an unknown element: a radius of {_UNKNOWN_RADIUS} Å was taken",
    "residue": "{} residues of an unknown name",
    "side chain": "{} residues without side chain: balls of the side chain's volume stand for them",
    "alpha": "{} residues of Cα alone: balls of the residue's volume stand for them",
    "repeated": "{} residues repeat a number: all were kept",
    "ligand": "{} ligands were left out",
}


@dataclass(frozen=True, eq=False)
class Molecule:
    """The A balls of a body, and its R residues."""

    name: str  # of the file, with the model, chain or assembly
    positions: Floats  # (A, 3) Å
    radii: Floats  # (A,) van der Waals radii, Å
    charges: Floats  # (A,) elementary charges
    residue_of: Integers  # (A,) the residue of each ball, from 0
    residue_names: tuple[str, ...]  # three letters; a modified amino acid has the name of the one that it was
    residue_positions: Floats  # (R, 3) of the Cα atoms, or else the mean of a residue's atoms, Å
    b_factors: Floats  # (R,) means of the residue's atoms: B-factors, Å², or a model's pLDDT; NaN if the file has none
    notes: tuple[str, ...] = ()  # what was done to the structure, in words

    def __repr__(self) -> str:
        return f"Molecule({self.name!r}, {len(self.residue_names)} residues, {len(self.radii)} balls)"


def is_structure(path: str | Path) -> bool:
    """Whether a file has a suffix of PDB, mmCIF or PQR, with ".gz" behind it or without."""
    return suffix(Path(path)) in SUFFIXES


def read_molecule(
    path: str | Path, bodies: MoleculeBodies = "chains", *, ligands: bool = False, hydrogens: bool = False
) -> list[Molecule]:
    """Read the bodies of a structure file: PDB, mmCIF or PQR, gzipped or not.

    Each model of an ensemble, and each block of data of mmCIF that has atoms, gives bodies of its own. Water is left
    out. Of alternative locations that of the highest occupancy is taken, the first of equals. Radii are van der Waals
    radii of the elements (Bondi 1964), and charges those of residues at pH 7, without the ends of chains. A PQR file
    has its own of both, and keeps its hydrogens. Where all atoms of a side chain are missing, a ball of its volume
    touches Cα on the side of Cβ; a residue of Cα alone is a ball of its whole volume (Zamyatnin 1972). So backbones and
    traces are bodies, too.

    Example:
        >>> import tempfile
        >>> line = "HETATM    1 ZN    ZN A   1      11.104   6.134  -6.504  1.00 20.00          ZN\\n"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/zinc.pdb").write_text(line)
        ...     (zinc,) = read_molecule(f"{folder}/zinc.pdb", ligands=True)
        >>> zinc.residue_names, zinc.radii.round(2).tolist()
        (('ZN',), [1.39])

    Args:
        bodies: "chains" or "models", each by itself, or of every model the first biological "assembly" that the file
            names. Those without usable atoms are left out, which is logged.
        ligands: keep what belongs to no polymer, as is done in a file without polymers.
        hydrogens: keep hydrogens, which most structures lack.

    Raises:
        ValueError: unknown `bodies`.
        MeshError: the file is missing, cut short, unreadable, or holds no molecule.
        ImportError: gemmi is not installed.
    """
    path = Path(path)
    check_one_of(get_args(MoleculeBodies), bodies=bodies)
    parts = list(parts_of(read_structures(path), bodies, path))
    found, left_out = _molecules(parts, ligands, hydrogens, suffix(path) == ".pqr")
    if not found and not ligands:
        found, left_out = _molecules(parts, True, hydrogens, suffix(path) == ".pqr")
    if not found:
        none = f"{path}: no atoms of a molecule that have positions, in {len(parts)} {bodies}."
        raise MeshError(f"{none} Check that the file is complete, and not of water alone.")
    for name in left_out:
        logger.warning("%s: no atoms of a polymer, left out; read its ligands, or check the file.", name)
    return found


@lru_cache(maxsize=1)
def molecules_by_part(path: Path, changed: tuple[int, int, int], bodies: MoleculeBodies) -> dict[str, Molecule]:
    """The bodies of a structure file by their parts; read once while `changed`, its `stamp_of`, is the same."""
    found = read_molecule(path, bodies)
    return {molecule.name.removeprefix(str(path)).lstrip("#") or "model": molecule for molecule in found}


def _molecules(
    parts: list[tuple[str, list[gemmi.Chain], list[str]]], ligands: bool, hydrogens: bool, is_pqr: bool
) -> tuple[list[Molecule], list[str]]:
    """The molecules of the parts, and the names of parts without one."""
    found, left_out = [], []
    for name, chains, notes in parts:
        one = _Builder(ligands, hydrogens or is_pqr, is_pqr)
        for chain in chains:
            one.add_chain(chain)
        if any(radius > 0 for _, radius, _, _ in one.balls):
            found.append(one.molecule(name, notes))
        else:
            left_out.append(name)
    return found, left_out


class _Builder:
    """Collects the balls and residues of one molecule."""

    def __init__(self, ligands: bool, hydrogens: bool, is_pqr: bool) -> None:
        self.ligands, self.hydrogens, self.is_pqr = ligands, hydrogens, is_pqr
        self.balls: list[tuple[Floats, float, float, int]] = []  # position, radius, charge, residue
        self._residues: list[tuple[str, Floats, float]] = []  # name, position, B-factor
        self._count: Counter[str] = Counter()

    def molecule(self, name: str, notes: list[str]) -> Molecule:
        own = ["radii and charges are those of the PQR file"] if self.is_pqr else []
        counted = [text.format(self._count[what]) for what, text in _NOTES.items() if self._count[what]]
        positions, radii, charges, residue_of = map(np.array, zip(*self.balls, strict=True))
        names, places, b_factors = zip(*self._residues, strict=True)
        return Molecule(
            name, positions, radii, charges, residue_of, names, np.array(places), np.array(b_factors),
            (*notes, *own, *counted),
        )  # fmt: skip

    def add_chain(self, chain: gemmi.Chain) -> None:
        seen: set[str] = set()
        for residue in self._conformers(chain):
            if residue.is_water() or residue.name in WATER:
                continue
            atoms = self._atoms(residue)
            if self._add_residue(residue, atoms):
                place = str(residue.seqid)
                self._count["repeated"] += place in seen
                seen.add(place)

    def _add_residue(self, residue: gemmi.Residue, atoms: list[gemmi.Atom]) -> bool:
        """Whether the residue belongs to the molecule."""
        gemmi = gemmi_module()
        kind = gemmi.find_tabulated_residue(residue.name)
        name = _standard(residue.name, kind)
        named = {atom.name for atom in atoms}
        is_known = name != residue.name or (kind.is_amino_acid() or kind.is_nucleic_acid())
        # An ion of an unknown name is a single atom, which is no polymer; the name of calcium is that of Cα.
        is_alone = len(atoms) == 1 and (not named & {"CA", "P"} or atoms[0].element.name == "Ca")
        is_linked = residue.het_flag == "A" or residue.entity_type == gemmi.EntityType.Polymer
        in_polymer = is_known or {"N", "CA", "C"} <= named or (is_linked and not is_alone)
        if not atoms or not (in_polymer or self.ligands):
            self._count["ligand"] += bool(atoms)
            return False
        self._count["residue"] += in_polymer and not is_known
        at = np.array([atom.pos.tolist() for atom in atoms])
        alpha = next((i for i, atom in enumerate(atoms) if atom.name == "CA"), None) if in_polymer else None
        b_factor = np.nan if self.is_pqr else float(np.mean([atom.b_iso for atom in atoms]))
        self._residues.append((name, at.mean(axis=0) if alpha is None else at[alpha], b_factor))
        charged = (PHOSPHATES if kind.is_nucleic_acid() else CHARGED_ATOMS.get(name, {})) if in_polymer else {}
        if alpha is not None and not self.is_pqr and (named == {"CA"} or (named <= BACKBONE and name != "GLY")):
            self._add_coarse_ball(name, atoms, at, sum(charged.values()))
            if named == {"CA"}:
                return True
        for atom, position in zip(atoms, at, strict=True):
            if self.is_pqr:
                self._add_ball(position, atom.b_iso, atom.occ)
            else:
                self._add_ball(position, self._radius(atom), charged.get(atom.name, 0.0))
        return True

    def _radius(self, atom: gemmi.Atom) -> float:
        """The van der Waals radius of the atom's element, which its name tells if need be."""
        if atom.element.atomic_number:
            return float(atom.element.vdw_r)
        if (letter := _letter(atom)) in _ELEMENTS:
            self._count["named"] += 1
            return float(gemmi_module().Element(letter).vdw_r)
        self._count["element"] += 1
        return _UNKNOWN_RADIUS

    def _add_ball(self, position: Floats, radius: float, charge: float) -> None:
        self.balls.append((position, radius, charge, len(self._residues) - 1))

    def _add_coarse_ball(self, name: str, atoms: list[gemmi.Atom], at: Floats, charge: float) -> None:
        """The ball for a missing side chain, or for a residue of Cα alone."""
        place = {atom.name: position for atom, position in zip(atoms, at, strict=True)}
        if len(place) == 1:
            self._count["alpha"] += 1
            self._add_ball(place["CA"], residue_ball(name), charge)
            return
        self._count["side chain"] += 1
        radius, centre = side_chain_ball(name), place["CA"]
        if {"N", "C"} <= place.keys():
            # Tetrahedral geometry has Cβ in this direction.
            b, c = centre - place["N"], place["C"] - centre
            direction = -0.58273431 * np.cross(b, c) + 0.56802827 * b - 0.54067466 * c
            centre = centre + radius * direction / max(float(np.linalg.norm(direction)), 1e-9)
        self._add_ball(centre, radius, charge)

    def _conformers(self, chain: gemmi.Chain) -> Iterator[gemmi.Residue]:
        """The residues; of alternatives the one of highest occupancy."""

        def place(numbered: tuple[int, gemmi.Residue]) -> str | int:
            number, residue = numbered
            is_alternative = len(residue) > 0 and all(atom.has_altloc() for atom in residue)
            return str(residue.seqid) if is_alternative else number

        for _, group in groupby(enumerate(chain), place):
            residues = [residue for _, residue in group]
            self._count["alternative"] += len(residues) - 1
            yield max(residues, key=lambda residue: max((atom.occ for atom in residue), default=0.0))

    def _atoms(self, residue: gemmi.Residue) -> list[gemmi.Atom]:
        """Those that have a position, one of each that has alternatives."""
        chosen: dict[Any, Any] = {}
        gemmi = gemmi_module()
        is_standard = residue.name in STANDARD or gemmi.find_tabulated_residue(residue.name).is_standard()
        for number, atom in enumerate(residue):
            # Where names begin in the wrong column, gemmi takes Cα for calcium
            if is_standard and atom.element.name not in _OF_STANDARD:
                atom.element = gemmi.Element("X")
            if not self.hydrogens and (atom.is_hydrogen() or (not atom.element.atomic_number and _letter(atom) == "H")):
                continue
            if not np.isfinite(atom.pos.tolist()).all():
                self._count["nowhere"] += 1
                continue
            key = atom.name if atom.has_altloc() else number
            self._count["alternative"] += key in chosen
            if key not in chosen or atom.occ > chosen[key].occ:
                chosen[key] = atom
        return list(chosen.values())


def _letter(atom: gemmi.Atom) -> str:
    """The first letter of an atom's name, which may have digits before it."""
    return str(atom.name).lstrip("0123456789'\"*").upper()[:1]


def _standard(name: str, kind: gemmi.ResidueInfo) -> str:
    """The name of the amino acid that a modified one was; of others their own."""
    if name in STANDARD:
        return STANDARD[name]
    if kind.is_standard() or not kind.is_amino_acid():
        return name
    gemmi = gemmi_module()
    return gemmi.expand_one_letter(kind.one_letter_code.upper(), gemmi.ResidueKind.AA) or name


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surfaces of the chains, models or the assembly of a structure file, in ångström."""
    from igps.mesh.molecular_surface import molecular_surface

    how: MoleculeBodies = options.bodies if options.bodies in ("chains", "assembly") else "models"
    found = molecules_by_part(path, stamp_of(path), how)
    names = [name for name in found if part in (None, name)]
    return [made_later(partial(molecular_surface, found[name]), name, "Å") for name in names]


_SUFFIXES = tuple(sorted(one + packed for one in SUFFIXES for packed in ("", ".gz")))
FORMAT = Format("a structure", _SUFFIXES, read, ("chains", "models", "assembly"), extra="molecules")

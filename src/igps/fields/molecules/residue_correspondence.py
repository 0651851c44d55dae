"""Residues of two molecules that correspond by their sequences; structures with a value for each residue."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Integers
from igps.data.correspondence import Correspondence, Places
from igps.fields.molecules._gemmi import gemmi_module
from igps.fields.molecules.bodies import molecule_of, structure_of
from igps.fields.molecules.molecule import Molecule
from igps.fields.molecules.structures import is_structure
from igps.mesh.loading import BodyRef

# Two chains of one fold by chance share 8 to 12 % of their residues after alignment (Rost 1999)
_MIN_IDENTITY = 0.4
_MAX_CELLS = 2 * 10**8  # of the table of an alignment, which takes a byte for each


def residue_correspondence(one: BodyRef, other: BodyRef) -> Correspondence | None:
    """Return the residues of two molecules, and the pairs of those that correspond by their sequences.

    None if one is no molecule, if less than 40 % of the shorter sequence is the same, or if both are too long.
    """
    if not (is_structure(one.path) and is_structure(other.path)):
        return None
    first = molecule_of(one)
    second = molecule_of(other)
    names = first.residue_names
    other_names = second.residue_names
    if len(names) * len(other_names) > _MAX_CELLS:
        return None
    pairs = aligned(names, other_names)
    n_same = sum(names[i] == other_names[j] for i, j in pairs)
    n_shorter = min(len(names), len(other_names))
    if n_same < max(3, _MIN_IDENTITY * n_shorter):
        return None
    return Correspondence("residues", (_places(one, first), _places(other, second)), pairs)


def aligned(one: tuple[str, ...], other: tuple[str, ...]) -> Integers:
    """Return pairs (M, 2) of indices of two sequences that a global alignment joins (Needleman and Wunsch 1970)."""
    if one == other:
        return np.repeat(np.arange(len(one))[:, None], 2, axis=1)
    steps = gemmi_module().align_string_sequences(list(one), list(other), []).cigar_str()
    pairs = [np.empty((0, 2), dtype=np.int64)]
    place = np.zeros(2, dtype=np.int64)
    for count, kind in re.findall(r"(\d+)([MID])", steps):
        n = int(count)
        if kind == "M":
            pairs.append(place + np.arange(n)[:, None])
        advance = {"M": [1, 1], "I": [1, 0], "D": [0, 1]}[kind]
        place = place + n * np.array(advance)
    return np.concatenate(pairs)


def _places(body: BodyRef, molecule: Molecule) -> Places:
    residues = zip(molecule.residue_labels, molecule.residue_names, strict=True)
    return Places(
        tuple(f"{label} {name}" for label, name in residues),
        molecule.residue_positions,
        molecule.positions,
        molecule.residue_of,
        ".cif",
        partial(save_structure, body, molecule),
    )


def save_structure(
    body: BodyRef,
    molecule: Molecule,
    path: Path,
    values: Floats,
    rotation: Floats,
    shift: Floats,
) -> None:
    """Write the structure of a body as mmCIF, moved, with a value (R,) for each residue in place of the B-factor.

    Atoms outside the residues of the molecule, such as water, have the value 0.
    """
    gemmi = gemmi_module()
    values_of: dict[str, list[float]] = {}
    for label, value in zip(molecule.residue_labels, values.tolist(), strict=True):
        values_of.setdefault(label, []).append(value)
    motion = gemmi.Transform(gemmi.Mat33(rotation.tolist()), gemmi.Vec3(*shift))
    structure = structure_of(body)
    for model in structure:
        for chain in model:
            for residue in chain:
                left = values_of.get(f"{chain.name} {residue.seqid}".strip(), [0.0])
                value = left.pop(0) if len(left) > 1 else left[0]  # labels repeat in models
                for atom in residue:
                    atom.b_iso = value
                    atom.pos = gemmi.Position(motion.apply(atom.pos))
    structure.setup_entities()
    structure.make_mmcif_document().write_file(str(path))

"""Bodies of structure files: chains, models, assemblies, and ranges of residues."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from igps.fields.molecules._gemmi import SUFFIXES, gemmi_module, parts_of, read_structures
from igps.fields.molecules.molecular_surface import molecular_surface
from igps.fields.molecules.molecule import Molecule, joined
from igps.fields.molecules.structures import MoleculeBodies, read_molecule
from igps.mesh.errors import MeshError
from igps.mesh.formats import Format, stat_key
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, deferred

if TYPE_CHECKING:
    import gemmi


_RANGES = re.compile(r"-?\d+--?\d+(?:,-?\d+--?\d+)*")
_PLDDT = re.compile(r"plddt(\d+(?:\.\d+)?)")
_RANGE = re.compile(r"(-?\d+)-(-?\d+)")
_NUMBER = re.compile(r"(-?\d+)\D*$")  # of a residue, at the end of its label


@lru_cache(maxsize=2)
def molecules_by_part(
    path: Path, changed: tuple[int, int, int], bodies: MoleculeBodies
) -> dict[str, Molecule]:
    """Return the bodies of a structure file by part; `changed`, its `stat_key`, is part of the cache key."""
    return {_part(molecule.name, path): molecule for molecule in read_molecule(path, bodies)}


def _part(name: str, path: Path) -> str:
    return name.removeprefix(str(path)).lstrip("#") or "model"


def _kind_of(part: str) -> MoleculeBodies:
    """Return the kind of body that a part names."""
    words = part.partition(":")[0].split()  # of several structures, the first is the name of one
    if "assembly" in words:
        return "assembly"
    return "models" if part == "" or "model" in words[-2:] else "chains"


def chosen(molecules: Mapping[str, Molecule], part: str) -> Molecule | None:
    """Return the molecule of a part, or some of its residues, as "A:10-120,150-160:plddt70"; None if there is none.

    Raises:
        MeshError: the molecule has no such residues.
    """
    found = molecules.get(part, molecules.get(f"chain {part}"))
    base, colon, selection = part.rpartition(":")
    if found is not None or not colon:
        return found
    whole = chosen(molecules, base)
    if whole is None:
        return None
    if match := _PLDDT.fullmatch(selection):
        return _confident(whole, float(match[1]))
    return _in_ranges(whole, selection) if _RANGES.fullmatch(selection) else None


def _in_ranges(molecule: Molecule, ranges: str) -> Molecule:
    """Return the residues in ranges of numbers, such as "10-120,150-160"."""
    numbers = np.array([_residue_number(label) for label in molecule.residue_labels])
    is_chosen = np.zeros(len(numbers), dtype=bool)
    for first, last in _RANGE.findall(ranges):
        is_chosen |= (numbers >= int(first)) & (numbers <= int(last))
    if not is_chosen.any():
        raise MeshError(
            f"{molecule.name}: no residue is in {ranges}; their numbers are {numbers.min()} to "
            f"{numbers.max()}. Choose among them."
        )
    return molecule.subset(
        is_chosen, f"residues {ranges} alone: {is_chosen.sum()} of {len(numbers)}"
    )


def _confident(molecule: Molecule, least: float) -> Molecule:
    """Return the residues of a predicted molecule whose pLDDT, in place of the B-factor, is at least `least`."""
    scores = molecule.b_factors
    if not np.isfinite(scores).all() or scores.min() < 0 or scores.max() > 100:
        raise MeshError(
            f"{molecule.name}: expected a pLDDT of 0 to 100 for each residue, got B-factors of "
            f"{scores.min():g} to {scores.max():g}. Leave out min_plddt for structures that were not predicted."
        )
    is_kept = scores >= least
    if not is_kept.any():
        raise MeshError(
            f"{molecule.name}: no residue has a pLDDT of {least:g}; the largest is {scores.max():g}. Lower it."
        )
    n_left_out = int(np.count_nonzero(~is_kept))
    return molecule.subset(
        is_kept, f"{n_left_out} of {len(scores)} residues have a pLDDT below {least:g}: left out"
    )


def _residue_number(label: str) -> int:
    match = _NUMBER.search(label)
    assert match is not None
    return int(match[1])


def molecule_of(body: BodyRef) -> Molecule:
    """Return the atoms and residues of a body: of a chain, an assembly or a model, or of all models."""
    part = body.part or ""
    stamp = stat_key(body.path)
    for kind in dict.fromkeys((_kind_of(part), "models")):
        molecules = molecules_by_part(body.path, stamp, kind)
        found = chosen(molecules, part)
        if found is not None:
            return found
    return joined(list(molecules.values()))


def structure_of(body: BodyRef) -> gemmi.Structure:
    """Return the chains of a body as a structure; each model of a body of all models is a model."""
    gemmi = gemmi_module()
    part = body.part or ""
    structures = read_structures(body.path)
    parts = {}
    for name, chains, _ in parts_of(structures, _kind_of(part), body.path):
        parts[_part(name, body.path)] = chains
    base, _, _ = part.partition(":")
    names = [name for name in (base, f"chain {base}") if name in parts] or list(parts)
    structure = gemmi.Structure()
    for number, name in enumerate(names, 1):
        model = gemmi.Model(number)
        for chain in parts[name]:
            model.add_chain(chain)
        structure.add_model(model)
    return structure


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Return the surfaces of the chains, models or assemblies of a structure file, in ångström."""
    bodies: MoleculeBodies = (
        options.bodies if options.bodies in ("chains", "assembly") else "models"
    )
    molecules = molecules_by_part(path, stat_key(path), bodies)
    parts = list(molecules)
    if part is not None:
        parts = [] if chosen(molecules, part) is None else [part]
    elif options.first_model:
        first = _model_of(parts[0])
        parts = [name for name in parts if _model_of(name) == first]
    if part is None and options.min_plddt is not None:
        parts = [f"{name}:plddt{options.min_plddt:g}" for name in parts]
    if options.bodies == "whole" and parts != list(molecules):
        raise MeshError(
            f"{path}: expected chains or models as bodies with first_model or min_plddt, got the whole file. "
            "Choose by bodies, on the command line --bodies."
        )
    return [deferred(partial(_surface, molecules, name), name, "Å") for name in parts]


def _model_of(part: str) -> str:
    """Return the part of a name that tells the model."""
    return part.partition("chain ")[0].partition("assembly ")[0].strip()


def _surface(molecules: Mapping[str, Molecule], part: str) -> Mesh:
    """Return the surface of a part; raise a MeshError if all its atoms are in one place."""
    molecule = chosen(molecules, part)
    assert molecule is not None
    places = molecule.positions
    if len(places) > 1 and not np.ptp(places, axis=0).any():
        raise MeshError(
            f"{molecule.name}: all its atoms are in one place, {places[0].tolist()}. "
            "Export the structure again, with its coordinates."
        )
    surface = molecular_surface(molecule)
    if len(places) == 1:
        return surface.annotated(notes=("a single atom: its surface is a ball",))
    return surface


_SUFFIXES = tuple(sorted(suffix + ending for suffix in SUFFIXES for ending in ("", ".gz")))
FORMAT = Format("a structure", _SUFFIXES, read, ("chains", "models", "assembly"), extra="molecules")

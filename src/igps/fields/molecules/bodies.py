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


_RANGES = re.compile(r"(.*):(-?\d+--?\d+(?:,-?\d+--?\d+)*)")
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
    """Return the molecule of a part, or of ranges of its residues, as "A:10-120,150-160"; None if there is none.

    Raises:
        MeshError: the molecule has no residue in the ranges.
    """
    if part in molecules:
        return molecules[part]
    match = _RANGES.fullmatch(part)
    base = part if match is None else match[1]
    found = molecules.get(base, molecules.get(f"chain {base}"))
    if found is None or match is None:
        return found
    numbers = np.array([_residue_number(label) for label in found.residue_labels])
    is_chosen = np.zeros(len(numbers), dtype=bool)
    for first, last in _RANGE.findall(match[2]):
        is_chosen |= (numbers >= int(first)) & (numbers <= int(last))
    if not is_chosen.any():
        raise MeshError(
            f"{found.name}: no residue is in {match[2]}; their numbers are {numbers.min()} to "
            f"{numbers.max()}. Choose among them."
        )
    return found.subset(
        is_chosen, f"residues {match[2]} alone: {is_chosen.sum()} of {len(numbers)}"
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
    parts = {
        _part(name, body.path): chains
        for name, chains, _ in parts_of(
            read_structures(body.path), _kind_of(body.part or ""), body.path
        )
    }
    base = (body.part or "").partition(":")[0]
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
    if part is not None:
        found = chosen(molecules, part)
        molecules = {} if found is None else {part: found}
    return [deferred(partial(_surface, each), name, "Å") for name, each in molecules.items()]


def _surface(molecule: Molecule) -> Mesh:
    """Return the surface of a molecule; raise a MeshError if all its atoms are in one place."""
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


_SUFFIXES = tuple(
    sorted(suffix + ending for suffix in (*SUFFIXES, ".bcif") for ending in ("", ".gz"))
)
FORMAT = Format("a structure", _SUFFIXES, read, ("chains", "models", "assembly"), extra="molecules")

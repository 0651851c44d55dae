"""Bodies of structure files: chains, models, assemblies, and ranges of residues."""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from igps.fields.molecules._gemmi import SUFFIXES, gemmi_module, parts_of, read_structures
from igps.fields.molecules.molecular_surface import molecular_surface
from igps.fields.molecules.molecule import Molecule, joined
from igps.fields.molecules.structures import MoleculeBodies, read_molecule
from igps.mesh.formats import Format, stat_key
from igps.mesh.loading import BodyRef
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, deferred

if TYPE_CHECKING:
    import gemmi


@lru_cache(maxsize=1)
def molecules_by_part(
    path: Path, changed: tuple[int, int, int], bodies: MoleculeBodies
) -> dict[str, Molecule]:
    """Return the bodies of a structure file by part; `changed`, its `stat_key`, is part of the cache key."""
    return {_part(molecule.name, path): molecule for molecule in read_molecule(path, bodies)}


def _part(name: str, path: Path) -> str:
    return name.removeprefix(str(path)).lstrip("#") or "model"


def _kind_of(part: str) -> MoleculeBodies:
    """Return the kind of body that a part names."""
    words = part.split()  # in a file of several structures, the first is the name of a structure
    kinds: dict[str, MoleculeBodies] = {"chain": "chains", "assembly": "assembly"}
    return next((kinds[word] for word in kinds if word in words), "models")


def molecule_of(body: BodyRef) -> Molecule:
    """Return the atoms and residues of a body: of a chain, an assembly or a model, or of all models."""
    part = body.part or ""
    stamp = stat_key(body.path)
    for kind in (_kind_of(part), "models"):
        molecules = molecules_by_part(body.path, stamp, kind)
        if part in molecules:
            return molecules[part]
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
    chosen = [parts[body.part]] if body.part in parts else list(parts.values())
    structure = gemmi.Structure()
    for number, chains in enumerate(chosen, 1):
        model = gemmi.Model(number)
        for chain in chains:
            model.add_chain(chain)
        structure.add_model(model)
    return structure


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Return the surfaces of the chains, models or assemblies of a structure file, in ångström."""
    bodies: MoleculeBodies = (
        options.bodies if options.bodies in ("chains", "assembly") else "models"
    )
    molecules = molecules_by_part(path, stat_key(path), bodies)
    names = [name for name in molecules if part in (None, name)]
    return [deferred(partial(molecular_surface, molecules[name]), name, "Å") for name in names]


_SUFFIXES = tuple(sorted(suffix + ending for suffix in SUFFIXES for ending in ("", ".gz")))
FORMAT = Format("a structure", _SUFFIXES, read, ("chains", "models", "assembly"), extra="molecules")

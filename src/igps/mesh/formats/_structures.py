"""The text of a structure file, as gemmi's models, chains, residues and atoms."""

from __future__ import annotations

import codecs
import gzip
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps.mesh.formats._format import distinct
from igps.mesh.mesh import MeshError

if TYPE_CHECKING:
    import gemmi

SUFFIXES = frozenset({".pdb", ".ent", ".cif", ".mmcif", ".pqr"})
"""Of structure files; a further ".gz" may follow."""

# Twice the largest structures of the Protein Data Bank.
_MOST_BYTES = 2**31
_ATOM_LINE = re.compile(rb"^(?:ATOM  |HETATM)[^\r\n]*", re.MULTILINE)
# Without any of these gemmi reads no atoms.
_COLUMNS = ("id", "type_symbol", "label_asym_id", "label_alt_id", "Cartn_x", "Cartn_y", "Cartn_z")
_END_LINE = re.compile(rb"^END[ \t]*$", re.MULTILINE)
_NUMBER_OF_RESIDUE = re.compile(r"([A-Za-z]?)(-?\d+)([A-Za-z]?)")


def suffix(path: Path) -> str:
    """The suffix in lower case, of a gzipped file that before ".gz"."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def read_structures(path: Path) -> dict[str, gemmi.Structure]:
    """What the file holds, by its name in the file: one, called "", but for mmCIF with atoms in several blocks of data.

    Of a PQR file the charges of atoms are their occupancies, and the radii their B-factors.
    """
    text = _text(path)
    if suffix(path) == ".pqr":
        return {"": _pqr(text, path)}
    gemmi = gemmi_module()
    try:
        if suffix(path) in (".pdb", ".ent"):
            return {"": _pdb(_as_models(_ATOM_LINE.sub(_with_numbers, text)))}
        document = gemmi.cif.read_string(text.decode("utf-8", "replace"))
        blocks = [block for block in document if block.find_values("_atom_site.id")] or [document[0]]
        for block in blocks:
            if missing := [name for name in _COLUMNS if not block.find_values(f"_atom_site.{name}")]:
                raise ValueError(f"_atom_site has no {', '.join(missing)}")
            _mark_unknown(block)
        names = distinct(block.name for block in blocks) if len(blocks) > 1 else [""]
        return {name: gemmi.make_structure_from_block(block) for name, block in zip(names, blocks, strict=True)}
    except (RuntimeError, ValueError, IndexError) as error:
        fault = f"{path}: not readable as a structure, or cut short ({' '.join(str(error).split())})."
        raise MeshError(f"{fault} Download or export it again.") from error


def parts_of(
    structures: Mapping[str, gemmi.Structure], bodies: str, path: Path
) -> Iterator[tuple[str, list[gemmi.Chain], list[str]]]:
    """The name of each body, its chains, and notes."""
    gemmi = gemmi_module()
    for name, structure, model in ((name, one, model) for name, one in structures.items() for model in one):
        of = f"{name} " * bool(name) + f"model {model.num} " * (len(structure) > 1)
        if bodies == "chains":
            # A chain may come in several pieces.
            for label in dict.fromkeys(chain.name for chain in model):
                yield f"{path}#{of}chain {label or 'without name'}", [c for c in model if c.name == label], []
        elif bodies == "assembly" and len(structure.assemblies):
            first = structure.assemblies[0]
            try:
                made = gemmi.make_assembly(first, model, gemmi.HowToNameCopiedChain.AddNumber)
            except RuntimeError as error:
                fault = f"{path}: {of}assembly {first.name} cannot be made of the file's chains ({error})."
                raise MeshError(f"{fault} Take the whole file, or its models or chains as bodies.") from error
            yield f"{path}#{of}assembly {first.name}", list(made), []
        else:
            notes = ["the file names no assembly: the model was taken as it is"] if bodies == "assembly" else []
            yield f"{path}#{of}".strip("# "), list(model), notes


def gemmi_module() -> Any:
    """Gemmi, or an ImportError that says how to install it."""
    try:
        import gemmi
    except ImportError as error:
        raise ImportError('Structures of molecules need gemmi: pip install "interior-gps[molecules]".') from error
    return gemmi


def _text(path: Path) -> bytes:
    if suffix(path) not in SUFFIXES:
        raise MeshError(f"{path}: expected a structure in {', '.join(sorted(SUFFIXES))}, gzipped or not.")
    if not path.is_file():
        raise MeshError(f"{path}: no such file. Check the path.")
    try:
        with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise MeshError(f"{path}: the gzipped file is cut short or damaged ({error}). Download it again.") from error
    if len(text) > _MOST_BYTES:
        raise MeshError(f"{path}: more than {_MOST_BYTES:,} bytes of text, which no structure has. Check the file.")
    if not text.strip():
        raise MeshError(f"{path}: the file is empty. Export it again.")
    return text.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _pdb(text: bytes) -> gemmi.Structure:
    """A structure in which no residue is told to be of a polymer unless the file lists the polymers' sequences.

    Before TER, where gemmi takes all for polymers, some programs write ligands, too.
    """
    structure = gemmi_module().read_pdb_string(text)
    if not any(entity.full_sequence for entity in structure.entities):
        for residue in (residue for model in structure for chain in model for residue in chain):
            residue.entity_type = gemmi_module().EntityType.Unknown
    return structure


def _with_numbers(line: re.Match[bytes]) -> bytes:
    """A line of a PDB file, with NaN where a coordinate or B-factor is no number: gemmi would read a 0 or 20 there."""
    whole = line.group()
    for start, end in ((30, 38), (38, 46), (46, 54), (60, 66)):
        try:
            float(whole[start:end])
        except ValueError:
            if len(whole) >= 54:
                whole = whole[:start].ljust(start) + b"nan".rjust(end - start) + whole[end:]
    return whole


def _as_models(text: bytes) -> bytes:
    """What END parts, as frames of simulations are, becomes models: gemmi would read the first alone."""
    frames = [frame for frame in _END_LINE.split(text) if _ATOM_LINE.search(frame)]
    return b"ENDMDL\n".join(frames) if len(frames) > 1 else text


def _mark_unknown(block: gemmi.cif.Block) -> None:
    """NaN where a B-factor is not known: gemmi would read 20."""
    column = block.find_values("_atom_site.B_iso_or_equiv")
    if not column and (loop := block.find_values("_atom_site.id").get_loop()):
        loop.add_columns(["_atom_site.B_iso_or_equiv"], "nan")
    elif not column:  # of a single atom
        block.set_pair("_atom_site.B_iso_or_equiv", "nan")
    for row, value in enumerate(column):
        if value in ("?", "."):
            column[row] = "nan"


def _pqr(text: bytes, path: Path) -> gemmi.Structure:
    """Fields are separated by blanks: type, serial number, atom, residue, [chain,] number, x, y, z, charge, radius.

    Where numbers are long, some programs leave no blank between "HETATM" and the serial, or chain and number.
    """
    gemmi = gemmi_module()
    structure = gemmi.Structure()
    chains: dict[str, list[Any]] = {}
    for number, line in enumerate(text.decode("latin-1").splitlines(), start=1):
        if line.startswith(("MODEL", "ENDMDL")):
            _add_model(structure, chains)
        if not line.startswith(("ATOM", "HETATM")):
            continue
        fields = line.replace("HETATM", "HETATM ", 1).split()
        try:
            x, y, z, charge, radius = map(float, fields[-5:])
            name, residue, *chain, place = fields[2:-5]
            found = _NUMBER_OF_RESIDUE.fullmatch(place)
            if len(name) > 4 or len(chain) > 1 or found is None or not radius >= 0:
                raise ValueError("10 or 11 fields, the last a radius of at least 0, were expected")
            chain = chain or [found[1]]
        except ValueError as error:
            fault = f"{path}: line {number} is no atom of a PQR file ({error})."
            raise MeshError(f"{fault} It may be cut short; write it again, with blanks between fields.") from error
        residues = chains.setdefault(chain[0], [])
        key = gemmi.SeqId(int(found[2]), found[3] or " ")
        if not residues or residues[-1].seqid != key or residues[-1].name != residue:
            new = gemmi.Residue()
            new.name, new.seqid, new.het_flag = residue, key, line[0]
            residues.append(new)
        atom = gemmi.Atom()
        atom.name, atom.pos, atom.occ, atom.b_iso = name, gemmi.Position(x, y, z), charge, radius
        residues[-1].add_atom(atom)
    _add_model(structure, chains)
    return structure


def _add_model(structure: gemmi.Structure, chains: dict[str, list[Any]]) -> None:
    """Move the chains, if there are any, to a new model."""
    gemmi = gemmi_module()
    model = gemmi.Model(len(structure) + 1)
    for name, residues in chains.items():
        chain = gemmi.Chain(name)
        for residue in residues:
            chain.add_residue(residue)
        model.add_chain(chain)
    if chains:
        structure.add_model(model)
        chains.clear()

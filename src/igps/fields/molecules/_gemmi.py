"""Structure files of molecules, parsed into gemmi's models, chains, residues and atoms."""

from __future__ import annotations

import codecs
import gzip
import itertools
import logging
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps.fields.molecules._binary_cif import MAX_BYTES as MAX_BINARY_BYTES
from igps.fields.molecules._binary_cif import read_binary_cif
from igps.mesh.errors import MeshError
from igps.mesh.raw_body import distinct

if TYPE_CHECKING:
    import gemmi

logger = logging.getLogger(__name__)

SUFFIXES = frozenset({".pdb", ".ent", ".cif", ".mmcif", ".bcif", ".pqr"})
"""Suffixes of structure files; ".gz" may follow."""

_MAX_BYTES = 2**31  # twice the largest structures of the Protein Data Bank
_ATOM_LINE = re.compile(rb"^(?:ATOM  |HETATM)[^\r\n]*", re.MULTILINE)
# Columns of _atom_site without which gemmi reads no atoms.
_REQUIRED_COLUMNS = (
    "id",
    "type_symbol",
    "label_asym_id",
    "label_alt_id",
    "Cartn_x",
    "Cartn_y",
    "Cartn_z",
)
_MODEL_LINE = re.compile(rb"^MODEL[ \t]+\d+[^\r\n]*", re.MULTILINE)
# The start of a line up to its coordinates, which need not be in their columns
_WIDE = re.compile(
    rb"^((?:ATOM  |HETATM)[^\n]{24}) *(-?\d+\.\d{3}) *(-?\d+\.\d{3}) *(-?\d+\.\d{3})",
    re.MULTILINE,
)
_END_LINE = re.compile(rb"^END[ \t]*$", re.MULTILINE)
# The chain, number and insertion code of a residue in a PQR file, as in "A12B"; chain and code may be missing.
_RESIDUE_NUMBER = re.compile(r"([A-Za-z]?)(-?\d+)([A-Za-z]?)")


def suffix_of(path: Path) -> str:
    """Return the suffix in lower case, that before ".gz" for a gzipped file."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def read_structures(path: Path) -> dict[str, gemmi.Structure]:
    """Read the structures of a file by name: one called "", or those of mmCIF with atoms in several data blocks.

    The atoms of a PQR file carry their charges as occupancies and their radii as B-factors.
    """
    content = _read_bytes(path)
    suffix = suffix_of(path)
    if suffix == ".pqr":
        return {"": _pqr(content, path)}
    gemmi = gemmi_module()
    try:
        if suffix in (".pdb", ".ent"):
            _check_end(content, path)
            marked = _ATOM_LINE.sub(_mark_missing, _WIDE.sub(_narrowed, content))
            return {"": _pdb(_numbered_models(_frames_as_models(marked)))}
        if suffix == ".bcif":
            document = _binary_document(content)
        else:
            document = gemmi.cif.read_string(content.decode("utf-8", "replace"))
        blocks = [block for block in document if block.find_values("_atom_site.id")] or [
            document[0]
        ]
        for block in blocks:
            if missing := [
                name for name in _REQUIRED_COLUMNS if not block.find_values(f"_atom_site.{name}")
            ]:
                raise ValueError(f"_atom_site has no {', '.join(missing)}")
            _mark_unknown(block)
        names = distinct(block.name for block in blocks) if len(blocks) > 1 else [""]
        return {
            name: gemmi.make_structure_from_block(block)
            for name, block in zip(names, blocks, strict=True)
        }
    except (RuntimeError, ValueError, IndexError) as error:
        fault = (
            f"{path}: not readable as a structure, or cut short ({' '.join(str(error).split())})."
        )
        raise MeshError(f"{fault} Download or export it again.") from error


def parts_of(
    structures: Mapping[str, gemmi.Structure], bodies: str, path: Path
) -> Iterator[tuple[str, list[gemmi.Chain], list[str]]]:
    """Yield the name of each body, its chains, and notes."""
    gemmi = gemmi_module()
    for name, structure, model in (
        (name, item, model) for name, item in structures.items() for model in item
    ):
        prefix = f"{name} " * bool(name) + f"model {model.num} " * (len(structure) > 1)
        if bodies == "chains":
            # The atoms of a chain may stand in several places of the file
            for label in dict.fromkeys(chain.name for chain in model):
                yield (
                    f"{path}#{prefix}chain {label or 'without name'}",
                    [c for c in model if c.name == label],
                    [],
                )
        elif bodies == "assembly" and len(structure.assemblies):
            assembly = structure.assemblies[0]
            try:
                chains = gemmi.make_assembly(assembly, model, gemmi.HowToNameCopiedChain.AddNumber)
            except RuntimeError as error:
                fault = f"{path}: {prefix}assembly {assembly.name} cannot be made of the file's chains ({error})."
                raise MeshError(
                    f"{fault} Take the whole file, its models or its chains as bodies."
                ) from error
            yield f"{path}#{prefix}assembly {assembly.name}", list(chains), []
        else:
            notes = (
                ["the file defines no assembly: the model was used"] if bodies == "assembly" else []
            )
            yield f"{path}#{prefix}".strip("# "), list(model), notes


def gemmi_module() -> Any:
    """Import gemmi, or raise an ImportError that tells how to install it."""
    try:
        import gemmi
    except ImportError as error:
        raise ImportError(
            'Structures of molecules need gemmi: pip install "interior-gps[molecules]".'
        ) from error
    return gemmi


def _binary_document(content: bytes) -> gemmi.cif.Document:
    document = gemmi_module().cif.Document()
    for name, tables in read_binary_cif(content):
        block = document.add_new_block(name)
        for title, columns in tables.items():
            block.set_mmcif_category(title, columns)
    return document


def _read_bytes(path: Path) -> bytes:
    if suffix_of(path) not in SUFFIXES:
        raise MeshError(
            f"{path}: expected a structure in {', '.join(sorted(SUFFIXES))}, gzipped or not."
        )
    if not path.is_file():
        raise MeshError(f"{path}: no such file. Check the path.")
    is_binary = suffix_of(path) == ".bcif"
    max_bytes = MAX_BINARY_BYTES if is_binary else _MAX_BYTES
    try:
        with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise MeshError(
            f"{path}: the gzipped file is cut short or damaged ({error}). Download it again."
        ) from error
    if len(content) > max_bytes:
        raise MeshError(f"{path}: expected at most {max_bytes:,} bytes, got more. Check the file.")
    if not content.strip():
        raise MeshError(f"{path}: the file is empty. Export it again.")
    if is_binary:
        return content
    return content.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _pdb(text: bytes) -> gemmi.Structure:
    structure = gemmi_module().read_pdb_string(text)
    # Without the sequences of polymers, gemmi takes each residue before TER for a part of one, but it may be a ligand.
    if not any(entity.full_sequence for entity in structure.entities):
        for residue in (residue for model in structure for chain in model for residue in chain):
            residue.entity_type = gemmi_module().EntityType.Unknown
    return structure


def _mark_missing(line: re.Match[bytes]) -> bytes:
    """Put NaN for coordinates and B-factors of a PDB line that are no numbers: gemmi would read them as 0 or 20."""
    text = line.group()
    for start, end in ((30, 38), (38, 46), (46, 54), (60, 66)):
        try:
            float(text[start:end])
        except ValueError:
            if len(text) >= 54:
                text = text[:start].ljust(start) + b"nan".rjust(end - start) + text[end:]
    return text


def _check_end(text: bytes, path: Path) -> None:
    """Raise a ValueError if the last line of a PDB file is broken; warn if its END is missing."""
    *_, before, last = b"\n", *text.rsplit(b"\n", 2)
    if last.startswith(b"ATO") and len(last) < len(before):
        raise ValueError("its last line is broken")
    if text.startswith(b"HEADER") and not _END_LINE.search(text):
        logger.warning(
            "%s: it has a HEADER and no END, so it may be cut short. Download it again.", path
        )


def _narrowed(line: re.Match[bytes]) -> bytes:
    """Return the start of a PDB line with coordinates of eight characters each: programs write nine beyond ±1000 Å."""
    if len(line[0]) <= 54:
        return line[0]
    numbers = [b"%8.2f" % float(line[i]) for i in (2, 3, 4)]
    return line[1] + b"".join(numbers)


def _frames_as_models(text: bytes) -> bytes:
    """Turn frames of a simulation, separated by END, into models: gemmi would read the first frame only."""
    frames = [frame for frame in _END_LINE.split(text) if _ATOM_LINE.search(frame)]
    return b"ENDMDL\n".join(frames) if len(frames) > 1 else text


def _numbered_models(text: bytes) -> bytes:
    """Number the models of a PDB file from 1 if a number repeats, as when files were joined: gemmi refuses those."""
    numbers = _MODEL_LINE.findall(text)
    if len(set(numbers)) == len(numbers):
        return text
    count = itertools.count(1)
    return _MODEL_LINE.sub(lambda _: b"MODEL     %4d" % next(count), text)


def _mark_unknown(block: gemmi.cif.Block) -> None:
    """Put NaN for unknown B-factors of mmCIF: gemmi would read them as 20."""
    column = block.find_values("_atom_site.B_iso_or_equiv")
    if not column and (loop := block.find_values("_atom_site.id").get_loop()):
        loop.add_columns(["_atom_site.B_iso_or_equiv"], "nan")
    elif not column:  # a single atom, without a loop
        block.set_pair("_atom_site.B_iso_or_equiv", "nan")
    for row, value in enumerate(column):
        if value in ("?", "."):
            column[row] = "nan"


def _pqr(text: bytes, path: Path) -> gemmi.Structure:
    """Parse a PQR file: lines of type, serial number, atom, residue, [chain,] number, x, y, z, charge and radius."""
    gemmi = gemmi_module()
    structure = gemmi.Structure()
    chains: dict[str, list[Any]] = {}
    for number, line in enumerate(text.decode("latin-1").splitlines(), start=1):
        if line.startswith(("MODEL", "ENDMDL")):
            _add_model(structure, chains)
        if not line.startswith(("ATOM", "HETATM")):
            continue
        # Some programs leave no blank before long numbers behind HETATM or the chain.
        fields = line.replace("HETATM", "HETATM ", 1).split()
        try:
            x, y, z, charge, radius = map(float, fields[-5:])
            name, residue, *chain, residue_number = fields[2:-5]
            match = _RESIDUE_NUMBER.fullmatch(residue_number)
            if len(name) > 4 or len(chain) > 1 or match is None or not radius >= 0:
                raise ValueError("expected 10 or 11 fields, the last a radius of at least 0")
            chain = chain or [match[1]]
        except ValueError as error:
            fault = f"{path}: line {number} is no atom of a PQR file ({error})."
            raise MeshError(
                f"{fault} It may be cut short. Write it again, with blanks between fields."
            ) from error
        residues = chains.setdefault(chain[0], [])
        key = gemmi.SeqId(int(match[2]), match[3] or " ")
        if not residues or residues[-1].seqid != key or residues[-1].name != residue:
            new = gemmi.Residue()
            new.name = residue
            new.seqid = key
            new.het_flag = line[0]
            residues.append(new)
        atom = gemmi.Atom()
        atom.name = name
        atom.pos = gemmi.Position(x, y, z)
        atom.occ = charge
        atom.b_iso = radius
        residues[-1].add_atom(atom)
    _add_model(structure, chains)
    return structure


def _add_model(structure: gemmi.Structure, chains: dict[str, list[Any]]) -> None:
    """Move the collected chains, if any, to a new model of the structure."""
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

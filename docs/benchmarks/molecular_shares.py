"""The shares of the parts of `molecular`: by how far each part tells unrelated chains apart.

python -m docs.benchmarks.molecular_shares STRUCTURES MADE
"""

from __future__ import annotations

from pathlib import Path

import gemmi
import numpy as np
import torch
from docs.benchmarks.molecules import AMINO_ACIDS, N_CUT, deformed, turning
from jsonargparse import auto_cli
from torch import Tensor

from igps._arrays import Floats
from igps.cli import errors_as_messages
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from igps.fields.molecules.molecular import molecular
from igps.fields.molecules.molecule import Molecule
from igps.retrieval import chi_square, retrieval_scores

ATOMS = ("N", "CA", "C", "O")
PARTS = ("form", "fold", "composition", "charges")
DEGREES = 40.0  # by which the half of a chain is turned
REPLACED = 0.6  # share of residues that a relative has of other kinds


def molecular_shares(structures: Path, made: Path) -> None:
    """Make chains of known relation, and print how each part of `molecular` tells them.

    Of the first chain of each structure there are four, as backbones: as it is; bent by 40° about its middle residue;
    deformed along the lowest modes of an elastic network; and deformed with 60 % of its residues replaced. All but the
    first lack up to six residues at each end. The share of a part is that of Fisher's linear discriminant of unrelated
    chains and relatives, with parts taken as independent: the difference of the means of its distances over the mean
    of their variances.

    Args:
        structures: folder of structures whose first chains are unrelated.
        made: folder for the chains that are made, a folder of each structure, and for what is computed of them.
    """
    generator = np.random.default_rng(11)
    for path in find_bodies(structures).paths:
        positions, names = backbone(path)
        if len(names) > 60:
            folder = made / "chains" / path.name.partition(".")[0]
            write_changed(folder, positions, names, generator)
    descriptor = molecular()
    dataset = SignatureDataset(made / "chains", descriptor=descriptor, cache_dir=made / "cache")
    found = torch.cat([descriptor(dataset.batch([i])) for i in range(len(dataset))])
    labels = list(dataset.bodies.labels or ())
    distances = torch.stack(part_distances(found, descriptor.part_cells))
    is_whole = torch.tensor([path.stem == "whole" for path in dataset.bodies.paths])
    is_same = torch.tensor([[one == other for one in labels] for other in labels])
    unrelated = distances[:, is_whole[:, None] & is_whole & ~is_same]
    related = distances[:, is_same & ~torch.eye(len(labels), dtype=torch.bool)]
    variances = (unrelated.var(dim=1) + related.var(dim=1)) / 2
    by_discriminant = (unrelated.mean(dim=1) - related.mean(dim=1)) / variances
    by_spread = 1 / unrelated.median(dim=1).values
    print("| part | unrelated | related | share | NN / FT |")
    shares = by_discriminant / by_discriminant.sum()
    rows = zip(PARTS, unrelated, related, shares, distances, strict=True)
    for name, far, near, share, each in rows:
        medians = f"{far.median():.3f} | {near.median():.3f}"
        print(f"| {name} | {medians} | {share:.1%} | {scores(each, labels)} |")
    ways = {"equal": torch.ones(4), "by spread": by_spread, "by discriminant": by_discriminant}
    for title, weights in ways.items():
        mixed = torch.einsum("p,pij->ij", weights, distances)
        print(f"| {title} | {scores(mixed, labels)} |")


def part_distances(cells: Tensor, part_cells: tuple[int, ...]) -> list[Tensor]:
    """Return the χ² distances (N, N) of each part alone."""
    parts = cells.split(list(part_cells), dim=1)
    shares = [part / part.sum(dim=1, keepdim=True) for part in parts]
    return [chi_square(part, part) for part in shares]


def scores(distances: Tensor, labels: list[object]) -> str:
    """Return NN and FT."""
    means = retrieval_scores(distances, labels).mean()
    return f"{means['nn']:.1%} / {means['ft']:.1%}"


def backbone(path: Path) -> tuple[Floats, list[str]]:
    """Return the backbone (R, 4, 3) of the first chain, Å, and the names of its residues."""
    positions = []
    names = []
    for residue in gemmi.read_structure(str(path))[0][0]:
        atoms = {atom.name: atom.pos.tolist() for atom in residue}
        if residue.name in AMINO_ACIDS and atoms.keys() >= set(ATOMS):
            positions.append([atoms[name] for name in ATOMS])
            names.append(residue.name)
    return np.array(positions), names


def write_changed(
    folder: Path, positions: Floats, names: list[str], generator: np.random.Generator
) -> None:
    """Write a chain and its relatives, a file for each."""
    others = generator.choice(AMINO_ACIDS, len(names)).tolist()
    is_replaced = generator.random(len(names)) < REPLACED
    mixed = [
        other if replaced else name
        for name, other, replaced in zip(names, others, is_replaced, strict=True)
    ]
    middle = len(names) // 2
    bent = positions.copy()
    pivot = positions[middle, 1]
    bent[middle:] = (positions[middle:] - pivot) @ turning(DEGREES, generator).T + pivot
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "whole.pdb", positions, names)
    changed = (
        ("bent", bent, names),
        ("deformed", moved(positions, generator), names),
        ("relative", moved(positions, generator), mixed),
    )
    for title, at, kinds in changed:
        start, end = generator.integers(0, N_CUT + 1, 2)
        kept = slice(start, len(names) - end)
        write(folder / f"{title}.pdb", at[kept], kinds[kept])


def moved(positions: Floats, generator: np.random.Generator) -> Floats:
    """Return the backbone with each residue moved as its Cα in `deformed`."""
    alpha = positions[:, 1]
    none = np.zeros(len(alpha))
    chain = Molecule(
        "", alpha, none, none, np.arange(len(alpha)), ("ALA",) * len(alpha), alpha, none
    )
    return positions + (deformed(chain, generator).residue_positions - alpha)[:, None]


def write(path: Path, positions: Floats, names: list[str]) -> None:
    """Write a backbone (R, 4, 3) as PDB."""
    chain = gemmi.Chain("A")
    for number, (atoms, name) in enumerate(zip(positions, names, strict=True), 1):
        residue = gemmi.Residue()
        residue.name = name
        residue.seqid = gemmi.SeqId(number, " ")
        for title, position in zip(ATOMS, atoms, strict=True):
            atom = gemmi.Atom()
            atom.name = title
            atom.element = gemmi.Element(title[0])
            atom.pos = gemmi.Position(*position)
            residue.add_atom(atom)
        chain.add_residue(residue)
    model = gemmi.Model(1)
    model.add_chain(chain)
    structure = gemmi.Structure()
    structure.add_model(model)
    structure.write_pdb(str(path))


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(molecular_shares)

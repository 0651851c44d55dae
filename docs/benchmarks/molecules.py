"""Folds told from compositions: the tables of benchmarks/molecules.md.

python -m docs.benchmarks.molecules STRUCTURES
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from jsonargparse import auto_cli
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree
from torch import Tensor

from igps._arrays import Floats
from igps.cli import errors_as_messages
from igps.data.collation import collate
from igps.data.sources import find_bodies
from igps.fields.molecules.fold import TRACE, FoldHistogram
from igps.fields.molecules.molecule import Molecule
from igps.fields.molecules.residue_attributes import residue_attribute
from igps.fields.molecules.residues import VOLUMES
from igps.fields.molecules.structures import read_molecule
from igps.retrieval import chi_square, retrieval_scores
from igps.signature.signature import Samples, Signature, SignatureConfig

AMINO_ACIDS = tuple(sorted(VOLUMES))
ANGLES = (20, 40, 60)  # degrees
N_CUT = 6  # residues at most, that an end of a changed chain lacks
REACH = 13.0  # Å, between residues that a spring joins (Atilgan et al. 2001)
N_MODES = 8
FLUCTUATION = 3.0  # Å, of residues in the lowest modes
NOISE = 0.5  # Å

Change = Callable[[Molecule, np.random.Generator], Molecule]


def molecules(
    structures: Path, n_seeds: int = 3, tm_align: bool = False, n_aligned: int = 12
) -> None:
    """Print how well the fold, the composition and the length of chains find conformations and families.

    Args:
        structures: folder of structures with classes, such as conformations by protein; each file holds one chain.
        n_seeds: number of times that the families are made.
        tm_align: also compare by TM-align, for which tmtools must be installed: 0.2 s a pair.
        n_aligned: number of folds whose families are compared by TM-align.
    """
    bodies = find_bodies(structures, labelled=True)
    labels = list(bodies.labels or ())
    chains = [read_molecule(path)[0] for path in bodies.paths]
    report(f"{len(chains)} chains of {len(set(labels))} classes", chains, labels, tm_align)
    first = [chains[labels.index(label)] for label in dict.fromkeys(labels)]
    for seed in range(n_seeds):
        made, folds = families(first, seed)
        report(f"families, seed {seed}", made, folds)
    if tm_align:
        made, folds = families(first[:n_aligned], 0)
        report(f"families of {n_aligned} folds, seed 0", made, folds, tm_align)
    for angle in ANGLES:
        moves = [turned(first, angle, seed) for seed in range(n_seeds)]
        movement, found = np.mean(moves, axis=0)
        print(f"halves turned by {angle}°: {movement:.1%} of the median, own first {found:.1%}")


def report(
    title: str, chains: Sequence[Molecule], labels: Sequence[object], tm_align: bool = False
) -> None:
    """Print NN and FT by fold, composition and length, and by TM-align if it is wanted."""
    print(title, flush=True)
    distances = {
        "fold": fold_distances(chains),
        "composition": composition_distances(chains),
        "length": length_distances(chains),
    }
    if tm_align:
        scores = tm_scores(chains)
        distances["TM-align, mean of both scores"] = 1 - (scores + scores.T) / 2
        distances["TM-align, larger score"] = 1 - torch.maximum(scores, scores.T)
    for name, found in distances.items():
        means = retrieval_scores(found, labels).mean()
        print(f"| {name} | {means['nn']:.1%} | {means['ft']:.1%} |", flush=True)


def families(chains: Sequence[Molecule], seed: int) -> tuple[list[Molecule], list[int]]:
    """Return chains of the same folds with other residues, and their folds.

    Of each chain there are four: as it is, with halves moved against each other, deformed, and circularly permuted and
    deformed. Each has the composition of a chain of another fold, and each composition occurs in four folds.
    """
    generator = np.random.default_rng(seed)
    compositions = generator.dirichlet(np.full(len(AMINO_ACIDS), 3.0), len(chains))
    made: list[Molecule] = []
    folds: list[int] = []
    for fold, chain in enumerate(chains):
        for k, change in enumerate(CHANGES):
            changed = change(chain, generator)
            composition = compositions[(fold + k) % len(chains)]
            made.append(threaded(changed, composition, generator))
            folds.append(fold)
    return made, folds


def threaded(chain: Molecule, composition: Floats, generator: np.random.Generator) -> Molecule:
    """Return the chain with residues drawn from shares (20,) of the amino acids."""
    names = generator.choice(AMINO_ACIDS, len(chain.residue_names), p=composition)
    return replace(chain, residue_names=tuple(names.tolist()))


def with_halves_moved(chain: Molecule, generator: np.random.Generator) -> Molecule:
    """Return the chain bent by 40° about its middle residue, without some residues at both ends."""
    start, end = generator.integers(0, N_CUT + 1, 2)
    bent = bent_chain(chain, 40, generator)
    return kept(bent, slice(start, len(chain.residue_names) - end))


def bent_chain(chain: Molecule, degrees: float, generator: np.random.Generator) -> Molecule:
    """Return the chain with its second half turned about the middle residue, around a random axis."""
    positions = chain.residue_positions.copy()
    middle = len(positions) // 2
    pivot = positions[middle]
    turn = turning(degrees, generator)
    positions[middle:] = (positions[middle:] - pivot) @ turn.T + pivot
    return replace(chain, residue_positions=positions)


def turning(degrees: float, generator: np.random.Generator) -> Floats:
    """Return a rotation (3, 3) around a random axis (Rodrigues)."""
    axis = generator.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def deformed(chain: Molecule, generator: np.random.Generator) -> Molecule:
    """Return the chain moved along the lowest modes of an elastic network, with noise (Atilgan et al. 2001)."""
    positions = chain.residue_positions
    stiffness = elastic_network(positions)
    values, vectors = eigsh(stiffness, k=N_MODES + 6, sigma=-1e-3, v0=np.ones(len(positions) * 3))
    order = np.argsort(values)[6:]
    amplitudes = generator.normal(size=N_MODES) / np.sqrt(np.maximum(values[order], 1e-6))
    motion = (vectors[:, order] @ amplitudes).reshape(-1, 3)
    motion *= FLUCTUATION / np.sqrt((motion**2).sum(axis=1).mean())
    noise = NOISE * generator.normal(size=positions.shape)
    return replace(chain, residue_positions=positions + motion + noise)


def elastic_network(positions: Floats) -> csc_array:
    """Return the stiffness (3R, 3R) of springs of equal strength between residues that are near each other."""
    i, j = cKDTree(positions).query_pairs(REACH, output_type="ndarray").T
    line = positions[j] - positions[i]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    blocks = line[:, :, None] * line[:, None, :]
    axes = np.arange(3)

    def placed(rows: Floats, columns: Floats, values: Floats) -> coo_array:
        row = np.broadcast_to(3 * rows[:, None, None] + axes[:, None], values.shape)
        column = np.broadcast_to(3 * columns[:, None, None] + axes, values.shape)
        size = 3 * len(positions)
        return coo_array((values.ravel(), (row.ravel(), column.ravel())), shape=(size, size))

    total = placed(i, i, blocks) + placed(j, j, blocks)
    return csc_array(total - placed(i, j, blocks) - placed(j, i, blocks))


def permuted(chain: Molecule, generator: np.random.Generator) -> Molecule:
    """Return the deformed chain with its ends joined and cut between a quarter and three quarters of its length."""
    n = len(chain.residue_names)
    cut = int(generator.integers(n // 4, 3 * n // 4))
    order = np.r_[cut:n, 0:cut]
    moved = deformed(chain, generator)
    return replace(
        moved, residue_positions=moved.residue_positions[order], places=np.arange(n, dtype=float)
    )


def unchanged(chain: Molecule, generator: np.random.Generator) -> Molecule:
    """Return the chain as it is."""
    return chain


CHANGES: tuple[Change, ...] = (unchanged, with_halves_moved, deformed, permuted)


def kept(chain: Molecule, part: slice) -> Molecule:
    """Return a part of the residues."""
    return replace(
        chain,
        residue_names=chain.residue_names[part],
        residue_positions=chain.residue_positions[part],
        places=chain.places[part],
    )


def turned(chains: Sequence[Molecule], degrees: float, seed: int) -> tuple[float, float]:
    """Return how far chains move when their halves turn, over the median distance, and how many are found first."""
    generator = np.random.default_rng(seed)
    here = fold_descriptions(chains)
    there = fold_descriptions([bent_chain(chain, degrees, generator) for chain in chains])
    between = chi_square(here, here)
    others = between[~torch.eye(len(chains), dtype=torch.bool)]
    across = chi_square(there, here)
    movement = float(across.diagonal().median() / others.median())
    is_found = across.argmin(dim=1) == torch.arange(len(chains))
    return movement, float(is_found.double().mean())


def fold_descriptions(chains: Iterable[Molecule]) -> Tensor:
    """Return descriptions (N, cells) by `fold`, with the residues as samples, so that no surface is needed."""
    histogram = FoldHistogram(n_samples=None).eval()
    rows = []
    for chain in chains:
        trace = residue_attribute(chain, chain.residue_positions, TRACE)
        eigenfunctions = np.zeros((len(trace), 1), dtype=np.float32)
        samples = Samples(chain.residue_positions, eigenfunctions, {TRACE: np.float32(trace)})
        signature = Signature(np.ones(1), samples, samples, 1.0, 1.0, SignatureConfig())
        rows.append(histogram(collate([signature])).flatten())
    return torch.stack(rows)


def fold_distances(chains: Sequence[Molecule]) -> Tensor:
    """Return distances (N, N) by `fold`."""
    descriptions = fold_descriptions(chains)
    return chi_square(descriptions, descriptions)


def composition_distances(chains: Sequence[Molecule]) -> Tensor:
    """Return the χ² distances (N, N) of the shares of the amino acids."""
    counts = [[chain.residue_names.count(name) for name in AMINO_ACIDS] for chain in chains]
    shares = torch.tensor(counts, dtype=torch.float64)
    shares = shares / shares.sum(dim=1, keepdim=True)
    return chi_square(shares, shares)


def length_distances(chains: Sequence[Molecule]) -> Tensor:
    """Return the differences (N, N) of the logarithms of the numbers of residues."""
    lengths = torch.tensor([float(len(chain.residue_names)) for chain in chains]).log()
    return (lengths[:, None] - lengths).abs()


def tm_scores(chains: Sequence[Molecule]) -> Tensor:
    """Return TM-scores (N, N) of TM-align, of the row's chain by its own length (Zhang and Skolnick 2005)."""
    from tmtools import tm_align

    scores = torch.ones(len(chains), len(chains))
    for i, j in combinations(range(len(chains)), 2):
        one = chains[i].residue_positions
        other = chains[j].residue_positions
        found = tm_align(one, other, "A" * len(one), "A" * len(other))
        scores[i, j] = found.tm_norm_chain1
        scores[j, i] = found.tm_norm_chain2
    return scores


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(molecules)

"""What the program of benchmarks/molecules.md does to chains, by what must stay and what must change."""

import numpy as np
import torch
from docs.benchmarks import molecular_shares as shares_program
from docs.benchmarks import molecules as program
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose

from igps.fields.molecules.molecule import Molecule
from igps.retrieval import retrieval_scores


def chain(seed, n=70):
    """A compact walk with helices of 14 residues between turns."""
    generator = default_rng(seed)
    positions = [np.zeros(3)]
    direction = np.array([1.0, 0, 0])
    for i in range(1, n):
        if i % 14 == 0:
            towards = -np.mean(positions, axis=0)
            direction = generator.normal(size=3) + towards / (norm(towards) + 1)
            direction /= norm(direction)
        across = np.linalg.qr(np.column_stack([direction, np.eye(3)[:, :2] + 0.1]))[0][:, 1:]
        turn = np.radians(100 * i)
        winding = 2.3 * (np.cos(turn) * across[:, 0] + np.sin(turn) * across[:, 1])
        positions.append(positions[-1] + 1.5 * direction + 0.4 * winding)
    at = np.array(positions)
    none = np.zeros(n)
    return Molecule(
        f"{seed}",
        at,
        none,
        none,
        np.arange(n),
        ("ALA",) * n,
        at,
        none,
    )


CHAINS = [chain(seed) for seed in range(6)]


def test_families_share_folds_and_compositions_cross_them():
    made, folds = program.families(CHAINS, 0)
    assert folds == [fold for fold in range(6) for _ in program.CHANGES]
    by_fold = retrieval_scores(program.fold_distances(made), folds).mean()
    by_composition = retrieval_scores(program.composition_distances(made), folds).mean()
    assert by_fold["ft"] > 0.5
    assert by_composition["ft"] < 0.2


def test_a_bent_chain_keeps_the_distances_within_its_halves():
    generator = default_rng(0)
    bent = program.bent_chain(CHAINS[1], 40, generator)
    before = torch.cdist(*[torch.tensor(CHAINS[1].residue_positions)] * 2)
    after = torch.cdist(*[torch.tensor(bent.residue_positions)] * 2)
    half = slice(0, 36)
    torch.testing.assert_close(after[half, half], before[half, half], atol=1e-5, rtol=0)
    torch.testing.assert_close(after[35:, 35:], before[35:, 35:], atol=1e-5, rtol=0)
    assert float((after - before).abs().max()) > 1


def test_deformed_and_permuted_chains_move_as_far_as_told():
    generator = default_rng(0)
    moved = program.deformed(CHAINS[3], generator).residue_positions
    shift = np.sqrt(((moved - CHAINS[3].residue_positions) ** 2).sum(axis=1).mean())
    assert abs(shift - np.hypot(program.FLUCTUATION, program.NOISE * 3**0.5)) < 0.5
    turned = program.permuted(CHAINS[3], generator)
    assert turned.places.tolist() == list(range(70))
    steps = norm(
        np.diff(turned.residue_positions, axis=0),
        axis=1,
    )
    assert (steps > 6).sum() <= 3  # the ends that were joined


def test_relatives_are_backbones_without_some_ends(tmp_path):
    generator = default_rng(1)
    offsets = np.array(
        [
            [-1.2, 0.5, 0],
            [0, 0, 0],
            [0.9, 1.1, 0],
            [0.3, 2.2, 0.4],
        ]
    )
    positions = CHAINS[4].residue_positions[:, None] + offsets
    names = generator.choice(program.AMINO_ACIDS, 70).tolist()
    shares_program.write_changed(tmp_path, positions, names, generator)
    found = {path.stem: shares_program.backbone(path) for path in tmp_path.iterdir()}
    at, kinds = found["whole"]
    assert_allclose(at, positions, atol=1e-3)
    assert kinds == names
    for title, same in (("bent", 1.0), ("deformed", 1.0), ("relative", 0.4)):
        at, kinds = found[title]
        assert 70 - 2 * program.N_CUT <= len(kinds) < 70
        shares = [
            np.mean([one == other for one, other in zip(kinds, names[start:], strict=False)])
            for start in range(program.N_CUT + 1)
        ]
        assert abs(max(shares) - same) < 0.2

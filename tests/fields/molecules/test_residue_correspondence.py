"""Residues correspond by their sequences, and an explanation tells which of them moved."""

import csv

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from commands import run
from igps.data.correspondence import correspondence
from igps.fields.molecules.residue_correspondence import aligned
from igps.fields.molecules.residues import VOLUMES
from igps.mesh.loading import BodyRef

gemmi = pytest.importorskip("gemmi")

N_RESIDUES = 60
HINGE = 40
SEQUENCE = np.random.default_rng(0).choice(sorted(VOLUMES), N_RESIDUES).tolist()


def coil():
    t = np.arange(N_RESIDUES)
    return np.stack(
        [1.5 * t, 6 * np.cos(1.3 * t), 6 * np.sin(1.3 * t)],
        axis=1,
    )


def write(path, positions, names, first=1):
    """Write a trace of Cα."""
    text = ""
    for i, (name, (x, y, z)) in enumerate(zip(names, positions, strict=True)):
        text += f"ATOM  {i:>5}  CA  {name} A{first + i:>4}    "
        text += f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00 20.00           C\n"
    path.write_text(text)
    return path


@pytest.fixture
def pair(tmp_path):
    """A coil, and the same with its last third turned about the hinge, moved as a whole, and numbered otherwise."""
    straight = coil()
    bent = straight.copy()
    turn = Rotation.from_rotvec([0.0, 1.0, 0.0])
    bent[HINGE:] = straight[HINGE] + turn.apply(straight[HINGE:] - straight[HINGE])
    moved = Rotation.from_rotvec([0.4, 0.2, -1.0]).apply(bent) + np.array([30.0, 5.0, -8.0])
    one = write(tmp_path / "one.pdb", straight, SEQUENCE)
    return one, write(tmp_path / "two.pdb", moved, SEQUENCE, first=301)


def test_the_turned_part_has_the_paint_in_both_and_structures_are_superposed(pair, tmp_path):
    out = tmp_path / "out"
    words = ["explain", *pair, "--descriptor", "interior", "--out", out]
    small = ["--signature.resolution", 12, "--signature.max_vertices", 600]
    cache = ["--cache_dir", tmp_path / "cache", "--n_workers", 1, "--signature.min_samples", 0]
    run(*words, *small, *cache)
    with (out / "explain_residues.csv").open() as file:
        rows = list(csv.DictReader(file))
    arm = coil()[HINGE:] - coil()[HINGE]
    steps = np.zeros(N_RESIDUES)
    steps[HINGE:] = np.linalg.norm(
        Rotation.from_rotvec([0.0, 1.0, 0.0]).apply(arm) - arm,
        axis=1,
    )
    told = np.array([float(row["displacement"]) for row in rows]).reshape(2, N_RESIDUES)
    assert_allclose(told, np.stack([steps, steps]), atol=0.02)
    assert rows[0]["place"] == f"A 1 {SEQUENCE[0]}"
    assert rows[-1]["place"] == f"A 360 {SEQUENCE[-1]}"
    structures = [gemmi.read_structure(str(out / f"explain_{i}.cif"))[0]["A"] for i in (1, 2)]
    shares = np.square(steps) / np.square(steps).sum()
    for chain in structures:
        factors = [residue[0].b_iso for residue in chain]
        assert_allclose(factors, 100 * shares, atol=0.05)
    ends = [np.array([r[0].pos.tolist() for r in chain])[:HINGE] for chain in structures]
    assert_allclose(ends[0], ends[1], atol=0.02)
    with (out / "explain_samples.csv").open() as file:
        samples = [row for row in csv.DictReader(file) if row["samples"] == "surface"]
    first = [row for row in samples if row["name"].endswith("one.pdb#chain A")]
    places = np.array([[float(row[axis]) for axis in "xyz"] for row in first])
    paint = np.array([float(row["share_by_place"]) for row in first])
    is_turned = places[:, 0] > coil()[HINGE, 0]
    assert paint[is_turned].sum() > 0.95 * paint.sum() > 0


@pytest.mark.parametrize(
    ("one", "other", "pairs"),
    [
        ("ABCDEF", "ABCDEF", [(i, i) for i in range(6)]),
        ("ABCDEFGH", "CDEFGH", [(i + 2, i) for i in range(6)]),
        ("ABCDEFGH", "ABCDXXEFGH", [(i, i + 2 * (i > 3)) for i in range(8)]),
    ],
)
def test_sequences_are_aligned(one, other, pairs):
    assert aligned(tuple(one), tuple(other)).tolist() == [list(pair) for pair in pairs]


def test_other_sequences_and_other_files_do_not_correspond(tmp_path):
    names = np.random.default_rng(1).permutation(SEQUENCE).tolist()
    bodies = [
        BodyRef(write(tmp_path / "one.pdb", coil(), SEQUENCE), "chain A"),
        BodyRef(write(tmp_path / "two.pdb", coil(), names), "chain A"),
        BodyRef(tmp_path / "ball.off"),
    ]
    assert correspondence(bodies[0], bodies[1]) is None
    assert correspondence(bodies[0], bodies[2]) is None
    assert correspondence(bodies[0], bodies[0]) is not None

"""Frames of a simulation become files that keep charges, and a map that follows the movement."""

import csv

import numpy as np
import pytest
from numpy.testing import assert_allclose

from commands import error_of, run
from igps.fields.molecules.structures import read_molecule
from igps.fields.molecules.trajectories import write_frames

pytest.importorskip("gemmi")
MDAnalysis = pytest.importorskip("MDAnalysis")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
ANGLES = np.radians([60, 80, 100, 120, 140])
N_ARM = 12


def hinges():
    """Two rods of carbon atoms, (frames, atoms, 3), and a hydrogen beside the last atom of each."""
    steps = 1.5 * np.arange(1, N_ARM + 1)[:, None]
    frames = []
    for angle in ANGLES:
        arms = np.r_[steps * [1, 0, 0], steps * [np.cos(angle), np.sin(angle), 0]]
        beside = arms[[N_ARM - 1, -1]] + [0.0, 0.0, 1.0]
        frames.append(np.r_[arms, beside])
    return np.array(frames)


@pytest.fixture
def files(tmp_path):
    """A topology with charges as PQR, and the frames as DCD."""
    frames = hinges()
    names = [f"C{i}" for i in range(1, 2 * N_ARM + 1)] + ["H1", "H2"]
    charges = [
        *np.linspace(-0.5, 0.4, 2 * N_ARM),
        0.25,
        -0.15,
    ]
    text = ""
    for i, (x, y, z) in enumerate(frames[0]):
        text += f"ATOM {i + 1} {names[i]} ALA A 1 {x:.3f} {y:.3f} {z:.3f} {charges[i]:.4f} 1.0\n"
    topology = tmp_path / "rods.pqr"
    topology.write_text(text)
    universe = MDAnalysis.Universe(str(topology))
    trajectory = tmp_path / "rods.dcd"
    with MDAnalysis.Writer(str(trajectory), len(names)) as writer:
        for positions in frames:
            universe.atoms.positions = positions
            writer.write(universe.atoms)
    return topology, trajectory


def test_each_frame_keeps_places_charges_and_residues(files, tmp_path):
    topology, trajectory = files
    written = write_frames(topology, [trajectory], tmp_path / "frames", "all", 2)
    assert [number for _, number, _ in written] == [0, 2, 4]
    charges = np.linspace(-0.5, 0.4, 2 * N_ARM)
    charges[[N_ARM - 1, -1]] += [0.25, -0.15]
    for path, number, _ in written:
        (molecule,) = read_molecule(path, "models")
        assert_allclose(molecule.positions, hinges()[number, : 2 * N_ARM], atol=1e-3)
        assert_allclose(molecule.charges, charges, atol=1e-4)
        assert_allclose(molecule.radii, 1.7)
        assert molecule.residue_labels == ("A 1",)


def test_the_map_follows_an_opening_hinge(files, tmp_path):
    out = tmp_path / "out"
    small = ["--signature.resolution", "10", "--signature.max_vertices", "500"]
    fast = [*small, "--n_workers", 1, "--cache_dir", tmp_path / "cache", "--descriptor", "d2"]
    run("trajectory", *files, "--select", "all", "--out", out, *fast)
    with (out / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == [0, 1, 2, 3, 4]
    away = [float(row["distance_to_first"]) for row in rows]
    assert away == sorted(away)
    assert away[0] == 0
    assert (out / "trajectory.png").is_file()


def test_what_cannot_be_read_is_told(files, tmp_path, capsys):
    start = ["trajectory", *files, "--out", tmp_path / "out"]
    told = error_of(capsys, *start, "--select", "protein and name XX")
    assert "no atom is selected by 'protein and name XX'" in told
    told = error_of(capsys, *start, "--select", "nonsense words")
    assert "not readable with" in told
    told = error_of(capsys, "trajectory", files[0], "--out", tmp_path / "out")
    assert "expected a topology and a file of frames" in told

"""What residues around a point are like, against sums written out and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from igps.fields.molecules import residue_attributes as module
from igps.fields.molecules.molecule import Molecule
from igps.fields.molecules.residue_attributes import (
    RESIDUE_ATTRIBUTES,
    RESIDUE_KINDS,
    residue_attribute,
    residue_means,
    screened_potential,
)
from igps.fields.molecules.residues import HYDROPATHY
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig, compute_signature

CHARGES = {"ASP": -1.0, "GLU": -1.0, "LYS": 1.0, "ARG": 1.0, "HIS": 0.1}


def peptide(*names, seed=0):
    """Residues of one ball each, with its charge."""
    n = len(names)
    at = 6 * np.random.default_rng(seed).normal(size=(n, 3))
    charges = np.array([CHARGES.get(name, 0.0) for name in names])
    numbers = np.arange(n)
    b_factors = numbers.astype(float)
    return Molecule(
        "peptide",
        at,
        np.full(n, 2.0),
        charges,
        numbers,
        names,
        at,
        b_factors,
    )


def points(n=7, seed=1):
    return 6 * np.random.default_rng(seed).normal(size=(n, 3))


def mean_written_out(molecule, point, values):
    total = weights = 0.0
    for at, value in zip(molecule.residue_positions, values, strict=True):
        weight = math.exp(-(math.dist(point, at) ** 2) / (2 * 4.0**2))
        total += weight * value
        weights += weight
    return total / weights


def means_written_out(molecule, values):
    return [mean_written_out(molecule, point, values) for point in points()]


@pytest.mark.parametrize(
    ("name", "of_residue"),
    [
        ("charge", lambda name: CHARGES.get(name, 0.0)),
        ("hydropathy", HYDROPATHY.__getitem__),
        ("donors", lambda name: {"ARG": 3, "LYS": 1, "HIS": 1, "TRP": 1}.get(name, 0)),
        ("acceptors", lambda name: {"ASP": 2, "GLU": 2, "HIS": 1}.get(name, 0)),
    ],
)
def test_an_attribute_is_a_gaussian_mean_over_residues(name, of_residue):
    names = ("ASP", "LYS", "ALA", "TRP", "HIS", "GLU", "ARG", "ILE")
    molecule = peptide(*names)
    found = residue_attribute(molecule, points(), name)
    wanted = means_written_out(molecule, [of_residue(one) for one in names])
    assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)


def test_b_factors_are_the_molecules_own():
    molecule = peptide("ALA", "GLY", "SER")
    wanted = means_written_out(molecule, [0.0, 1.0, 2.0])
    assert_allclose(residue_attribute(molecule, points(), "b_factor"), wanted, rtol=1e-9)


def test_shares_of_kinds_sum_to_one_and_follow_the_names():
    molecule = peptide("ALA", "DT", "U", "ZN", "DG")
    shares = residue_attribute(molecule, points(), "residue_shares")
    assert_allclose(shares.sum(axis=1), 1)
    weight = means_written_out(molecule, [0, 1, 1, 0, 0])
    assert_allclose(shares[:, RESIDUE_KINDS.index("U")], weight)
    used = {RESIDUE_KINDS[i] for i in np.flatnonzero(shares.max(axis=0))}
    assert used == {"ALA", "U", "G", "other"}


def test_what_is_not_known_does_not_count_and_is_never_made_up():
    molecule = peptide("ALA", "QQQ", "ILE")
    known = replace(
        molecule, residue_names=("ALA", "ILE"), residue_positions=molecule.positions[[0, 2]]
    )
    found = residue_attribute(molecule, points(), "hydropathy")
    expected = residue_attribute(known, points(), "hydropathy")
    assert_allclose(found, expected)
    assert np.isnan(residue_attribute(peptide("QQQ", "ZN"), points(), "hydropathy")).all()


def test_far_outside_the_nearest_residue_counts():
    molecule = peptide("ALA", "ILE", "LYS")
    far = 1e4 * np.eye(3)
    nearest = np.linalg.norm(far[:, None] - molecule.residue_positions, axis=2).argmin(axis=1)
    found = residue_attribute(molecule, far, "hydropathy")
    expected = [HYDROPATHY[molecule.residue_names[i]] for i in nearest]
    assert_allclose(found, expected, rtol=1e-6)


def test_the_potential_of_one_charge_is_that_of_debye_and_hueckel():
    at = np.zeros((1, 3))
    radius = np.array([1.5])
    charge = np.array([-2.0])
    ion = Molecule(
        "ion",
        at,
        radius,
        charge,
        np.zeros(1, int),
        ("X",),
        at,
        np.zeros(1),
    )
    distance = np.array([0.0, 1.0, 1.5, 4.0, 15.0])
    counted = np.maximum(distance, 1.5)
    found = screened_potential(
        ion,
        distance[:, None] * [[0.6, 0, 0.8]],
    )
    # e² / (4 π ε₀ ε k T) in Å, of water (ε = 78.4) at 298.15 K; 0.304 nm / √0.15 of salt of one valence.
    thermal = 4 * np.pi * 8.8541878128e-12 * 78.4 * 1.380649e-23 * 298.15
    bjerrum = 1.602176634e-19**2 / thermal * 1e10
    screened = np.exp(-counted * np.sqrt(0.15) / 3.04)
    assert_allclose(found, -2 * bjerrum * screened / counted, rtol=5e-3)


def test_potentials_add_up():
    molecule = peptide("ASP", "ALA", "LYS")
    expected = screened_potential(peptide("ASP", "ALA", "ALA"), points())
    expected += screened_potential(peptide("ALA", "ALA", "LYS"), points())
    assert_allclose(screened_potential(molecule, points()), expected)
    np.testing.assert_array_equal(screened_potential(peptide("ALA"), points()), 0)


def test_many_points_in_blocks_are_as_few_at_once(monkeypatch):
    molecule = peptide("ASP", "ALA", "LYS", "TRP")
    values = np.arange(8.0).reshape(4, 2)
    whole = residue_means(molecule, points(50), values), screened_potential(molecule, points(50))
    monkeypatch.setattr(module, "_BLOCK_SIZE", 12)
    assert_allclose(residue_means(molecule, points(50), values), whole[0])
    assert_allclose(screened_potential(molecule, points(50)), whole[1])


def test_each_attribute_is_known_by_its_name():
    molecule = peptide("ASP", "ALA", "LYS", "TRP")
    for name in RESIDUE_ATTRIBUTES:
        values = residue_attribute(molecule, points(), name)
        columns = {
            "residue_shares": (len(RESIDUE_KINDS),),
            "trace": (8,),
            "composition": (26,),
        }
        assert values.shape == (7, *columns.get(name, ()))
        assert np.isfinite(values).all()
    words = r"attributes: expected names among charge, .*, got 'colour'"
    with pytest.raises(ValueError, match=words):
        residue_attribute(molecule, points(), "colour")


def test_a_signature_gets_attributes_and_keeps_its_own():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=8)
    mesh = Mesh(ball.vertices, ball.faces)
    few = {"n_eigenpairs": 10, "n_surface_samples": 50, "min_samples": 100}
    signature = compute_signature(mesh, SignatureConfig(attributes=("surface_direction",), **few))
    molecule = peptide("ASP", "LYS")
    for samples in (signature.interior, signature.surface):
        charge = residue_attribute(molecule, samples.points, "charge")
        found = samples.with_attributes({"charge": charge}).attributes
        assert set(found) == {"surface_direction", "charge"}
        assert_allclose(found["charge"], charge, rtol=1e-5, atol=1e-6)
    assert set(signature.interior.attributes) == {"surface_direction"}

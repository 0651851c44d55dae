"""`molecular`: what it counts, what it compares, and that it finds a bent molecule again."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from igps.analysis.explanation import explain
from igps.data.collation import collate
from igps.descriptors import NAMES, descriptor
from igps.fields.molecules.molecular import Shares, molecular
from igps.fields.molecules.molecular_surface import molecular_surface
from igps.fields.molecules.molecule import Molecule
from igps.fields.molecules.residue_attributes import residue_attribute
from igps.fields.molecules.residues import CHARGED_ATOMS, VOLUMES, residue_ball
from igps.nn.axes import InteriorDistance
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square
from igps.signature.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=90, n_surface_samples=100, min_samples=300, resolution=16)
ROTATION = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]


def trace(seed, bend, n=60):
    """Balls of residues of a random sequence along a bent coil; the seed gives sequence and pitch."""
    names = tuple(np.random.default_rng(seed).choice(sorted(VOLUMES), n).tolist())
    t = np.arange(n)
    turn = (1.1 + 0.2 * seed) * t
    coil = np.stack([1.5 * t, 5 * np.cos(turn), 5 * np.sin(turn)], axis=1)
    if bend:
        radius = 1.5 * n / bend
        angle = coil[:, 0] * bend / (1.5 * n)
        away = radius + coil[:, 1]
        coil = np.stack([away * np.sin(angle), away * np.cos(angle), coil[:, 2]], axis=1)
    charges = np.array([sum(CHARGED_ATOMS.get(name, {}).values()) for name in names])
    radii = np.array([residue_ball(name) for name in names])
    return Molecule(f"{seed} {bend}", coil, radii, charges, t, names, coil, np.zeros(n))


def moved(molecule):
    positions = molecule.positions @ ROTATION.T + [10.0, -4.0, 3.0]
    return replace(molecule, positions=positions, residue_positions=positions)


def signature_of(molecule):
    surface = molecular_surface(molecule, spacing=1.0, max_vertices=1200)

    def added(samples):
        names = molecular().requirements.sources
        found = {name: residue_attribute(molecule, samples.points, name) for name in names}
        return samples.with_attributes(found)

    bare = compute_signature(surface, CONFIG)
    return replace(bare, interior=added(bare.interior), surface=added(bare.surface))


@cache
def signature(seed, bend):
    return signature_of(trace(seed, bend))


def described(*signatures):
    with torch.no_grad():
        return molecular().eval()(collate(signatures))


def test_pairs_are_counted_by_the_shares_of_both_samples():
    one = signature(0, 0.0)
    histogram = PairHistogram([Shares("residue_shares", 25), InteriorDistance(4)])
    found = histogram(collate([one]))[0].double().numpy()
    shares = one.interior.attributes["residue_shares"].astype(float)
    embedded = one.interior.eigenfunctions / np.sqrt(one.eigenvalues)
    distance = np.linalg.norm(embedded[:, None] - embedded, axis=2)
    # Each pair in the two bins whose centres 0.5, 1.5, 2.5, 3.5 surround its distance.
    place = np.clip(distance - 0.5, 0, 3)
    bins = np.maximum(1 - np.abs(place[..., None] - np.arange(4)), 0)
    bins[np.diag_indices(len(bins))] = 0
    ordered = np.einsum("pa,qb,pqk->abk", shares, shares, bins, optimize=True)
    ordered /= ordered.sum()
    a, b = np.triu_indices(25)
    wanted = np.where((a == b)[:, None], 1, 2) * ordered[a, b]
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_a_bent_molecule_is_nearest_to_itself():
    signatures = [signature(seed, bend) for seed in range(4) for bend in (0.0, 2.0)]
    found = described(*signatures)
    distances = chi_square(found, found).fill_diagonal_(np.inf)
    assert distances.argmin(dim=1).tolist() == [1, 0, 3, 2, 5, 4, 7, 6]


def test_motion_changes_little():
    here = described(signature(0, 0.0))
    there = described(signature_of(moved(trace(0, 0.0))))
    other = described(signature(1, 0.0))
    assert chi_square(here, there) < 0.2 * chi_square(here, other)


def test_it_has_a_name_but_is_not_for_any_body():
    assert descriptor("molecular").name == "molecular"
    assert "molecular" not in NAMES
    one = signature(0, 0.0)
    bare = replace(one, interior=replace(one.interior, attributes={}))
    words = "attributes: expected the interior samples to have 'trace'"
    with pytest.raises(ValueError, match=words):
        described(bare)


def test_shares_of_another_kind_are_named():
    histogram = PairHistogram([Shares("residue_shares", 7), InteriorDistance(4)])
    with pytest.raises(ValueError, match="expected 'residue_shares' with 7 shares for each sample"):
        histogram(collate([signature(0, 0.0)]))
    with pytest.raises(ValueError, match="expected finite shares"):
        Shares("residue_shares", 2).memberships(torch.tensor([[float("nan"), 1.0]]))


def test_an_explanation_names_four_parts_and_their_samples():
    found = described(signature(0, 0), signature(1, 0))
    pair = [signature(0, 0), signature(1, 0)]
    one, other = (collate([each]) for each in pair)
    told = explain(molecular(), one, other, weights=[np.ones(len(x.surface)) for x in pair])
    distance = float(molecular().distances(found[:1], found[1:]))
    assert told.distance == pytest.approx(distance, rel=1e-3)
    assert sum(told.parts.values()) == pytest.approx(told.distance, rel=1e-6)
    assert list(told.parts) == ["form", "fold", "composition", "charges"]
    shares = [one.sum() for of_body in told.samples for one in of_body.values()]
    assert sum(shares) == pytest.approx(told.distance)

"""`fold`: what it counts, that residues count once and kinds of residues do not, and places along chains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

import igps
from igps.analysis.explanation import explain
from igps.data.collation import collate
from igps.fields.molecules.fold import FoldHistogram, fold
from igps.fields.molecules.molecule import BETWEEN_CHAINS, Molecule, chain_places
from igps.fields.molecules.residue_attributes import residue_attribute
from igps.signature.signature import Samples, Signature, SignatureConfig, compute_signature

Floats = NDArray[np.float64]
BALL = compute_signature(
    trimesh.creation.icosphere(subdivisions=2),
    SignatureConfig(n_eigenpairs=5, resolution=10, min_samples=0, n_surface_samples=20),
)
N = len(BALL.interior.points)
TURNS = np.array([-0.75, -0.25, 0.25, 0.75])
SEPARATIONS = np.array([0, 1, 2, 3, 4, 5, 6.5, 9, 12.5, 17.5, 25, 37, 57, 89, 130])


def walk(seed: int, n: int = 150) -> Floats:
    """(n, 3) Å, a random chain with a step of 3.8 Å."""
    steps = default_rng(seed).normal([0.3, 0, 0], size=(n, 3))
    return np.cumsum(3.8 * steps / norm(steps, axis=1, keepdims=True), axis=0)


def advances_of(residues: Floats, reach: int) -> Floats:
    """(n, 3) Å for each residue, along a chain without gaps, over so many residues before and after."""
    rows = []
    for i in range(len(residues)):
        around = residues[max(i - reach, 0) : i + reach + 1]
        rows.append((around[-1] - around[0]) / (len(around) - 1))
    return np.array(rows)


def directions_of(residues: Floats) -> Floats:
    """(n, 3) unit vectors along a chain without gaps, over three residues before and after."""
    vectors = advances_of(residues, 3)
    return vectors / norm(vectors, axis=1, keepdims=True)


def rises_of(residues: Floats) -> Floats:
    """(n,) Å for each residue, from the second before to the second after."""
    return norm(advances_of(residues, 2), axis=1)


def signature(residues: Floats, places: Floats, nearest: NDArray[np.int64]) -> Signature:
    """Samples of a ball, each with a residue."""
    trace = np.column_stack([residues, directions_of(residues), rises_of(residues), places])[
        nearest
    ]
    return replace(BALL, interior=BALL.interior.with_attributes({"trace": trace}))


def hats(values: Floats, centres: Floats) -> Floats:
    """(..., C) shares of the two centres that surround each value."""
    return np.stack([np.interp(values, centres, one) for one in np.eye(len(centres))], axis=-1)


def test_every_residue_counts_once_in_the_row_of_its_separation() -> None:
    residues = walk(0)
    places = np.arange(150.0)
    places[80:] += 20  # a gap
    nearest = default_rng(1).integers(0, 150, N)
    nearest[:150] = np.arange(150)  # each at least once, some often
    found = fold()(collate([signature(residues, places, nearest)]))[0].double().numpy()
    i, j = np.triu_indices(150, 1)
    line = residues[j] - residues[i]
    distance = norm(line, axis=1)
    one, other = directions_of(residues)[[i, j]]
    twist = (np.cross(one, other) * line).sum(axis=1) / distance
    separation = hats(np.abs(places[i] - places[j]), SEPARATIONS)[:, 2:]
    axes = (
        hats(distance, np.arange(4, 40, 8)),
        hats((one * other).sum(axis=1), TURNS),
        hats(twist, TURNS),
    )
    earlier, later = hats(rises_of(residues), np.array([1.75, 3.0]))[[i, j]]
    wanted = np.einsum(
        "ps,py,pz,pd,pc,pt->syzdct", separation, earlier, later, *axes, optimize=True
    )
    n_pairs = wanted.sum(axis=(1, 2, 3, 4, 5))
    weights = n_pairs / (n_pairs + 2000) / (1 + SEPARATIONS[2:] / 20)
    weights /= weights.sum() * n_pairs
    assert_allclose(found, wanted * weights[:, None, None, None, None, None], atol=2e-6)


def test_short_chains_have_no_far_pairs_and_padding_changes_nothing() -> None:
    short = signature(walk(2, 20), np.arange(20.0), np.arange(N) % 20)
    long = signature(walk(3), np.arange(150.0), np.arange(N) % 150)
    kept = Samples(
        long.interior.points[:180],
        long.interior.eigenfunctions[:180],
        {"trace": long.interior.attributes["trace"][:180]},
    )
    fewer = replace(long, interior=kept)
    one, other = fold()(collate([short, fewer]))
    torch.testing.assert_close(one, fold()(collate([short]))[0])
    torch.testing.assert_close(other, fold()(collate([fewer]))[0])
    assert one.flatten(1).sum(dim=1)[-4:].tolist() == [0, 0, 0, 0]
    assert float(one.sum()) == pytest.approx(1)


def test_shares_of_samples_add_up_to_the_distance() -> None:
    pair = [signature(walk(seed), np.arange(150.0), np.arange(N) % 150) for seed in (4, 5)]
    one, other = (collate([item]) for item in pair)
    told = explain(fold(), one, other, weights=[np.ones(len(x.surface)) for x in pair])
    wanted = float(fold().distances(fold()(one), fold()(other)))
    assert told.distance == pytest.approx(wanted, rel=1e-4)
    assert told.parts == {"fold": pytest.approx(told.distance)}
    shares = [kind.sum() for body in told.samples for kind in body.values()]
    assert sum(shares) == pytest.approx(told.distance)


def test_residues_of_other_kinds_change_nothing() -> None:
    residues = walk(6, 30)
    points = residues + default_rng(7).normal(size=(30, 3))

    def traced(name: str, motion: Floats) -> Floats:
        at = residues @ motion
        none = np.zeros(30)
        names = (name,) * 30
        molecule = Molecule(
            "chain", at, none + 2, none, np.arange(30), names, at, none, places=np.arange(30.0)
        )
        return residue_attribute(molecule, points @ motion, "trace")

    turn = np.linalg.qr(default_rng(8).normal(size=(3, 3)))[0]
    one = traced("GLY", np.eye(3))
    other = traced("TRP", np.eye(3))
    turned = traced("GLY", turn)
    assert_array_equal(one, other)
    wanted = [one[:, :3] @ turn, one[:, 3:6] @ turn, one[:, 6:]]
    assert_allclose(turned, np.column_stack(wanted), atol=1e-9)
    nearest = one[:, 7].astype(int)
    assert_allclose(one[:, 3:6], directions_of(residues)[nearest], atol=1e-9)


def test_places_follow_bonds_then_numbers_then_distances() -> None:
    at = [0, 3.8, 7.6, 27.6, 31.4, 35.2, 0, 3.8]
    positions = np.column_stack([at, np.zeros(8), np.zeros(8)])
    # A new way of numbering at a bond; a gap of 9 residues; a number that is too small; a ligand; another chain
    numbers = np.array([1, 2, 1001, 1010, 1012, np.nan, 7, 8])
    chains = np.array(list("AAAAAABB"))
    found = chain_places(positions, numbers, chains)
    expected = [0, 1, 2, 11, 12, np.nan, 12 + BETWEEN_CHAINS, 13 + BETWEEN_CHAINS]
    assert_array_equal(found, expected)
    numbers[3] = 1002  # 20 Å apart: five steps at least must be missing, and 6 bridge them
    assert chain_places(positions, numbers, chains)[3] == 2 + 6
    assert np.isnan(chain_places(positions, np.full(8, np.nan), chains)).all()


def test_directions_do_not_cross_gaps() -> None:
    positions = np.array(
        [[0.0, 0, 0], [3.8, 0, 0], [20, 0, 0], [20, 3.8, 0], [20, 7.6, 0], [99, 0, 0]]
    )
    none = np.zeros(6)
    places = np.array([0.0, 1, 6, 7, 8, 1008])
    molecule = Molecule(
        "gaps", positions, none, none, np.arange(6), ("ALA",) * 6, positions, none, places=places
    )
    found = residue_attribute(molecule, positions, "trace")[:, 3:6]
    x = [1, 0, 0]
    y = [0, 1, 0]
    assert_allclose(found, [x, x, y, y, y, [0, 0, 0]], atol=1e-12)


def test_it_is_found_by_name_and_asks_for_a_trace() -> None:
    assert igps.descriptor("fold").n_features == 13 * 4 * 5 * 16
    with pytest.raises(ValueError, match="needs signatures with trace"):
        fold()(collate([BALL]))
    assert FoldHistogram().shape == (13, 2, 2, 5, 4, 4)

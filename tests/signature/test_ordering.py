"""The order of a body's points, and what is chosen along it: the same body, the same choice."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from conftest import as_mesh
from igps.data.batch import SampleBatch
from igps.data.collation import collate
from igps.mesh.mesh import Mesh
from igps.nn.axes import EuclideanDistance, InteriorDistance, Potential
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square
from igps.signature.ordering import (
    in_canonical_order,
    nearest_spacing,
    ordering_keys,
    systematic_sample,
    vertex_area_shares,
)
from igps.signature.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=40, resolution=16, min_samples=0, n_surface_samples=400)


def renumbered(mesh, seed=5):
    generator = default_rng(seed)
    order = generator.permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces][generator.permutation(len(mesh.faces))]
    shifts = generator.integers(0, 3, len(faces))
    corners = (np.arange(3) - shifts[:, None]) % 3
    return Mesh(
        mesh.vertices[order],
        np.take_along_axis(faces, corners, axis=1),
    )


def spectrum_of(n_points):
    generator = default_rng(2)
    return generator.normal(size=(n_points, 30)), np.sort(generator.uniform(5, 300, 30))


def test_places_go_with_the_points_and_leave_signs_and_bases_alone():
    functions, eigenvalues = spectrum_of(500)
    eigenvalues[7:10] = eigenvalues[7]  # a multiplet, of which any basis may come
    expected = ordering_keys(functions, eigenvalues, 1.0)
    order = default_rng(0).permutation(500)
    assert_allclose(ordering_keys(functions[order], eigenvalues, 1.0), expected[order], rtol=1e-12)
    signs = np.where(np.arange(30) % 2, -1, 1)
    assert_allclose(ordering_keys(functions * signs, eigenvalues, 1.0), expected)
    turn = np.linalg.qr(default_rng(1).normal(size=(3, 3)))[0]
    turned = functions.copy()
    turned[:, 7:10] = functions[:, 7:10] @ turn
    assert_allclose(ordering_keys(turned, eigenvalues, 1.0), expected, rtol=1e-12)
    # Three times as large
    assert_allclose(ordering_keys(functions / 3, eigenvalues / 9, 9.0), expected, rtol=1e-12)


def test_points_of_one_potential_have_different_places():
    """Mirror images in a symmetric body get distinct keys, which do not depend on their order."""
    functions, eigenvalues = spectrum_of(300)
    mirror = np.where(np.arange(30) % 3 == 0, -1.0, 1.0)
    both = np.concatenate([functions, functions * mirror])
    found = ordering_keys(both, eigenvalues, 1.0)
    assert np.diff(np.sort(found)).min() > 1e-9
    exchanged = ordering_keys(
        np.concatenate([functions * mirror, functions]),
        eigenvalues,
        1.0,
    )
    assert_allclose(np.sort(exchanged), np.sort(found), rtol=1e-9)


def test_spacings_and_area_shares_by_hand():
    line = np.zeros((9, 3))
    line[:, 0] = np.arange(9)
    expected = np.abs(line[:, 0] - line[:, :1]).mean(axis=1)  # all are nearest
    assert_allclose(nearest_spacing(line), expected / expected.mean())
    areas = np.array([1.0, 2.0, 4.0])
    shares = vertex_area_shares(
        np.array([[0, 1, 2], [0, 2, 3], [1, 2, 3]]),
        areas,
    )
    assert_allclose(shares * 21 / 4, [3, 5, 7, 6])


def test_systematic_samples_follow_the_sizes():
    sizes = default_rng(0).random(50) ** 3
    sizes[[0, 20, 49]] = 0
    ends = np.cumsum(sizes)
    drawn = systematic_sample(sizes, 400, default_rng(1))
    assert (np.diff(drawn) >= 0).all()
    assert not set(drawn) & {0, 20, 49}
    counts = np.bincount(drawn, minlength=50)
    # A plain draw would be off by up to twenty.
    assert np.abs(counts - 400 * sizes / ends[-1]).max() < 2
    many = np.zeros(50)
    for seed in range(3000):
        few = systematic_sample(sizes, 7, default_rng(seed))
        many += np.bincount(few, minlength=50)
    assert_allclose(many / 21000, sizes / ends[-1], atol=0.004)


def bodies():
    """One without symmetry, and one that is its own mirror image, with all its samples."""
    made = {}
    for name, lean in (("blob", 0.2), ("mirrored", 0.0)):
        body = trimesh.creation.icosphere(subdivisions=3)
        x, y, z = body.vertices.T
        radius = 1 + lean * x + 0.2 * np.sin(2.3 * y + 0.4) + 0.3 * z * x**2
        body.vertices *= radius[:, None] * [1.0, 0.8, 1.3]
        made[name] = as_mesh(body)
    mirrored = made["mirrored"].vertices
    assert cKDTree(mirrored).query(mirrored * [-1, 1, 1])[0].max() < 1e-12
    return made


MOVES = {
    "axes": lambda mesh: Mesh(
        mesh.vertices[:, [1, 2, 0]],
        mesh.faces,
    ),
    "quarter turn": lambda mesh: Mesh(
        mesh.vertices @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]), mesh.faces
    ),
    "mirror image": lambda mesh: Mesh(
        mesh.vertices * [1, -1, 1],
        mesh.faces[:, ::-1],
    ),
    "numbering": renumbered,
}


@pytest.fixture(scope="module")
def histograms():
    """Of half of the samples, inside and on the surface; with Euclidean distances, which no symmetry of U explains."""
    axes = [Potential(3), InteriorDistance(16), EuclideanDistance(12)]
    return [
        PairHistogram(axes, samples=kind, n_samples=200).eval() for kind in ("interior", "surface")
    ]


@pytest.fixture(scope="module")
def still():
    return {name: collate([compute_signature(mesh, CONFIG)]) for name, mesh in bodies().items()}


@pytest.mark.parametrize("move", MOVES)
def test_histograms_of_subsets_do_not_move(move, histograms, still):
    for batch in still.values():
        assert batch.interior.mask.sum() > 300  # the subsets are some
    moved = {}
    for name, mesh in bodies().items():
        moved[name] = collate(
            [
                compute_signature(
                    MOVES[move](mesh),
                    CONFIG,
                )
            ]
        )
    for histogram in histograms:
        before = torch.cat([histogram(batch) for batch in still.values()])
        after = torch.cat([histogram(batch) for batch in moved.values()])
        between = chi_square(before, before)[0, 1]
        assert bool((chi_square(before, after).diagonal() < 1e-4 * between).all())


def test_numbering_leaves_the_surface_samples_in_place(blob):
    points, others = (
        compute_signature(mesh, CONFIG).surface.points for mesh in (blob, renumbered(blob))
    )
    distance, _ = cKDTree(others).query(points)
    assert np.quantile(distance, 0.99) < 1e-5
    drawn_anew = compute_signature(blob, replace(CONFIG, seed=1)).surface.points
    distance, _ = cKDTree(drawn_anew).query(points)
    assert np.quantile(distance, 0.5) > 1e-3


def test_subsets_take_equal_steps():
    lengths = (10, 7, 3)
    mask = torch.arange(10) < torch.tensor(lengths)[:, None]
    places = torch.arange(10.0).expand(3, -1)
    points = places[..., None].expand(-1, -1, 3)
    batch = SampleBatch(points, places[..., None], mask, {"depth": places})
    part = batch.subset(4, seed=0)
    found = part.mask.sum(dim=1).tolist()
    assert found == [4, 4, 3]
    for row, length in enumerate(lengths):
        chosen = part.attributes["depth"][row, part.mask[row]]
        if length <= 4:
            assert chosen.tolist() == list(range(length))
        else:
            assert ((chosen.diff() - length / 4).abs() < 1).all()
            assert chosen[0] < length / 4
            one = slice(row, row + 1)
            alone = batch.map(lambda values, one=one, length=length: values[one, :length])
            assert alone.subset(4, seed=0).points[0, :, 0].tolist() == chosen.tolist()
    drawn = [batch.subset(4, seed=seed).attributes["depth"][0] for seed in range(20)]
    starts = {tuple(values.tolist()) for values in drawn}
    assert len(starts) > 1
    assert set().union(*starts) == set(range(10))  # none is left out by every start


def test_the_order_of_form_takes_out_every_numbering(blob):
    expected = in_canonical_order(blob)
    for seed in range(3):
        found = in_canonical_order(renumbered(blob, seed))
        assert_array_equal(found.vertices, expected.vertices)
        assert_array_equal(found.faces, expected.faces)


def test_the_order_of_form_keeps_the_surface(blob):
    found = in_canonical_order(blob)

    def corners(mesh):
        """Every face by its corners' places, from each of the three on, so that orientation counts."""
        places = mesh.vertices[mesh.faces]
        return {np.roll(face, k, axis=0).tobytes() for face in places for k in range(3)}

    assert corners(found) == corners(blob)
    assert len(found.faces) == len(blob.faces)


def test_the_order_of_form_does_not_depend_on_place_and_scale(blob):
    turn = Rotation.from_rotvec([0.3, 1.1, -0.7]).as_matrix()
    moved = replace(
        blob,
        vertices=2.5 * blob.vertices @ turn.T + [3, -1, 2],
    )
    expected = in_canonical_order(blob)
    found = in_canonical_order(moved)
    assert_array_equal(found.faces, expected.faces)
    assert_allclose(
        found.vertices,
        2.5 * expected.vertices @ turn.T + [3, -1, 2],
        atol=1e-12,
    )

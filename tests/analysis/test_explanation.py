"""The shares of an explanation add up to the distance, and lie where the bodies differ."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.linalg import norm
from sklearn.metrics import roc_auc_score

from conftest import as_mesh
from igps.analysis.explanation import (
    explain,
    share_density,
    unit_shares,
)
from igps.data.collation import collate
from igps.descriptors import descriptor
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads.closed_form import WhitenedHead
from igps.nn.histograms import PairHistogram
from igps.signature.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=250, resolution=12, min_samples=0, n_surface_samples=300)


def signed(bump, name):
    """Of an egg with a bump at its side."""
    body = trimesh.creation.icosphere(subdivisions=4)
    swell = 1 + bump * np.exp(-12 * ((body.vertices - [1, 0, 0]) ** 2).sum(axis=1))
    body.vertices *= np.array([0.6, 0.7, 1.2]) * swell[:, None]
    config = descriptor(name).requirements.apply_to(CONFIG)
    return compute_signature(as_mesh(body), config)


@pytest.fixture(scope="module")
def signatures():
    return [signed(bump, "rich") for bump in (0.0, 1.2)]


@pytest.fixture(scope="module")
def batches(signatures):
    return [collate([one]) for one in signatures]


def described_by(name):
    if name != "whitened":
        return descriptor(name)
    histograms = HistogramDescriptor([PairHistogram(), PairHistogram(["interior_distance"])])
    cells = torch.rand(12, 704).pow(4)
    return EmbeddedDescriptor(
        histograms,
        WhitenedHead().fit(
            cells,
            torch.arange(12) // 3,
            histograms.part_cells,
        ),
    )


@pytest.mark.parametrize(
    "name",
    [
        "interior",
        "rich",
        "pretrained",
        "whitened",
        "interior+size",
        "pretrained+side+size",
    ],
)
def test_all_shares_add_up_to_the_distance(name, batches):
    chosen = described_by(name)
    with torch.no_grad():
        distance = float(chosen.distances(*(chosen(batch) for batch in batches)))
    found = explain(chosen, *batches)
    assert distance > 1e-5
    assert found.distance == pytest.approx(distance, rel=1e-3)  # there in single precision
    of_samples = sum(values.sum() for of_body in found.samples for values in of_body.values())
    assert of_samples == pytest.approx(found.distance, rel=1e-6)
    assert sum(found.parts.values()) == pytest.approx(found.distance, rel=1e-6)
    by_place = np.concatenate([np.concatenate([*one.values()]) for one in found.places])
    assert by_place.sum() == pytest.approx(found.distance, rel=1e-6)
    assert by_place.min() >= 0
    assert "%" in found.summary()


def test_of_bodies_that_differ_in_size_alone_all_is_size(signatures):
    """Twice as large: |Δ log area| + |Δ log volume| is 5 log 2, and every place has the same of it."""
    one = signatures[0]
    larger = replace(
        one,
        area=4 * one.area,
        volume=8 * one.volume,
        eigenvalues=one.eigenvalues / 4,
        interior=replace(
            one.interior,
            points=2 * one.interior.points,
            eigenfunctions=one.interior.eigenfunctions / 2,
        ),
        surface=replace(
            one.surface,
            points=2 * one.surface.points,
            eigenfunctions=one.surface.eigenfunctions / 2,
        ),
    )
    found = explain(
        descriptor("interior+size"),
        *(collate([each]) for each in (one, larger)),
    )
    apart = 5 * np.log(2)
    nearness = 0.017 / 4  # a quarter of the scale of `interior`
    assert found.distance == pytest.approx(nearness * apart / 0.5, rel=1e-5)
    assert found.parts["size"] == pytest.approx(found.distance, rel=1e-5)
    for shares in (values for of_body in found.samples for values in of_body.values()):
        np.testing.assert_allclose(shares, found.distance / 4 / len(shares), rtol=1e-3)


def test_shares_of_chi_square_are_those_of_a_loop_over_all_pairs(batches):
    """Interior distances alone: each pair falls into two bins, and gives each of its ends half of what it counts."""
    chosen = HistogramDescriptor(PairHistogram(["interior_distance"]))
    found = explain(chosen, *batches)
    cells = [chosen(batch).flatten().double().numpy() for batch in batches]
    units = np.where(
        sum(cells) > 0,
        (cells[0] - cells[1]) / np.maximum(sum(cells), 1e-300) / 2,
        0,
    )
    for batch, sign, shares in zip(
        batches,
        (1, -1),
        found.samples,
        strict=True,
    ):
        points = (batch.interior.eigenfunctions[0] / batch.eigenvalues[0].sqrt()).double()
        away = torch.cdist(points, points).numpy()
        place = np.clip(away / (4.0 / 64) - 0.5, 0, 63)
        counts = np.interp(place, np.arange(64), sign * units)
        np.fill_diagonal(counts, 0)
        n = len(points)
        expected = counts.sum(axis=1) / (n * (n - 1))
        np.testing.assert_allclose(shares["interior"], expected, atol=2e-8)
        assert not shares["surface"].any()


def test_shares_of_a_squared_euclidean_distance_are_products(batches):
    class Squared(HistogramDescriptor):
        def distances(self, queries, gallery):
            n_cells = queries.flatten(1).shape[1]
            matrix = torch.linspace(-1, 2, 3 * n_cells, dtype=queries.dtype).view(-1, 3)
            own, other = (rows.flatten(1).sqrt() @ matrix for rows in (queries, gallery))
            return torch.cdist(own, other) ** 2

    one, other = torch.tensor(
        [[0.1, 0.4, 0.5, 0.0], [0.3, 0.0, 0.2, 0.5]],
        dtype=torch.float64,
    )
    units, distance = unit_shares(Squared(PairHistogram()), one, other)
    matrix = torch.linspace(-1, 2, 12, dtype=torch.float64).view(4, 3)
    apart = one.sqrt() - other.sqrt()
    shares = apart * (matrix @ matrix.T @ apart)
    torch.testing.assert_close(units * (one - other), shares)
    assert distance == pytest.approx(float(shares.sum()))


@pytest.mark.parametrize("name", ["pretrained", "whitened"])
def test_shares_behind_a_head_are_those_of_small_steps(name, batches):
    """Along the line on which the roots come apart, the distance grows step by step: in one cell alone, by differences.

    The cells with the largest shares, and others; and the one that differs most, whose share may be 0.
    """
    chosen = described_by(name).double().eval()
    assert isinstance(chosen, EmbeddedDescriptor)
    cells = torch.stack([chosen.descriptor(batch).detach().flatten().double() for batch in batches])
    units, _ = unit_shares(chosen, *cells)
    roots = cells.sqrt()
    middle = roots.mean(dim=0)
    half = (roots[0] - roots[1]) / 2
    shares = units * (cells[0] - cells[1])
    order = shares.abs().argsort(descending=True)
    assert (shares[order[:51]] != 0).all()
    for cell in [
        *order[[0, 1, 2, 5, 20, 50]].tolist(),
        int(half.abs().argmax()),
    ]:
        step = torch.zeros_like(half)
        step[cell] = 1e-4 * half[cell]
        share = 0.0
        for along in (torch.arange(100) + 0.5) / 100:
            ends = torch.stack([middle + along * half, middle - along * half])
            moved = torch.stack(
                [
                    ends[0] + step,
                    ends[1] - step,
                    ends[0] - step,
                    ends[1] + step,
                ]
            )
            with torch.no_grad():
                vectors = chosen.head(moved.square())
                apart = chosen.distances(vectors[[0, 2]], vectors[[1, 3]]).diagonal()
            share += float(apart[0] - apart[1]) / 2e-4 / 100
        assert float(shares[cell]) == pytest.approx(share, rel=0.02, abs=1e-8)


def test_the_share_of_a_sample_is_the_derivative_by_its_weight(batches):
    """Of one histogram: the derivative by the weight of a sample, over the two samples of a pair, by differences."""
    chosen = descriptor("interior")
    found = explain(chosen, *batches)
    units, _ = unit_shares(
        chosen, *(chosen(batch).detach().flatten().double() for batch in batches)
    )
    samples = batches[0].interior
    for i in (0, 17, len(samples.points[0]) - 1):
        changed = []
        for weight in (0.5, 1.5):
            weights = torch.ones_like(samples.points[..., 0])
            weights[0, i] = weight
            heavier = replace(samples, attributes={**samples.attributes, "weight": weights})
            changed.append(chosen(replace(batches[0], interior=heavier)).double().flatten() @ units)
        assert found.samples[0]["interior"][i] == pytest.approx(
            float(changed[1] - changed[0]) / 2, rel=0.02
        )


@pytest.mark.parametrize("height", [0.08, -0.08])
def test_a_small_bump_or_dent_is_painted_in_another_pose(height):
    """An egg, bent, with a bump that is a fiftieth of the root of its area high, or such a dent."""
    straight = trimesh.creation.icosphere(subdivisions=4)
    straight.vertices *= [0.5, 0.65, 2.0]
    bent = straight.copy()
    bump = straight.vertices[np.abs(straight.vertices - [0.45, 0, 0.8]).sum(axis=1).argmin()]
    away = norm(straight.vertices - bump, axis=1)
    swell = height * np.clip(1 - (away / 0.4) ** 2, 0, 1) ** 2
    bent.vertices += swell[:, None] * straight.vertex_normals
    angle = bent.vertices[:, 2] / 4
    along = 4 + bent.vertices[:, 0]
    turned = [
        along * np.cos(angle),
        bent.vertices[:, 1],
        along * np.sin(angle),
    ]
    bent.vertices = np.stack(turned, axis=1)
    config = descriptor("rich").requirements.apply_to(replace(CONFIG, n_surface_samples=800))
    pair = [compute_signature(as_mesh(one), config) for one in (straight, bent)]
    found = explain(
        descriptor("interior"),
        *(collate([one]) for one in pair),
    )
    points = pair[1].surface.points
    true = (
        norm(
            points - bent.vertices[away.argmin()],
            axis=1,
        )
        < 0.4
    )
    places = {"interior": pair[1].interior.points, "surface": points}
    assert found.places is not None
    assert (
        roc_auc_score(
            true,
            share_density(found.places[1], places, points),
        )
        > 0.9
    )


def test_equal_bodies_have_nothing_to_share(batches):
    found = explain(descriptor("pretrained"), batches[0], batches[0])
    assert found.distance == 0
    for of_body in found.samples:
        for values in of_body.values():
            assert not values.any()
    assert found.summary() == "identical"


def test_what_knows_no_samples_is_refused(batches):
    with pytest.raises(ValueError, match=r"expected histograms of samples .*, got 'd2'"):
        explain(descriptor("d2"), *batches)

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.autograd import grad
from torch.nn.functional import normalize
from torch.testing import assert_close

from batches import N_POINTS, batch_of, embedded, two_bodies
from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements
from igps.nn.axes import (
    Attribute,
    EmbeddedPairCosines,
    EuclideanDistance,
    InteriorDistance,
    PairAxis,
    PairCosines,
    PairValues,
    Potential,
)
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms import PairHistogram, pair_histogram
from loops import (
    cosines,
    distances,
    equal_bins,
    hard_classes,
    pair_histogram_by_loops,
    product,
    soft_classes,
)

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]
FINE = SpectralEmbedding(n_eigenpairs=6)
COARSE = SpectralEmbedding(n_eigenpairs=2)
DEPTH = (0.2, 0.5, 0.9)
COSINES = [-2 / 3, 0.0, 2 / 3]


@pytest.fixture(scope="module")
def batch():
    return two_bodies()


@dataclass(frozen=True)
class Look:
    """What the axes measure of one shape, by their definitions."""

    batch: SignatureBatch
    i: int
    kind: str = "interior"

    def embedding(self, n=6, kind=None):
        return embedded(self.batch, self.i, kind or self.kind, n)

    def positions(self):
        samples = getattr(self.batch, self.kind)
        points = samples.points[self.i, samples.mask[self.i]].double()
        return points / self.batch.area[self.i].sqrt()

    def attribute(self, name):
        samples = getattr(self.batch, self.kind)
        return samples.attributes[name][self.i, samples.mask[self.i]]

    def interior(self, n_bins, reach=4.0, n=6):
        return distances(self.embedding(n)), equal_bins(n_bins, reach)

    def euclidean(self, n_bins, reach=1.0):
        return distances(self.positions()), equal_bins(n_bins, reach)

    def in_space(self):
        features = cosines(self.positions(), self.attribute("surface_direction"))
        return [(values, COSINES) for values in features]

    def in_embedding(self):
        own = self.embedding()
        sign = 1 if self.kind == "interior" else -1
        other = self.embedding(kind="surface" if self.kind == "interior" else "interior")
        directions = []
        for point in own:
            nearest = (other - point).norm(dim=1).argsort()[:8]
            mean = other[nearest].mean(dim=0)
            directions.append(sign * normalize(mean - point, dim=0))
        features = cosines(own, torch.stack(directions))
        return [(values, COSINES) for values in features]

    def potential(self, n_classes, soft=False):
        potential = self.embedding().norm(dim=1)
        if soft:
            return soft_classes(potential, equal_bins(n_classes, 1.5))
        return hard_classes(potential, [k * 1.5 / n_classes for k in range(1, n_classes)])

    def depth(self, soft=False):
        depth = self.attribute("depth")
        if soft:
            return soft_classes(depth, DEPTH)
        return hard_classes(depth, [0.35, 0.7])


CASES = {
    "Euclidean alone": (
        lambda: [EuclideanDistance(5)],
        lambda look: [],
        lambda look: [look.euclidean(5)],
    ),
    "depth × soft potential × interior": (
        lambda: [Attribute("depth", DEPTH), Potential(2, soft=True), InteriorDistance(5)],
        lambda look: [look.depth(), look.potential(2, soft=True)],
        lambda look: [look.interior(5)],
    ),
    "soft depth × soft potential × Euclidean": (
        lambda: [
            Attribute("depth", DEPTH, soft=True),
            Potential(2, soft=True),
            EuclideanDistance(5),
        ],
        lambda look: [
            look.depth(soft=True),
            look.potential(2, soft=True),
        ],
        lambda look: [look.euclidean(5)],
    ),
    "soft potential × interior × interior × Euclidean": (
        lambda: [
            Potential(2, soft=True),
            InteriorDistance(4),
            InteriorDistance(3, embedding=COARSE),
            EuclideanDistance(2),
        ],
        lambda look: [look.potential(2, soft=True)],
        lambda look: [
            look.interior(4),
            look.interior(3, n=2),
            look.euclidean(2),
        ],
    ),
    "soft potential × depth × interior × cosines in the embedding": (
        lambda: [
            Potential(2, soft=True),
            Attribute("depth", DEPTH),
            InteriorDistance(2),
            EmbeddedPairCosines(3),
        ],
        lambda look: [look.potential(2, soft=True), look.depth()],
        lambda look: [look.interior(2), *look.in_embedding()],
    ),
    "cosines × interior, the other way round": (
        lambda: [PairCosines(3), InteriorDistance(4), Potential(2)],
        lambda look: [look.potential(2)],
        lambda look: [look.interior(4), *look.in_space()],
    ),
}


@pytest.mark.parametrize("kind", ["interior", "surface"])
@pytest.mark.parametrize("name", CASES)
def test_product_of_axes_equals_brute_force_loop(batch, name, kind):
    make, classes, pairs = CASES[name]
    histogram = PairHistogram(make(), FINE, kind)
    result = histogram(batch)
    assert result.shape == (2, *histogram.shape)
    assert result[0].numel() == histogram.n_cells
    assert (result >= 0).all()
    for i, n in enumerate(N_POINTS):
        look = Look(batch, i, kind)
        memberships = product(*(classes(look) or [np.ones((n, 1))]))
        assert_allclose(result[i], pair_histogram_by_loops(memberships, pairs(look)), atol=1e-6)


def learn(*modules):
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for module in modules:
            for parameter in module.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)


@pytest.mark.parametrize("with_cosines", [False, True])
def test_learned_axes_equal_brute_force_loop(batch, with_cosines):
    """The centres are wherever the parameters take them."""
    potential = Potential(2, soft=True, learnable=True)
    depth = Attribute("depth", DEPTH, soft=True, learnable=True)
    interior = InteriorDistance(4, learnable=True)
    euclidean = EuclideanDistance(3, learnable=True)
    angles = PairCosines(3, learnable=True)
    axes = (
        [potential, depth, interior, angles]
        if with_cosines
        else [potential, depth, interior, euclidean]
    )
    learn(*axes)
    result = PairHistogram(axes, FINE)(batch)
    assert result.requires_grad
    for i in range(2):
        look = Look(batch, i)
        memberships = product(
            soft_classes(
                look.embedding().norm(dim=1),
                potential.centres().tolist(),
            ),
            soft_classes(look.attribute("depth"), depth.centres().tolist()),
        )
        pairs = [(look.interior(2)[0], interior.centres().tolist())]
        if with_cosines:
            towards = angles.towards_centres().tolist()
            between = angles.between_centres().tolist()
            pairs += [
                (look.in_space()[k][0], centres)
                for k, centres in enumerate((towards, towards, between))
            ]
        else:
            pairs.append((look.euclidean(2)[0], euclidean.centres().tolist()))
        assert_allclose(result[i].detach(), pair_histogram_by_loops(memberships, pairs), atol=1e-6)


class DepthDifference(PairAxis):
    """An axis of one's own, with values of its own."""

    shape = (3,)

    def requirements(self, embedding):
        return Requirements(attributes=("depth",))

    def pairs(self, features, embedding):
        def between(rows, columns):
            return (rows[0][:, None, :, None] - columns[0][:, None, None, :]).abs()

        return PairValues(
            (features.attribute("depth"),),
            (torch.tensor([0.0, 0.1, 0.5]),),
            between,
        )


def test_an_axis_of_ones_own_counts_values_of_its_own(batch):
    histogram = PairHistogram([Potential(2), DepthDifference(), InteriorDistance(4)], FINE)
    assert histogram.shape == (3, 4, 3)
    assert histogram.requirements == Requirements(6, ("depth",))
    result = histogram(batch)
    for i in range(2):
        look = Look(batch, i)
        depth = look.attribute("depth").double().numpy()
        apart = np.abs(np.subtract.outer(depth, depth))
        axes = [look.interior(4), (apart, [0.0, 0.1, 0.5])]
        assert_allclose(result[i], pair_histogram_by_loops(look.potential(2), axes), atol=1e-6)


def test_defaults_are_the_papers_histogram(batch):
    result = PairHistogram()(batch)
    assert result.shape == (2, 10, 64)
    for i in range(2):
        embedding = embedded(batch, i)
        expected = pair_histogram(embedding, embedding.norm(dim=1), n_classes=4, n_bins=64)
        assert_allclose(result[i], expected, atol=1e-5)


def test_names_are_axes(batch):
    named = PairHistogram(["potential", "interior_distance", "euclidean_distance"])
    made = PairHistogram([Potential(4), InteriorDistance(64), EuclideanDistance(16)])
    assert torch.equal(named(batch), made(batch))


def test_needs_are_those_of_all_axes():
    far = SpectralEmbedding(n_eigenpairs=30)
    axes = [
        Attribute("depth", DEPTH),
        Attribute("my own", [1.0]),
        EuclideanDistance(),
        PairCosines(),
    ]
    assert PairHistogram(axes, far).requirements == Requirements(0, ("depth", "surface_direction"))
    coarse = PairHistogram([*axes, InteriorDistance(embedding=COARSE)], far)
    assert coarse.requirements.n_eigenpairs == 2
    both = PairHistogram([Potential(), InteriorDistance(embedding=COARSE)], far)
    assert both.requirements.n_eigenpairs == 30


def test_a_trained_module_gives_the_same_without_gradient(batch):
    histogram = PairHistogram([Potential(3), InteriorDistance(8)], SpectralEmbedding(n_knots=5))
    learn(histogram.embedding)
    with_gradient = histogram(batch)
    with torch.no_grad():
        without = histogram(batch)
    assert with_gradient.requires_grad
    assert_close(with_gradient.detach(), without, atol=1e-6, rtol=0)


def some(n_points, seed=0):
    """Embedding, positions and directions of one shape, float64."""
    generator = torch.Generator().manual_seed(seed)
    embedding = torch.randn(n_points, 4, generator=generator, dtype=torch.float64) * 0.6
    directions = normalize(
        torch.randn(n_points, 3, generator=generator, dtype=torch.float64), dim=1
    )
    return embedding, torch.rand(n_points, 3, generator=generator, dtype=torch.float64), directions


@pytest.mark.parametrize(
    ("make", "padding"),
    [
        (lambda: [Potential(soft=True), InteriorDistance(8)], torch.nan),
        (
            lambda: [
                Potential(2, soft=True, learnable=True),
                InteriorDistance(4),
                PairCosines(3, learnable=True),
            ],
            torch.nan,
        ),
        (lambda: [InteriorDistance(4), EmbeddedPairCosines(3)], 9.0),
    ],
)
def test_padding_changes_neither_result_nor_gradient_of_the_samples(make, padding):
    embedding, points, directions = some(40)
    mask = torch.zeros(2, 40, dtype=torch.bool)
    mask[0] = True
    mask[1, ::3] = True
    padded = embedding.repeat(2, 1, 1)
    places = points.repeat(2, 1, 1)
    padded[~mask] = places[~mask] = padding
    padded.requires_grad_()
    layer = PairHistogram(make())
    towards = directions.repeat(2, 1, 1)
    batch = layer(batch_of(padded, mask, places, {"surface_direction": towards}))
    single = embedding[::3].clone().requires_grad_()
    attributes = {"surface_direction": directions[None, ::3]}
    alone = layer(
        batch_of(
            single[None],
            None,
            points[None, ::3],
            attributes,
        )
    )
    assert_close(batch[1], alone[0], rtol=0, atol=1e-14)
    (expected,) = grad(alone.square().sum(), single)
    (gradient,) = grad(batch[1].square().sum(), padded)
    assert_close(gradient[1, ::3], expected, rtol=0, atol=1e-12)
    assert expected.abs().max() > 1e-6


def test_gradient_through_classes_and_layout():
    """By learned centres and by the embedding, whose norm is the potential; against finite differences."""
    embedding = some(9, seed=2)[0].requires_grad_()
    layer = PairHistogram(
        [
            Potential(3, soft=True, learnable=True),
            InteriorDistance(4, 2.0, learnable=True),
        ]
    ).double()
    names = ["axes.1.centres.log_gap", "axes.0.centres.log_gap"]

    def histogram(embedding, *parameters):
        return torch.func.functional_call(
            layer, dict(zip(names, parameters, strict=True)), (batch_of(embedding[None]),)
        )

    generator = torch.Generator().manual_seed(3)
    parameters = [
        torch.randn(
            n,
            generator=generator,
            dtype=torch.float64,
            requires_grad=True,
        )
        for n in (4, 3)
    ]
    leaves = (embedding, *parameters)
    for gradient in grad(histogram(*leaves).square().sum(), leaves):
        assert (gradient.abs() > 1e-6).any()
    assert torch.autograd.gradcheck(histogram, leaves)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("cosines", [False, True])
def test_half_precision_and_autocast_count_in_single(device, cosines):
    embedding = some(60)[0].to(device, torch.bfloat16)
    more = [EmbeddedPairCosines(3, learnable=True)] if cosines else []
    layer = PairHistogram(
        [Potential(soft=True, learnable=True), InteriorDistance(16, learnable=True), *more]
    ).to(device)

    def run(points):
        leaf = points.clone().requires_grad_()
        result = layer(batch_of(leaf[None]))
        return result, list(
            grad(
                result.square().sum(),
                [leaf, *layer.parameters()],
            )
        )

    expected, expected_gradients = run(embedding.float())
    with torch.autocast(device, torch.bfloat16):
        result, gradients = run(embedding)
        hard = PairHistogram().to(device)(batch_of(embedding[None]))
    assert result.dtype == hard.dtype == torch.float32
    assert_close(result, expected, rtol=0, atol=1e-6)
    assert_close(
        hard,
        PairHistogram().to(device)(batch_of(embedding.float()[None])),
    )
    # What comes by way of the directions, on a GPU also of the potential, is rounded before it is summed, and partly
    # cancels.
    rounding = (
        0.01 * float(expected_gradients[0].abs().max()) if cosines or device == "cuda" else 1e-6
    )
    assert_close(gradients[0].float(), expected_gradients[0], rtol=0.01, atol=rounding)
    assert_close(gradients[1:], expected_gradients[1:], rtol=1e-4, atol=1e-7)


def test_impossible_histograms_are_refused():
    with pytest.raises(
        ValueError, match=r"axes: expected one of potential, interior_distance, .*got 'depth'"
    ):
        PairHistogram(["depth", "interior_distance"])
    with pytest.raises(
        ValueError, match="axes: expected axes of points or of pairs, got SpectralEmbedding"
    ):
        PairHistogram([SpectralEmbedding()])
    for axes in ([], ["potential"]):
        with pytest.raises(
            ValueError,
            match="axes: expected at least one axis of pairs, such as 'interior_distance'",
        ):
            PairHistogram(axes)
    with pytest.raises(
        ValueError, match="samples: expected one of interior, surface, got 'volume'"
    ):
        PairHistogram(samples="volume")


@pytest.mark.parametrize("argument", ["n_samples", "n_training_samples"])
def test_a_single_sample_forms_no_pair(argument):
    with pytest.raises(ValueError, match=f"{argument}: expected at least 2"):
        PairHistogram(**{argument: 1})


def test_bad_batch_is_refused(batch):
    with pytest.raises(
        ValueError,
        match=r"expected the interior samples to have 'charge', got \['depth', 'surface_direction'\]",
    ):
        PairHistogram([Attribute("charge", [0.1, 0.2]), InteriorDistance()])(batch)
    broken = batch_of(
        torch.rand(1, 5, 3),
        None,
        None,
        {"depth": torch.full((1, 5), torch.nan)},
    )
    with pytest.raises(ValueError, match="Attribute: expected finite values"):
        PairHistogram([Attribute("depth", [0.1, 0.2]), EuclideanDistance()])(broken)
    points = replace(batch.interior, points=batch.interior.points * torch.inf)
    for axes in (["euclidean_distance"], ["interior_distance", "pair_cosines"]):
        with pytest.raises(ValueError, match="finite"):
            PairHistogram(axes)(replace(batch, interior=points))
    with pytest.raises(ValueError, match="at least two points to form a pair, got 1"):
        PairHistogram()(batch_of(torch.rand(1, 1, 3)))

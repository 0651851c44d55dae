from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from batches import alone, scaled, two_bodies
from igps.data.requirements import Requirements
from igps.nn.axes import (
    Attribute,
    EmbeddedPairCosines,
    EuclideanDistance,
    InteriorDistance,
    PairCosines,
    Potential,
)
from igps.nn.descriptor import BodyDescriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.closed_form import WhitenedHead
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import cosine


@pytest.fixture(scope="module")
def batch():
    return two_bodies()


def paper():
    return HistogramDescriptor(PairHistogram())


def learned():
    axes = [
        Potential(3, learnable=True),
        Attribute("depth", [0.2, 0.5, 0.9], learnable=True),
    ]
    distances = [InteriorDistance(8, learnable=True), EuclideanDistance(4, learnable=True)]
    return HistogramDescriptor(PairHistogram([*axes, *distances], SpectralEmbedding(n_knots=8)))


def oriented(*, in_embedding=False, learnable=False):
    angles = EmbeddedPairCosines if in_embedding else PairCosines
    axes = [InteriorDistance(4, 3.0, learnable=learnable), angles(3, learnable=learnable)]
    return HistogramDescriptor(
        PairHistogram(axes, SpectralEmbedding(n_knots=6 if learnable else 0))
    )


def combined():
    """Every kind of part."""
    fine, coarse = (SpectralEmbedding(n_eigenpairs=n) for n in (5, 2))
    two_scales = PairHistogram(
        [Potential(2), InteriorDistance(6), InteriorDistance(4, 1.0, embedding=coarse)], fine
    )
    surface = PairHistogram([EuclideanDistance(6), PairCosines(5)], samples="surface")
    nested = [*learned().histograms, *paper().histograms]
    return HistogramDescriptor(
        [
            nested,
            two_scales,
            *oriented().histograms,
            *oriented(in_embedding=True).histograms,
            surface,
        ]
    )


MAKERS = [paper, learned, oriented, lambda: oriented(in_embedding=True), combined]


@pytest.mark.parametrize("make", MAKERS)
def test_does_not_change_with_scale(batch, make):
    descriptor = make()
    with torch.no_grad():
        assert_close(
            descriptor(scaled(batch, 8.0)),
            descriptor(batch),
            rtol=0,
            atol=1e-6,
        )


def test_everything_learns(batch):
    descriptor = learned()
    result = descriptor(batch)
    assert result.shape == (2, 45, 8, 4)
    np.testing.assert_allclose(result.detach().sum(dim=(1, 2, 3)), 1, atol=1e-6)
    (result[0] - result[1]).square().sum().backward()
    parameters = dict(descriptor.named_parameters())
    assert set(parameters) == {
        "histograms.0.embedding.log_gain",
        *(f"histograms.0.axes.{i}.centres.log_gap" for i in range(4)),
    }
    check_gradients(parameters)


def check_gradients(parameters):
    for name, parameter in parameters.items():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert (parameter.grad != 0).any(), name


def test_cells_are_counted_by_part(batch):
    descriptor = combined()
    assert descriptor(batch).shape == (2, sum(descriptor.part_cells))
    assert descriptor.part_cells == (45 * 8 * 4 + 10 * 64, 3 * 6 * 4, 4 * 27, 4 * 27, 6 * 125)
    assert [len(part) for part in descriptor.parts] == [2, 1, 1, 1, 1]
    assert paper().part_cells == (640,)


def test_a_single_histogram_keeps_its_shape_and_a_list_of_one_is_flat(batch):
    histogram = PairHistogram()
    single = HistogramDescriptor(histogram)(batch)
    listed = HistogramDescriptor([histogram])(batch)
    assert torch.equal(single, histogram(batch))
    assert torch.equal(listed, single.flatten(1))


def small(n_eigenpairs, n_classes, **options):
    axes = [Potential(n_classes), InteriorDistance(16)]
    return PairHistogram(axes, SpectralEmbedding(n_eigenpairs=n_eigenpairs), **options)


@pytest.mark.parametrize(
    ("shares", "of_first"),
    [(None, 1 / 2), ([6, 2], 3 / 4)],
)
def test_parts_have_their_shares_and_their_histograms_equal_ones(batch, shares, of_first):
    first, second, third = histograms = [small(3, 2), small(5, 3), small(4, 1)]
    result = HistogramDescriptor([[first, second], third], shares=shares)(batch)
    expected = [
        share * one(batch).flatten(1)
        for share, one in zip(
            (of_first / 2, of_first / 2, 1 - of_first),
            histograms,
            strict=True,
        )
    ]
    assert_close(result, torch.cat(expected, dim=1))
    assert_close(result.sum(dim=1), torch.ones(2))


class Counting(SpectralEmbedding):
    """Counts its calls."""

    calls = 0

    def forward(self, *arguments):
        self.calls += 1
        return super().forward(*arguments)


def test_what_histograms_share_is_computed_once(batch):
    embedding = Counting(n_eigenpairs=5)
    other = Counting(n_eigenpairs=5)
    first = PairHistogram([Potential(2), InteriorDistance(8)], embedding)
    second = PairHistogram([InteriorDistance(6), InteriorDistance(4, embedding=other)], embedding)
    third = PairHistogram([Potential(3), InteriorDistance(5, embedding=embedding)], other)
    surface = PairHistogram(["interior_distance"], embedding, "surface")
    fewer = PairHistogram(["interior_distance"], embedding, n_samples=9)
    HistogramDescriptor([first, [second, third]])(batch)
    assert embedding.calls == 1
    assert other.calls == 1
    HistogramDescriptor([first, [second, third], surface, fewer])(batch)
    assert embedding.calls == 4
    assert other.calls == 2


def test_subset_of_samples_is_the_same_in_any_batch(batch):
    descriptor = HistogramDescriptor(small(5, 2, n_samples=5))
    together = descriptor(batch)
    for i in range(2):
        assert_close(descriptor(alone(batch, i))[0], together[i])
    assert not torch.allclose(together, HistogramDescriptor(small(5, 2))(batch))


def test_training_draws_another_subset_each_time(batch):
    descriptor = HistogramDescriptor([small(5, 2, n_training_samples=5), small(5, 1)])
    torch.manual_seed(0)
    one = descriptor(batch)
    other = descriptor(batch)
    first = descriptor.part_cells[0]
    assert not torch.equal(one[:, :first], other[:, :first])
    assert torch.equal(one[:, first:], other[:, first:])
    descriptor.eval()
    assert_close(
        descriptor(batch),
        HistogramDescriptor([small(5, 2), small(5, 1)])(batch),
    )


def test_needs_are_those_of_all_histograms(batch):
    descriptor = HistogramDescriptor(
        [
            [small(5, 2), oriented().histograms[0]],
            small(9, 1),
        ]
    )
    # The embedding of the oriented one takes all that there are.
    assert descriptor.requirements == Requirements(
        9, ("surface_direction",), samples=("interior",), whole_spectrum=True
    )
    with pytest.raises(
        ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 9, got 7"
    ):
        descriptor(batch)
    bare = replace(batch, interior=replace(batch.interior, attributes={}))
    with pytest.raises(
        ValueError, match="expected the interior samples to have 'surface_direction'"
    ):
        oriented()(bare)
    barest = replace(bare, surface=replace(batch.surface, attributes={}))
    with pytest.raises(
        ValueError, match="attributes: this descriptor needs signatures with surface_direction"
    ):
        oriented()(barest)


@pytest.mark.parametrize(
    "histograms",
    [[], [[]], [PairHistogram(), []]],
)
def test_no_histogram_is_refused(histograms):
    with pytest.raises(
        ValueError, match="histograms: expected at least one in each part, got none"
    ):
        HistogramDescriptor(histograms)


@pytest.mark.parametrize(
    "shares",
    [[1.0], [1.0, 0.0], [1.0, float("nan")]],
)
def test_each_part_needs_a_positive_share(shares):
    with pytest.raises(ValueError, match="shares: expected a positive number for each of 2 parts"):
        HistogramDescriptor([PairHistogram(), PairHistogram()], shares=shares)


class Extent(BodyDescriptor):
    """The largest distance from the centre, in space and in the embedding; for it the mesh must be there."""

    name = "extent"
    requirements = Requirements(n_eigenpairs=7, mesh=True)

    def describe_body(self, body):
        assert body.mesh is body.surface_mesh
        points = body.interior.points
        functions = body.interior.eigenfunctions
        return np.array(
            [
                len(points),
                functions.shape[1],
                np.abs(points).max(),
                body.area,
            ]
        )


def test_a_descriptor_of_bodies_sees_each_without_padding(batch):
    descriptor = Extent()
    with pytest.raises(ValueError, match="meshes: this descriptor needs the surfaces too"):
        descriptor(batch)
    described = descriptor(replace(batch, meshes=(object(), object())))
    assert described.dtype == torch.float32
    largest = [float(batch.interior.points[i].abs().max()) for i in range(2)]
    expected = torch.tensor(
        [
            [40, 12, largest[0], 2],
            [25, 7, largest[1], 3],
        ]
    )
    assert_close(described, expected)


@pytest.mark.parametrize("make", [*MAKERS, Extent])
def test_a_batch_without_shapes_is_refused(batch, make):
    with pytest.raises(ValueError, match="batch: expected at least one shape, got none"):
        make()(batch[batch.labels == 7])


def test_a_descriptor_under_a_head_is_compared_by_the_cosine(batch):
    below = HistogramDescriptor(
        [small(5, 2), small(3, 1)], name="two", invariant_to=("motion", "scale")
    )
    descriptor = EmbeddedDescriptor(below, WhitenedHead().centre(below(batch)), source="nobody")
    assert descriptor.name == "embedded"
    assert descriptor.source == "nobody"
    assert descriptor.invariant_to == below.invariant_to
    assert descriptor.requirements == below.requirements
    embedding = descriptor(batch)
    roots = below(batch).sqrt() - below(batch).sqrt().mean(dim=0)
    assert_close(
        embedding,
        roots / roots.norm(dim=1, keepdim=True),
        atol=1e-5,
        rtol=0,
    )
    assert_close(descriptor.distances(embedding, embedding), cosine(embedding, embedding))
    assert descriptor.shorten(embedding) is embedding
    with pytest.raises(
        ValueError, match=r"expected a head that shortens its embeddings.*WhitenedHead.*300 numbers"
    ):
        descriptor.shorten(torch.rand(2, 300))
    assert EmbeddedDescriptor(below, descriptor.head, invariant_to=["pose"]).invariant_to == (
        "pose",
    )


def test_coordinates_of_histograms_are_their_roots(batch):
    """As Hellinger's distance takes them; those of others are the descriptions."""
    histograms = paper()(batch)
    assert_close(paper().coordinates(histograms).square(), histograms.flatten(1))
    kept = EmbeddedDescriptor(paper(), WhitenedHead())
    assert kept.coordinates(histograms.flatten(1)).equal(histograms.flatten(1))


@pytest.mark.parametrize(
    "given",
    ["body.off", torch.zeros(3), two_bodies()[0]],
)
def test_what_is_no_batch_is_refused_with_the_remedy(given):
    with pytest.raises(TypeError, match=r"batch: expected a SignatureBatch, got .*igps.collate"):
        HistogramDescriptor(PairHistogram())(given)


def test_a_parameter_that_is_not_finite_is_blamed_and_not_the_samples():
    descriptor = HistogramDescriptor(PairHistogram(embedding=SpectralEmbedding(n_knots=3)))
    with torch.no_grad():
        descriptor.histograms[0].embedding.log_gain[1] = torch.nan
    with pytest.raises(ValueError, match=r"histograms.0.embedding.log_gain: expected a finite par"):
        descriptor(two_bodies())

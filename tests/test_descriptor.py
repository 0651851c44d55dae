from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from igps.data.dataset import SampleBatch, SignatureBatch
from igps.nn.descriptor import CombinedDescriptor, OrientedDescriptor, VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histogram import PairHistogram, pair_histogram
from igps.nn.oriented import OrientedPairHistogram
from igps.retrieval import chi_square

N_POINTS = (40, 25)


def samples(n_eigenpairs: tuple[int, int], generator: torch.Generator) -> SampleBatch:
    longest = max(N_POINTS)
    mask = torch.arange(longest) < torch.tensor(N_POINTS)[:, None]
    functions = torch.randn(2, longest, max(n_eigenpairs), generator=generator) * mask[:, :, None]
    for i, n in enumerate(n_eigenpairs):
        functions[i, :, n:] = 0
    points = torch.rand(2, longest, 3, generator=generator) * mask[:, :, None]
    attributes = {
        "depth": torch.rand(2, longest, generator=generator) * mask,
        "surface_direction": normalize(torch.randn(2, longest, 3, generator=generator), dim=2) * mask[:, :, None],
    }
    return SampleBatch(points, functions, mask, attributes)


@pytest.fixture(scope="module")
def batch() -> SignatureBatch:
    """Two shapes of different numbers of samples and eigenpairs."""
    generator = torch.Generator().manual_seed(11)
    n_eigenpairs = (12, 7)
    eigenvalues = torch.rand(2, 12, generator=generator, dtype=torch.float64).cumsum(dim=1) * 10 + 5
    eigenvalues[1, 7:] = torch.inf
    return SignatureBatch(
        eigenvalues=eigenvalues,
        interior=samples(n_eigenpairs, generator),
        surface=samples(n_eigenpairs, generator),
        area=torch.tensor([2.0, 3.0], dtype=torch.float64),
        volume=torch.tensor([0.2, 0.3], dtype=torch.float64),
        labels=torch.tensor([0, 1]),
        ids=("a", "b"),
    )


def learned() -> VolumetricDescriptor:
    histogram = PairHistogram(
        n_classes=3, n_bins=8, learnable=True, attributes={"depth": [0.2, 0.5, 0.9]}, n_euclidean_bins=4
    )
    return VolumetricDescriptor(SpectralEmbedding(n_knots=8), histogram)


def oriented(space: str = "position", distance: str = "interior", n_knots: int = 0) -> OrientedDescriptor:
    embedding = SpectralEmbedding(n_knots=n_knots) if distance == "interior" else None
    histogram = OrientedPairHistogram(4, 3, learnable=n_knots > 0)
    return OrientedDescriptor(embedding, histogram, space=space, distance=distance)  # type: ignore[arg-type]


def combined() -> CombinedDescriptor:
    """Every kind of part."""
    two_scales = VolumetricDescriptor(
        SpectralEmbedding(n_eigenpairs=5),
        PairHistogram(2, 6, n_euclidean_bins=4),
        second_embedding=SpectralEmbedding(n_eigenpairs=2),
    )
    surface = OrientedDescriptor(samples="surface", distance="euclidean")
    nested = CombinedDescriptor([learned(), VolumetricDescriptor.paper()])
    return CombinedDescriptor([nested, two_scales, oriented(), oriented("embedding"), surface])


def single(batch: SignatureBatch, i: int) -> SignatureBatch:
    """One shape without its padding."""

    def alone(samples: SampleBatch) -> SampleBatch:
        n_points, n_eigenpairs = N_POINTS[i], int(torch.isfinite(batch.eigenvalues[i]).sum())
        return SampleBatch(
            samples.points[i : i + 1, :n_points],
            samples.eigenfunctions[i : i + 1, :n_points, :n_eigenpairs],
            samples.mask[i : i + 1, :n_points],
            {name: values[i : i + 1, :n_points] for name, values in samples.attributes.items()},
        )

    return replace(
        batch,
        eigenvalues=batch.eigenvalues[i : i + 1, torch.isfinite(batch.eigenvalues[i])],
        interior=alone(batch.interior),
        surface=alone(batch.surface),
        area=batch.area[i : i + 1],
    )


def scaled(batch: SignatureBatch, scale: float) -> SignatureBatch:
    def grown(samples: SampleBatch) -> SampleBatch:
        return replace(samples, points=samples.points * scale, eigenfunctions=samples.eigenfunctions / scale)

    return replace(
        batch,
        eigenvalues=batch.eigenvalues / scale**2,
        interior=grown(batch.interior),
        surface=grown(batch.surface),
        area=batch.area * scale**2,
        volume=batch.volume * scale**3,
    )


@pytest.mark.parametrize("kind", ["interior", "surface"])
def test_paper_is_the_hard_histogram_of_the_commute_time(batch: SignatureBatch, kind: str) -> None:
    descriptor = VolumetricDescriptor.paper(kind)  # type: ignore[arg-type]
    assert list(descriptor.parameters()) == []
    result = descriptor(batch)
    for i, n in enumerate(N_POINTS):
        functions = getattr(batch, kind).eigenfunctions[i, :n].double()
        embedding = torch.nan_to_num(functions / batch.eigenvalues[i].sqrt())
        expected = pair_histogram(embedding, embedding.norm(dim=1), n_classes=4, n_bins=64)
        np.testing.assert_allclose(result[i], expected, atol=1e-5)


@pytest.mark.parametrize("make", [VolumetricDescriptor.paper, learned, combined])
def test_padding_never_shows(batch: SignatureBatch, make) -> None:
    descriptor = make()
    with torch.no_grad():
        together = descriptor(batch)
        for i in range(2):
            torch.testing.assert_close(descriptor(single(batch, i))[0], together[i], rtol=0, atol=1e-6)


@pytest.mark.parametrize("make", [VolumetricDescriptor.paper, learned, combined])
def test_does_not_change_with_scale(batch: SignatureBatch, make) -> None:
    descriptor = make()
    with torch.no_grad():
        torch.testing.assert_close(descriptor(scaled(batch, 8.0)), descriptor(batch), rtol=0, atol=1e-6)


def test_euclidean_distance_is_one_more_dimension(batch: SignatureBatch) -> None:
    """Summed over the interior distance, the histogram of Euclidean distances over √area; and the other way round."""
    descriptor = VolumetricDescriptor(histogram=PairHistogram(n_classes=4, n_bins=32, n_euclidean_bins=16))
    result = descriptor(batch)
    assert result.shape == (2, 10, 32, 16)
    plain = VolumetricDescriptor(histogram=PairHistogram(n_classes=4, n_bins=32))(batch)
    np.testing.assert_allclose(result.sum(dim=3), plain, atol=1e-6)
    for i, n in enumerate(N_POINTS):
        points = batch.interior.points[i, :n] / batch.area[i].sqrt().float()
        expected = pair_histogram(points, torch.zeros(n), n_classes=1, n_bins=16, distance_range=1.0)
        np.testing.assert_allclose(result[i].sum(dim=(0, 1)), expected[0], atol=1e-6)


def test_everything_learns(batch: SignatureBatch) -> None:
    descriptor = learned()
    result = descriptor(batch)
    assert result.shape == (2, 45, 8, 4)
    np.testing.assert_allclose(result.detach().sum(dim=(1, 2, 3)), 1, atol=1e-6)
    (result[0] - result[1]).square().sum().backward()
    parameters = dict(descriptor.named_parameters())
    assert set(parameters) == {
        "embedding.log_gain",
        "histogram.distance_centres.log_gap",
        "histogram.potential_centres.log_gap",
        "histogram.attribute_centres.depth.log_gap",
        "histogram.euclidean_centres.log_gap",
    }
    for name, parameter in parameters.items():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert (parameter.grad != 0).any(), name


def gradients(module: torch.nn.Module, batch: SignatureBatch, parameters: list[Tensor]) -> tuple[Tensor, ...]:
    result = module(batch)
    return result.detach(), *torch.autograd.grad(result.square().sum(), parameters)


def test_compiled_equals_eager(batch: SignatureBatch) -> None:
    descriptor = learned()
    parameters = list(descriptor.parameters())
    torch.compiler.reset()
    compiled = torch.compile(descriptor, backend="aot_eager")
    torch.testing.assert_close(
        gradients(compiled, batch, parameters), gradients(descriptor, batch, parameters), rtol=1e-4, atol=1e-7
    )


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_equals_cpu(batch: SignatureBatch) -> None:
    descriptor = learned()
    expected = gradients(descriptor, batch, list(descriptor.parameters()))
    descriptor.cuda()
    result = gradients(descriptor, batch.to("cuda"), list(descriptor.parameters()))
    torch.testing.assert_close([value.cpu() for value in result], list(expected), rtol=1e-3, atol=1e-6)


def test_cells_are_counted_by_part(batch: SignatureBatch) -> None:
    descriptor = combined()
    assert descriptor(batch).shape == (2, sum(descriptor.part_cells))
    assert descriptor.part_cells == (45 * 8 * 4 + 10 * 64, 3 * 6 * 4, 4 * 27, 4 * 27, 6 * 125)


def test_second_embedding_takes_the_place_of_the_points(batch: SignatureBatch) -> None:
    """Summed over one distance, the histogram of the other."""
    scales = [SpectralEmbedding(n_eigenpairs=k) for k in (6, 2)]
    histogram = PairHistogram(1, 12, n_euclidean_bins=9, euclidean_range=2.0)
    joint = VolumetricDescriptor(scales[0], histogram, second_embedding=scales[1])(batch)
    fine = VolumetricDescriptor(scales[0], PairHistogram(1, 12))(batch)
    coarse = VolumetricDescriptor(scales[1], PairHistogram(1, 9, distance_range=2.0))(batch)
    torch.testing.assert_close(joint.sum(dim=3), fine, atol=1e-6, rtol=0)
    torch.testing.assert_close(joint.sum(dim=2), coarse, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("space", "distance"), [("position", "interior"), ("position", "euclidean"), ("embedding", "interior")]
)
def test_oriented_distances_are_those_of_the_plain_histogram(batch: SignatureBatch, space: str, distance: str) -> None:
    result = oriented(space, distance)(batch)
    assert result.shape == (2, 4, 3, 3, 3)
    samples, length = batch.interior, batch.area.sqrt().float()
    for i, n in enumerate(N_POINTS):
        places = samples.points[i, :n] / length[i]
        if distance == "interior":
            places = torch.nan_to_num(samples.eigenfunctions[i, :n] / batch.eigenvalues[i].sqrt()).float()
        expected = pair_histogram(places, torch.zeros(n), n_classes=1, n_bins=4, distance_range=3.0)
        np.testing.assert_allclose(result[i].sum(dim=(1, 2, 3)), expected[0], atol=1e-6)


@pytest.mark.parametrize("kind", ["interior", "surface"])
def test_directions_in_the_embedding_lead_outwards(batch: SignatureBatch, kind: str) -> None:
    scale = SpectralEmbedding(n_eigenpairs=4)
    result = OrientedDescriptor(scale, samples=kind, space="embedding")(batch)  # type: ignore[arg-type]
    for i, n in enumerate(N_POINTS):
        inside, surface = (
            (samples.eigenfunctions[i, :n, :4] / batch.eigenvalues[i, :4].sqrt()).float()
            for samples in (batch.interior, batch.surface)
        )
        own, other, sign = (inside, surface, 1) if kind == "interior" else (surface, inside, -1)
        nearest = (own[:, None] - other).norm(dim=2).argsort(dim=1)[:, :8]
        directions = sign * normalize(other[nearest].mean(dim=1) - own, dim=1)
        mask = torch.ones(1, n, dtype=torch.bool)
        expected = OrientedPairHistogram()(own[None], own[None], directions[None], mask)[0]
        torch.testing.assert_close(result[i], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("space", ["position", "embedding"])
def test_oriented_descriptor_learns_bins_and_filter(batch: SignatureBatch, space: str) -> None:
    descriptor = oriented(space, n_knots=6)
    result = descriptor(batch)
    (result[0] - result[1]).square().sum().backward()
    parameters = dict(descriptor.named_parameters())
    assert len(parameters) == 4
    for name, parameter in parameters.items():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert (parameter.grad != 0).any(), name


def test_oriented_descriptor_says_what_it_needs(batch: SignatureBatch) -> None:
    bare = replace(batch, interior=replace(batch.interior, attributes={}))
    with pytest.raises(ValueError, match="expected 'surface_direction' among those of the interior samples"):
        oriented()(bare)
    with pytest.raises(ValueError, match="space: expected 'position' or 'embedding'"):
        OrientedDescriptor(space="volume")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="distance: expected 'interior' or 'euclidean'"):
        OrientedDescriptor(distance="geodesic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="embedding: expected None with distance='euclidean'"):
        OrientedDescriptor(SpectralEmbedding(), distance="euclidean")
    with pytest.raises(ValueError, match="distance: expected 'interior' with space='embedding'"):
        OrientedDescriptor(space="embedding", distance="euclidean")


def test_directions_are_no_classes(batch: SignatureBatch) -> None:
    histogram = PairHistogram(2, 8, attributes={"surface_direction": [0.0, 1.0]})
    with pytest.raises(ValueError, match="surface_direction"):
        VolumetricDescriptor(histogram=histogram)(batch)


def test_unknown_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="samples: expected 'interior' or 'surface'"):
        VolumetricDescriptor(samples="volume")  # type: ignore[arg-type]


def test_combined_chi_square_is_the_mean(batch: SignatureBatch) -> None:
    parts = [
        VolumetricDescriptor(SpectralEmbedding(n_eigenpairs=k), PairHistogram(n_classes, 16))
        for k, n_classes in ((3, 2), (5, 3))
    ]
    combined = CombinedDescriptor(parts)(batch)
    torch.testing.assert_close(combined.sum(dim=1), torch.ones(2))
    separate = [chi_square(histograms, histograms) for histograms in (part(batch) for part in parts)]
    torch.testing.assert_close(chi_square(combined, combined), torch.stack(separate).mean(dim=0))


def test_subset_of_samples_is_the_same_in_any_batch(batch: SignatureBatch) -> None:
    descriptor = VolumetricDescriptor(histogram=PairHistogram(2, 8), n_samples=5)
    together = descriptor(batch)
    for i in range(2):
        torch.testing.assert_close(descriptor(single(batch, i))[0], together[i])
    assert not torch.allclose(together, VolumetricDescriptor(histogram=PairHistogram(2, 8))(batch))


def test_training_draws_another_subset_each_time(batch: SignatureBatch) -> None:
    descriptor = VolumetricDescriptor(histogram=PairHistogram(2, 8), n_training_samples=5)
    torch.manual_seed(0)
    assert not torch.equal(descriptor(batch), descriptor(batch))
    descriptor.eval()
    torch.testing.assert_close(descriptor(batch), VolumetricDescriptor(histogram=PairHistogram(2, 8))(batch))


@pytest.mark.parametrize("argument", ["n_samples", "n_training_samples"])
def test_a_single_sample_forms_no_pair(argument: str) -> None:
    with pytest.raises(ValueError, match=f"{argument}: expected None or at least 2"):
        VolumetricDescriptor(**{argument: 1})  # type: ignore[arg-type]

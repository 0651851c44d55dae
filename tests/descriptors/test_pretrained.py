"""`multiscale` and `rich` are their parts side by side; `pretrained` is the shipped metric on top of `rich`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import igps
from igps.data.dataset import SignatureDataset
from igps.descriptors.pretrained import PRETRAINED, pretrained, save_pretrained
from igps.descriptors.rich import rich
from igps.geometry.signature import SignatureConfig
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.fitted import WhitenedHead
from igps.retrieval import chi_square, cosine, retrieval_scores
from igps.shapes import ArticulatedShapes

# Of `rich`: six histograms in its first part, two oriented ones.
CELLS = (25920, 750, 750)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> SignatureDataset:
    """Shapes of a seed that the pretrained metric was not fitted to."""
    root = tmp_path_factory.mktemp("shapes")
    ArticulatedShapes(n_classes=6, n_per_class=5, seed=7, n_vertices=1500).write(root)
    config = rich().needs.completed(SignatureConfig(n_eigenpairs=50, n_surface_samples=50))
    return SignatureDataset(root, config, root / "cache")


@pytest.fixture(scope="module")
def histograms(dataset: SignatureDataset) -> torch.Tensor:
    return describe(dataset, igps.descriptor("rich"))


def test_rich_is_its_histograms_side_by_side_with_equal_shares(
    dataset: SignatureDataset, histograms: torch.Tensor
) -> None:
    """Each computed alone, without what they share."""
    found = igps.descriptor("rich")
    assert isinstance(found, HistogramDescriptor)
    assert found.part_cells == CELLS
    batch = dataset.batch([0, 7])
    expected = []
    with torch.inference_mode():
        for part in found.parts:
            expected += [histogram(batch).flatten(1) / (3 * len(part)) for histogram in part]
    torch.testing.assert_close(histograms[[0, 7]], torch.cat(expected, dim=1), rtol=1e-4, atol=1e-7)
    for part in histograms.split(CELLS, dim=1):
        torch.testing.assert_close(part.sum(dim=1), torch.full((len(part),), 1 / 3), rtol=1e-4, atol=0)
    # The distance of the whole is then the mean of those of the parts, each a histogram of sum 1.
    of_parts = [chi_square(3 * part, 3 * part) for part in histograms.split(CELLS, dim=1)]
    whole = found.distances(histograms, histograms)
    torch.testing.assert_close(whole, torch.stack(of_parts).mean(dim=0), rtol=1e-4, atol=1e-6)


def test_a_class_is_closer_to_itself(dataset: SignatureDataset, histograms: torch.Tensor) -> None:
    """Far beyond what labels dealt out at random give: 4 of the 29 others, 14 %, are of a shape's class."""
    scores = retrieval_scores(igps.descriptor("rich").distances(histograms, histograms), dataset.labels).mean()
    shuffled = dataset.labels[torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))]
    by_chance = retrieval_scores(chi_square(histograms, histograms), shuffled).mean()
    assert scores["nn"] > 0.9
    assert scores["ft"] > 0.7
    assert by_chance["ft"] < 0.3


def test_pretrained_is_the_fitted_whitening_of_the_rich_histograms(dataset: SignatureDataset) -> None:
    part = dataset.subset(range(3))
    module = pretrained()
    roots = describe(part, module.descriptor).double().sqrt()
    stored = {
        name.removeprefix("head."): tensor.double()
        for name, tensor in load_file(PRETRAINED).items()
        if name.startswith("head.")
    }
    assert stored["part_cells"].long().tolist() == list(CELLS)
    parts, start = [], 0
    for n_cells, gains in zip(CELLS, stored["gains"], strict=True):
        cells = slice(start, start := start + n_cells)
        centred, directions = (roots - stored["mean"])[:, cells], stored["directions"][:, cells]
        damped = centred - centred @ directions.T @ torch.diag(1 - gains) @ directions
        parts.append(damped / damped.norm(dim=1, keepdim=True))
    expected = torch.cat(parts, dim=1) / 3**0.5
    found = describe(part, module)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    torch.testing.assert_close(module.distances(found, found).double(), 1 - expected @ expected.T, atol=1e-5, rtol=0)


def test_pretrained_gains_on_shapes_it_has_not_seen(dataset: SignatureDataset, histograms: torch.Tensor) -> None:
    """Over the plain distance, and over its own bins and filters without what the head was fitted to."""
    module = pretrained()
    own = describe(dataset, module.descriptor)
    centred = WhitenedHead().centre(own, list(CELLS))

    def first_tier(embedded: torch.Tensor) -> float:
        return retrieval_scores(cosine(embedded, embedded), dataset.labels).mean()["ft"]

    plain = retrieval_scores(chi_square(histograms, histograms), dataset.labels).mean()["ft"]
    learned = first_tier(module.head(own))
    assert learned > plain + 0.02
    assert learned > first_tier(centred(own))


def test_a_trained_metric_is_stored_with_its_bins_and_filters(dataset: SignatureDataset, tmp_path: Path) -> None:
    descriptor = rich(learnable=True, n_samples=100)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in descriptor.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
    dataset = dataset.subset(range(10))
    described = describe(dataset, descriptor)
    head = WhitenedHead(5).fit(described, dataset.labels, descriptor.part_cells)
    save_pretrained(EmbeddedDescriptor(descriptor, head), tmp_path / "metric.safetensors")
    loaded = pretrained(tmp_path / "metric.safetensors")
    assert not loaded.training
    for name, value in descriptor.state_dict().items():
        torch.testing.assert_close(loaded.descriptor.state_dict()[name], value, atol=0, rtol=0)
    for part in loaded.descriptor.modules():
        if hasattr(part, "n_samples"):
            part.n_samples = 100
    torch.testing.assert_close(describe(dataset, loaded), head(described), atol=2e-3, rtol=0)
    assert not torch.allclose(describe(dataset, loaded.descriptor), describe(dataset, rich(n_samples=100)))


def test_shipped_file_is_small() -> None:
    assert PRETRAINED.stat().st_size < 2e6


def test_a_file_of_another_metric_is_named(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"head.mean": torch.zeros(3)}, path)
    with pytest.raises(ValueError, match=r"other\.safetensors: expected the parameters of `rich`"):
        pretrained(path)
    with pytest.raises(FileNotFoundError):
        pretrained(tmp_path / "missing.safetensors")

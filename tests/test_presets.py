from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from igps.data.dataset import SignatureDataset
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import (
    PRETRAINED,
    CombinedDescriptor,
    EmbeddedDescriptor,
    VolumetricDescriptor,
    load_embedded,
    save_embedded,
)
from igps.nn.extraction import describe
from igps.nn.fitted import WhitenedHead
from igps.nn.presets import DescriptorName, preset
from igps.retrieval import chi_square, cosine, retrieval_scores
from igps.shapes import ArticulatedShapes


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> SignatureDataset:
    """Shapes of a seed that the pretrained metric was not fitted to."""
    root = tmp_path_factory.mktemp("shapes")
    ArticulatedShapes(n_classes=6, n_per_class=5, seed=7, n_vertices=1500).write(root)
    config = SignatureConfig(
        n_eigenpairs=50, n_surface_samples=50, attributes=("depth", "electrostatic_potential", "surface_direction")
    )
    return SignatureDataset(root, config, root / "cache")


@pytest.mark.parametrize("name", get_args(DescriptorName))
def test_presets_describe_and_compare(name: DescriptorName, dataset: SignatureDataset) -> None:
    chosen = preset(name)
    described = describe(dataset.subset([0, 1, 5]), chosen.make())
    distances = chosen.distance(described, described)
    np.testing.assert_allclose(distances.diagonal(), 0, atol=1e-5)
    assert distances[0, 1] < distances[0, 2]


def test_pretrained_is_the_fitted_whitening_of_the_rich_histograms(dataset: SignatureDataset) -> None:
    part = dataset.subset(range(3))
    pretrained = VolumetricDescriptor.pretrained()
    roots = describe(part, pretrained.descriptor).double().sqrt()
    stored = {
        name.removeprefix("head."): tensor.double()
        for name, tensor in load_file(PRETRAINED).items()
        if name.startswith("head.")
    }
    parts = []
    for cells, gains in zip((slice(0, 25920), slice(25920, 26670), slice(26670, 27420)), stored["gains"], strict=True):
        centred, directions = (roots - stored["mean"])[:, cells], stored["directions"][:, cells]
        damped = centred - centred @ directions.T @ torch.diag(1 - gains) @ directions
        parts.append(damped / damped.norm(dim=1, keepdim=True))
    expected = torch.cat(parts, dim=1) / 3**0.5
    np.testing.assert_allclose(describe(part, pretrained), expected, atol=1e-5)


def test_pretrained_gains_on_shapes_it_has_not_seen(dataset: SignatureDataset) -> None:
    histograms = describe(dataset, CombinedDescriptor.rich())
    embedded = describe(dataset, VolumetricDescriptor.pretrained())
    plain = retrieval_scores(chi_square(histograms, histograms), dataset.labels).mean()
    learned = retrieval_scores(cosine(embedded, embedded), dataset.labels).mean()
    assert learned["ft"] > plain["ft"]


def test_a_trained_metric_is_stored_with_its_bins_and_filters(dataset: SignatureDataset, tmp_path: Path) -> None:
    descriptor = CombinedDescriptor.rich(learnable=True, n_samples=100)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in descriptor.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
    histograms = describe(dataset, descriptor)
    head = WhitenedHead(descriptor.part_cells, 5).fit(histograms, dataset.labels)
    save_embedded(EmbeddedDescriptor(descriptor, head), tmp_path / "metric.safetensors")
    loaded = load_embedded(tmp_path / "metric.safetensors")
    assert not loaded.training
    for name, value in descriptor.state_dict().items():
        torch.testing.assert_close(loaded.descriptor.state_dict()[name], value, atol=0, rtol=0)
    for part in loaded.descriptor.modules():
        if hasattr(part, "n_samples"):
            part.n_samples = 100
    torch.testing.assert_close(describe(dataset, loaded), head(histograms), atol=2e-3, rtol=0)
    assert not torch.allclose(describe(dataset, loaded.descriptor), describe(dataset, CombinedDescriptor.rich()))


def test_shipped_file_is_small() -> None:
    assert Path(PRETRAINED).stat().st_size < 2e6


def test_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match="descriptor: expected one of interior, gps, multiscale, rich, pretrained"):
        preset("best")  # type: ignore[arg-type]


def test_what_a_descriptor_needs_is_added_or_asked_for() -> None:
    config = SignatureConfig(n_eigenpairs=50, attributes=("electrostatic_potential",))
    assert preset("rich").completed(config).attributes == (
        "electrostatic_potential",
        "depth",
        "surface_direction",
    )
    assert preset("interior").completed(config) == config
    with pytest.raises(ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 50, got 49"):
        preset("pretrained").completed(SignatureConfig(n_eigenpairs=49))

"""A layout that is learned starts as the fixed one, and only what was asked for is learned."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

import igps
from batches import two_bodies
from bodies import bumpy_sphere
from igps.descriptors.registry import FIELD_NAMES, NAMES
from igps.nn.axes import Attribute, InteriorDistance, PairTwist, Potential
from igps.nn.histograms.pairs import PairHistogram

PARTS = ("bins", "classes", "filter")
# A description is a histogram of sum 1 or, by `pretrained`, made of vectors of length 1.
WITH_LAYOUT = {"interior", "gps", "multiscale", "rich", "pretrained", "fold", "molecular"}
COMBINED = ["interior+size", "rich+side", "interior+depth"]


@pytest.fixture(scope="module")
def batch():
    """A body with hollows and the same stretched, with what every descriptor of histograms needs.

    The attributes of molecules are made up.
    """
    config = igps.SignatureConfig(n_surface_samples=150, resolution=10, min_samples=0)
    for name in ("interior", "rich", "pretrained"):
        config = igps.descriptor(name).requirements.apply_to(config)
    vertices, faces = bumpy_sphere(3)
    bodies = [
        igps.Mesh(
            vertices * [stretch, 1, 1],
            faces,
        )
        for stretch in (1, 2)
    ]
    found = igps.collate([igps.compute_signature(body, config) for body in bodies])
    return replace(found, interior=with_residues(found.interior))


def with_residues(samples):
    """Add the attributes of molecules to samples, each of which is a residue of its own."""
    generator = torch.Generator().manual_seed(3)
    shape = samples.mask.shape
    directions = torch.randn(*shape, 3, generator=generator)
    rises = 1.5 + 2 * torch.rand(*shape, 1, generator=generator)
    places = torch.arange(shape[1]).expand(shape).unsqueeze(2)
    values = {
        "trace": torch.cat([20 * samples.points, normalize(directions, dim=2), rises, places], 2),
        "residue_shares": torch.rand(*shape, 25, generator=generator).softmax(dim=2),
    }
    for name in ("charge", "screened_potential", "hydropathy"):
        values[name] = torch.randn(shape, generator=generator)
    return replace(samples, attributes={**samples.attributes, **values})


@pytest.mark.parametrize("name", [*NAMES, *FIELD_NAMES])
def test_every_descriptor_has_a_layout_to_learn_or_says_that_it_has_none(name):
    if name in WITH_LAYOUT:
        assert list(igps.descriptor(name, learnable=True).parameters())
        return
    with pytest.raises(ValueError, match="learnable: expected a descriptor whose histograms have"):
        igps.descriptor(name, learnable=True)


@pytest.mark.parametrize("name", [*sorted(WITH_LAYOUT), *COMBINED])
def test_a_learned_layout_starts_as_the_fixed_one(name, batch):
    fixed = igps.descriptor(name)
    for module in fixed.modules():
        if isinstance(module, Attribute) and not module.is_fitted:
            module.fit(batch.interior.attributes[module.name].flatten())
    learned = igps.descriptor(fixed, learnable=True)
    found = learned(batch)  # with gradients, as in training
    difference = (found.detach() - fixed(batch)).flatten(1).abs().sum(dim=1)
    assert bool((difference <= 1e-6).all())
    assert not list(fixed.parameters())
    assert learned.name == fixed.name
    assert not learned.training
    (found * torch.rand(found.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
    for path, parameter in learned.named_parameters():
        assert parameter.grad is not None, path
        assert bool(parameter.grad.isfinite().all() and parameter.grad.any()), path


@pytest.mark.parametrize("name", ["interior", "interior+size"])
def test_samples_are_drawn_at_each_step_until_the_descriptor_is_evaluated(name, batch):
    drawing = igps.descriptor(name, n_training_samples=20)
    first = drawing(batch)
    assert not torch.equal(drawing(batch), first)
    assert torch.equal(drawing.eval()(batch), igps.descriptor(name)(batch))


@pytest.mark.parametrize("part", PARTS)
def test_only_what_is_named_is_learned(part):
    learned = igps.descriptor("interior", learnable=[part])
    [(name, parameter)] = learned.named_parameters()
    assert (
        name
        == {
            "classes": "histograms.0.axes.0.centres.log_gap",
            "bins": "histograms.0.axes.1.centres.log_gap",
            "filter": "histograms.0.embedding.log_gain",
        }[part]
    )
    assert len(parameter) == {"classes": 4, "bins": 64, "filter": 12}[part]


def test_names_of_axes_and_what_was_fitted_are_kept():
    axis = Attribute("depth", quantiles=3)
    axis.fit(torch.tensor([0.1, 0.2, 0.6, 0.9]))
    own = igps.HistogramDescriptor(
        [PairHistogram(["potential", "interior_distance"]), [PairHistogram([axis, PairTwist()])]]
    )
    own.scale = 0.3
    own.card = {"author": "me"}
    learned = igps.descriptor(own, learnable=True)
    torch.testing.assert_close(learned(two_bodies()).detach(), own(two_bodies()))
    assert learned.scale == 0.3
    assert learned.card == {"author": "me"}
    assert len(list(learned.parameters())) == 6


def test_an_embedding_that_is_shared_stays_shared():
    embedding = igps.SpectralEmbedding(n_eigenpairs=5)
    axes = [Potential(2), InteriorDistance(4)]
    own = igps.HistogramDescriptor([PairHistogram(axes, embedding), PairHistogram(axes, embedding)])
    first, second = igps.descriptor(own, learnable=True).histograms
    assert first.embedding is second.embedding is not embedding


def test_what_has_no_layout_says_so():
    with pytest.raises(ValueError, match=r"learnable: expected a descriptor whose .* got 'd2'"):
        igps.descriptor("d2", learnable=True)
    with pytest.raises(ValueError, match="learnable: expected one of bins, classes, filter, got"):
        igps.descriptor("interior", learnable=["edges"])

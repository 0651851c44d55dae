import pytest
import torch
from torch.testing import assert_close

import igps
from igps.descriptors.literature.d2 import D2
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads.base import Head
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.heads.learned import BlendedDistance, ProjectionHead
from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square


@pytest.fixture
def histograms():
    counts = torch.rand(12, 3, 8, generator=torch.Generator().manual_seed(0)).pow(3)
    counts[:, 1, :3] = 0
    return counts / counts.sum(dim=(1, 2), keepdim=True)


def test_head_gives_unit_vectors_and_finite_gradients_at_empty_cells(histograms):
    torch.manual_seed(0)
    head = ProjectionHead(width=5, n_hidden=16)
    histograms.requires_grad_()
    embedding = head(histograms)
    assert_close(embedding.norm(dim=1), torch.ones(12))
    embedding[:, 0].sum().backward()
    assert histograms.grad is not None
    assert histograms.grad.isfinite().all()
    assert histograms.grad.abs().max() > 0


def test_linear_head_with_identity_weights_ranks_like_hellingers_distance(histograms):
    head = ProjectionHead(width=24, n_hidden=0).eval()
    head(histograms)  # which tells its size
    with torch.no_grad():
        head.layers[1].weight.copy_(torch.eye(24))
        head.layers[1].bias.zero_()
    embedding = head(histograms)
    # Of histograms that sum to 1 the square roots are unit vectors; Hellinger's distance is theirs over √2.
    roots = histograms.detach().flatten(1).sqrt()
    squared = torch.cdist(embedding, embedding).square()
    assert_close(squared, torch.cdist(roots, roots).square(), atol=1e-6, rtol=1e-5)


def test_fit_centres_and_scales(histograms):
    head = ProjectionHead(width=3, n_hidden=0).eval()
    assert head.fit(histograms, torch.zeros(12), part_cells=(4, 20)) is head
    inputs = (histograms.flatten(1).sqrt() - head.mean) / head.scale
    assert_close(inputs.mean(dim=0), torch.zeros(24), atol=1e-5, rtol=0)
    assert_close(inputs.std(dim=0).mean(), torch.ones(()))
    linear = head.layers[1]
    embedding = head(histograms)
    assert_close(embedding, torch.nn.functional.normalize(linear(inputs), dim=1))


def test_wrong_number_of_cells_is_named(histograms):
    head = ProjectionHead().fit(histograms, torch.zeros(12))
    with pytest.raises(ValueError, match="descriptions: expected 24 cells as in training, got 16"):
        head(histograms[:, :2])


def test_impossible_inputs_are_refused(histograms):
    with pytest.raises(ValueError, match="width: expected at least 1, got 0"):
        ProjectionHead(width=0)
    with pytest.raises(ValueError, match="at least two training shapes, got 1"):
        ProjectionHead().fit(histograms[:1], torch.zeros(1))
    with pytest.raises(
        ValueError, match="descriptions: expected histograms, entries ≥ 0, got a negative one"
    ):
        ProjectionHead()(histograms - 0.5)


def test_share_goes_from_plain_to_learned(histograms):
    torch.manual_seed(1)
    head = ProjectionHead(width=4).eval()
    embedding = head(histograms)
    learned = 1 - embedding @ embedding.T
    for share, expected in ((0.0, chi_square(histograms, histograms)), (1.0, learned)):
        distance = BlendedDistance(head, share=share)
        distance.calibrate(histograms)
        pairs = torch.triu_indices(12, 12, 1).unbind()
        result = distance(histograms, histograms)
        assert_close(result, expected / expected[pairs].median(), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    "make",
    [
        ProjectionHead,
        WhitenedHead,
        KernelHead,
        WCCNHead,
        TwoLevelHead,
        lambda: WhitenedHead(prior=TwoLevelHead()),
        lambda: KernelHead(TwoLevelHead()),
    ],
)
def test_the_head_alone_is_what_a_descriptor_under_it_deploys(histograms, make):
    """Its distance and no other, but for the unit that calibration gives it."""
    torch.manual_seed(1)
    labels = torch.arange(4).repeat_interleave(3)
    head = make().eval()
    if isinstance(prior := getattr(head, "prior", None), Head):
        prior.fit(histograms, labels)
    head.fit(histograms, labels)
    deployed = EmbeddedDescriptor(D2(), head)
    vectors = head(histograms)
    expected = deployed.distances(vectors[:5], vectors)
    distance = BlendedDistance(head, share=1.0)
    assert_close(distance(histograms[:5], histograms), expected, atol=1e-6, rtol=1e-4)
    distance.calibrate(histograms)
    pairs = torch.triu_indices(12, 12, 1).unbind()
    unit = deployed.distances(vectors, vectors)[pairs].median()
    assert unit > 0
    assert_close(
        distance(histograms[:5], histograms),
        expected / unit,
        atol=1e-5,
        rtol=1e-4,
    )


def test_without_head_it_is_the_paper(histograms):
    distance = BlendedDistance()
    distance.calibrate(histograms)
    assert_close(
        distance(histograms, histograms), chi_square(histograms, histograms), atol=0, rtol=0
    )


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_share_out_of_range_is_refused(share):
    with pytest.raises(ValueError, match="share"):
        BlendedDistance(share=share)


def test_a_trained_head_is_kept_in_the_file_of_a_descriptor(histograms, tmp_path):
    head = ProjectionHead(width=4, n_hidden=6).fit(histograms, torch.zeros(12))
    counted = PairHistogram([Potential(2), InteriorDistance(8)])  # 3 pairs of classes
    model = EmbeddedDescriptor(HistogramDescriptor(counted), head, name="mine")
    with pytest.raises(ValueError, match=r"a head that was never called\. Train it"):
        model.save(tmp_path / "mine.safetensors")
    expected = head.eval()(histograms)
    model.save(tmp_path / "mine.safetensors")
    loaded = igps.load(tmp_path / "mine.safetensors")
    assert_close(loaded.head(histograms), expected, rtol=0, atol=0)

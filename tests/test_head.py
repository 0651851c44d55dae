from __future__ import annotations

import pytest
import torch

from igps.nn.head import CorrectedDistance, LearnedChiSquare, MetricHead
from igps.retrieval import chi_square, hellinger


@pytest.fixture
def histograms() -> torch.Tensor:
    counts = torch.rand(12, 3, 8, generator=torch.Generator().manual_seed(0)).pow(3)
    counts[:, 1, :3] = 0
    return counts / counts.sum(dim=(1, 2), keepdim=True)


def test_head_gives_unit_vectors_and_finite_gradients_at_empty_cells(histograms: torch.Tensor) -> None:
    torch.manual_seed(0)
    head = MetricHead(24, width=5, n_hidden=16)
    histograms.requires_grad_()
    embedding = head(histograms)
    torch.testing.assert_close(embedding.norm(dim=1), torch.ones(12))
    embedding[:, 0].sum().backward()
    assert histograms.grad is not None
    assert histograms.grad.isfinite().all()
    assert histograms.grad.abs().max() > 0


def test_linear_head_with_identity_weights_ranks_like_hellinger(histograms: torch.Tensor) -> None:
    head = MetricHead(24, width=24, n_hidden=0).eval()
    with torch.no_grad():
        head.layers[1].weight.copy_(torch.eye(24))  # type: ignore[union-attr]
        head.layers[1].bias.zero_()  # type: ignore[union-attr]
    embedding = head(histograms)
    # ‖√a − √b‖² = 2 − 2 Σ √(ab), and Hellinger's distance is its root over √2.
    squared = torch.cdist(embedding, embedding).square() / 2
    torch.testing.assert_close(squared, hellinger(histograms, histograms).square(), atol=1e-6, rtol=1e-5)


def test_calibration_centres_and_scales(histograms: torch.Tensor) -> None:
    head = MetricHead(24)
    head.calibrate(histograms)
    inputs = (histograms.flatten(1).sqrt() - head.mean) / head.scale
    torch.testing.assert_close(inputs.mean(dim=0), torch.zeros(24), atol=1e-5, rtol=0)
    torch.testing.assert_close(inputs.std(dim=0).mean(), torch.ones(()))


def test_wrong_number_of_cells_is_named(histograms: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="expected 25 cells, got 24"):
        MetricHead(25)(histograms)


def test_learned_chi_square_starts_plain_and_stays_non_negative(histograms: torch.Tensor) -> None:
    distance = LearnedChiSquare((3, 1))
    torch.testing.assert_close(distance(histograms, histograms), chi_square(histograms, histograms))
    optimiser = torch.optim.SGD(distance.parameters(), lr=100)
    for _ in range(5):
        optimiser.zero_grad()
        distance(histograms, histograms).sum().backward()
        optimiser.step()
    assert (distance.weights >= 0).all()
    assert (distance.weights < 0.5).all()


def test_share_goes_from_plain_to_learned(histograms: torch.Tensor) -> None:
    torch.manual_seed(1)
    head = MetricHead(24, width=4).eval()
    embedding = head(histograms)
    learned = 1 - embedding @ embedding.T
    for share, expected in ((0.0, chi_square(histograms, histograms)), (1.0, learned)):
        distance = CorrectedDistance(head, share=share)
        distance.calibrate(histograms)
        pairs = torch.triu_indices(12, 12, 1).unbind()
        result = distance(histograms, histograms)
        torch.testing.assert_close(result, expected / expected[pairs].median(), atol=1e-5, rtol=1e-4)


def test_without_head_it_is_the_paper(histograms: torch.Tensor) -> None:
    distance = CorrectedDistance()
    distance.calibrate(histograms)
    torch.testing.assert_close(distance(histograms, histograms), chi_square(histograms, histograms), atol=0, rtol=0)


def test_state_round_trips(histograms: torch.Tensor) -> None:
    torch.manual_seed(2)
    one = CorrectedDistance(MetricHead(24).eval(), LearnedChiSquare((3, 8)))
    one.head.calibrate(histograms)  # type: ignore[union-attr, operator]
    one.calibrate(histograms)
    two = CorrectedDistance(MetricHead(24).eval(), LearnedChiSquare((3, 8)))
    two.load_state_dict(one.state_dict())
    torch.testing.assert_close(two(histograms, histograms), one(histograms, histograms), atol=0, rtol=0)


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_share_out_of_range_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match="share"):
        CorrectedDistance(share=share)

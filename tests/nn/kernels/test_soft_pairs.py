from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from conftest import torch_threads
from igps.nn._kernels.hard_pairs import class_pairs
from igps.nn._kernels.soft_pairs import soft_pair_histogram
from loops import distances, pair_histogram_by_loops

pytestmark = pytest.mark.usefixtures("both_ways")

CENTRES = torch.tensor([0.4, 0.9, 1.0, 1.6, 2.7], dtype=torch.float64)
EUCLIDEAN_CENTRES = torch.tensor([0.2, 0.35, 0.8], dtype=torch.float64)
COARSE_CENTRES = torch.tensor([0.6, 2.1], dtype=torch.float64)
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")),
]


def by_loops(axes: Sequence[tuple[Tensor, Tensor]], memberships: Tensor) -> np.ndarray:
    return pair_histogram_by_loops(memberships, [(distances(points), centres.tolist()) for points, centres in axes])


def dense(memberships: Tensor, *axes: Tensor) -> Tensor:
    """The definition over all pairs at once, for its gradients."""
    i, j = torch.triu_indices(len(memberships), len(memberships), 1, device=memberships.device)

    def share(points: Tensor, centres: Tensor) -> Tensor:
        distance = (points[i] - points[j]).norm(dim=1, keepdim=True)
        passed = ((distance - centres[:-1]) / (centres[1:] - centres[:-1])).clamp(0, 1)
        ones = torch.ones_like(distance)
        return torch.cat([ones, passed], dim=1) - torch.cat([passed, 0 * ones], dim=1)

    shares = share(*axes[:2])
    for points, centres in zip(axes[2::2], axes[3::2], strict=True):
        shares = shares.unsqueeze(-1) * share(points, centres).view(len(i), *[1] * (shares.ndim - 1), -1)
    rows = []
    for a, b in class_pairs(memberships.shape[1]):
        weight = memberships[i, a] * memberships[j, b] + (memberships[i, b] * memberships[j, a] if a != b else 0)
        rows.append(torch.tensordot(weight, shares, dims=1))
    return torch.stack(rows) / len(i)


def soft(memberships: Tensor, *axes: Tensor) -> Tensor:
    return soft_pair_histogram(memberships, list(zip(axes[::2], axes[1::2], strict=True)))


def inputs(n_points: int, n_axes: int, *, n_classes: int = 3, seed: int = 0) -> list[Tensor]:
    """Memberships, many of them zero; of each axis points and centres."""
    generator = torch.Generator().manual_seed(seed)
    embedding = torch.randn(n_points, 4, generator=generator, dtype=torch.float64) * 0.6
    memberships = torch.rand(n_points, n_classes, generator=generator, dtype=torch.float64)
    memberships *= torch.rand(n_points, n_classes, generator=generator) < 0.5
    memberships[memberships.sum(dim=1) == 0, 0] = 1
    memberships /= memberships.sum(dim=1, keepdim=True)
    points = torch.rand(n_points, 3, generator=generator, dtype=torch.float64)
    coarse = torch.randn(n_points, 2, generator=generator, dtype=torch.float64)
    axes = [embedding, CENTRES.clone(), points, EUCLIDEAN_CENTRES.clone(), coarse, COARSE_CENTRES.clone()]
    return [memberships, *axes[: 2 * n_axes]]


@pytest.mark.parametrize("n_axes", [1, 2, 3])
@pytest.mark.parametrize("n_classes", [1, 3, 5])
def test_equals_brute_force_loop(n_axes: int, n_classes: int) -> None:
    memberships, *axes = values = inputs(40, n_axes, n_classes=n_classes)
    expected = by_loops(list(zip(axes[::2], axes[1::2], strict=True)), memberships)
    result = soft(*values)
    assert result.shape == (n_classes * (n_classes + 1) // 2, *(5, 3, 2)[:n_axes])
    np.testing.assert_allclose(result, expected, atol=1e-12)
    assert float(result.sum()) == pytest.approx(1, abs=1e-12)
    single = soft(*(value.float() for value in values))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, expected, atol=1e-6)


@pytest.mark.parametrize(
    "centres",
    [
        [0.5, 0.5 + 1e-9, 0.5 + 2e-9, 0.9, 0.9001, 1.1],  # several within one step of the table
        [1e-3, 1e4],
        [-1.0, 0.7, 0.8],
        [0.001, 0.002],
    ],
)
def test_any_spacing_of_centres_is_exact(centres: list[float]) -> None:
    memberships, embedding, _ = inputs(40, 1)
    layout = torch.tensor(centres, dtype=torch.float64)
    result = soft(memberships, embedding, layout)
    np.testing.assert_allclose(result, by_loops([(embedding, layout)], memberships), atol=1e-12)


def test_distance_on_a_centre_is_exact() -> None:
    line = torch.arange(9, dtype=torch.float64)[:, None]
    centres = torch.tensor([1.0, 3.0, 4.0, 7.0], dtype=torch.float64)
    result = soft(torch.ones(9, 1, dtype=torch.float64), line, centres)
    counts = {d: 9 - d for d in range(1, 9)}
    expected = [counts[1] + counts[2] / 2, counts[2] / 2 + counts[3]]
    expected += [
        counts[4] + counts[5] * 2 / 3 + counts[6] / 3,
        counts[5] / 3 + counts[6] * 2 / 3 + counts[7] + counts[8],
    ]
    np.testing.assert_allclose(result[0] * 36, expected, atol=1e-12)


@pytest.mark.parametrize("n_axes", [1, 2, 3])
def test_blocks_and_threads_do_not_show(n_axes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    leaves = [value.requires_grad_() for value in inputs(90, n_axes)]
    whole = soft(*leaves)
    upstream = torch.randn(whole.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    expected = [whole.detach(), *torch.autograd.grad(whole, leaves, upstream)]
    monkeypatch.setattr("igps.nn._kernels.soft_pairs._BLOCK", 7)
    monkeypatch.setattr("igps.nn._kernels.soft_pairs._MOST_KEPT", 0)
    for n_threads in (1, 3):
        with torch_threads(n_threads):
            result = soft(*leaves)
            gradients = torch.autograd.grad(result, leaves, upstream)
            with ThreadPoolExecutor(1) as pool:  # a new thread inherits what the workers must not have changed
                assert pool.submit(torch.get_num_threads).result() == torch.get_num_threads() == n_threads
        for value, other in zip([result.detach(), *gradients], expected, strict=True):
            np.testing.assert_allclose(value, other, atol=1e-13)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n_axes", [1, 2, 3])
@pytest.mark.parametrize("kept", [True, False])
def test_gradients_equal_those_of_the_dense_definition(
    n_axes: int, kept: bool, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by memberships that are zero, whose gradient is not."""
    if not kept:
        monkeypatch.setattr("igps.nn._kernels.soft_pairs._MOST_KEPT", 0)
    leaves = [value.to(device).requires_grad_() for value in inputs(80, n_axes)]
    expected, result = dense(*leaves), soft(*leaves)
    upstream = torch.randn(result.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64).to(device)
    for by_hand, by_torch in zip(
        torch.autograd.grad(result, leaves, upstream), torch.autograd.grad(expected, leaves, upstream), strict=True
    ):
        assert (by_torch.abs() > 1e-9).any()
        torch.testing.assert_close(by_hand, by_torch, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("n_axes", [1, 2, 3])
def test_gradcheck(n_axes: int) -> None:
    _, *axes = inputs(9, n_axes, seed=1)
    logits = torch.randn(9, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    for points, layout in zip(axes[::2], axes[1::2], strict=True):
        kinks = (torch.pdist(points)[:, None] - layout).abs()
        assert kinks.min() > 1e-4
    leaves = [value.requires_grad_() for value in (logits, *axes)]

    def histogram(logits: Tensor, *axes: Tensor) -> Tensor:
        return soft(logits.softmax(dim=1), *axes)

    for gradient in torch.autograd.grad(histogram(*leaves).square().sum(), leaves):
        assert (gradient.abs() > 1e-9).any()
    assert torch.autograd.gradcheck(histogram, leaves)


def test_coincident_points_have_finite_gradients() -> None:
    embedding = torch.zeros(6, 3, dtype=torch.float64)
    embedding[3:] = 0.5
    embedding.requires_grad_()
    centres = torch.tensor([-0.1, 0.3, 1.0], dtype=torch.float64)  # a slope at distance 0
    result = soft(torch.ones(6, 1, dtype=torch.float64), embedding, centres)
    (gradient,) = torch.autograd.grad(result[0, 0], embedding)
    assert torch.isfinite(gradient).all()
    result = soft(torch.ones(6, 1, dtype=torch.float64), embedding, centres)
    (gradient,) = torch.autograd.grad(result[0, 2], embedding)
    # 9 of the 15 pairs are at √0.75; pulling one point away along the diagonal stretches 3 of them by 1/√3 each axis.
    np.testing.assert_allclose(gradient[3:], 3 / 15 / 0.7 / math.sqrt(3), rtol=1e-9)


def test_narrow_ramps_tend_to_a_plain_histogram() -> None:
    """Centres in close pairs around the edges: the bins between hold what falls between the edges."""
    embedding = inputs(60, 1)[1]
    edges = torch.tensor([0.5, 1.0, 1.7, 2.0], dtype=torch.float64)
    layout = torch.stack([edges - 1e-9, edges + 1e-9], dim=1).flatten()
    result = soft(torch.ones(60, 1, dtype=torch.float64), embedding, layout)[0]
    bounds = [0, *edges.tolist(), np.inf]
    counts = np.histogram(torch.pdist(embedding), bounds)[0] / (60 * 59 / 2)
    merged = [result[0], *(result[1:-1].view(-1, 2).sum(dim=1)), result[-1]]
    # Within an interval between close pairs, the count is shared by its two ends.
    np.testing.assert_allclose(torch.stack(merged), counts, atol=1e-12)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("n_axes", [1, 2, 3])
def test_cuda_equals_cpu(n_axes: int) -> None:
    values = inputs(80, n_axes)
    np.testing.assert_allclose(soft(*(value.cuda() for value in values)).cpu(), soft(*values), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": torch.zeros(1, 3), "memberships": torch.ones(1, 1)}, "two points"),
        ({"points": torch.zeros(4, 3)}, r"shape \(P, D\)"),
        ({"points": torch.full((5, 3), torch.nan)}, "finite"),
        ({"memberships": torch.full((5, 2), 0.4)}, "sum 1"),
        ({"memberships": torch.tensor([[1.5, -0.5]] * 5)}, "non-negative"),
        ({"memberships": torch.full((5, 2), torch.nan)}, "sum 1"),
        ({"centres": torch.tensor([0.5, 0.5, 1.0])}, "ascending"),
        ({"centres": torch.tensor([0.5, torch.inf])}, "ascending"),
        ({"centres": torch.tensor([-2.0, -1.0])}, "positive"),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_bad_input_is_refused(change: dict[str, Tensor], message: str, first: bool) -> None:
    good = {"memberships": torch.ones(5, 1), "points": torch.rand(5, 3), "centres": torch.tensor([0.1, 0.2])}
    changed = {**good, **change}
    axes = [(changed["points"], changed["centres"])]
    if "points" not in change or len(change) == 1:
        other = (good["points"], good["centres"])
        axes = [*axes, other] if first else [other, *axes]
    soft_pair_histogram(good["memberships"], [(good["points"], good["centres"])] * 2)
    with pytest.raises(ValueError, match=message):
        soft_pair_histogram(changed["memberships"], axes)


@pytest.mark.parametrize("joint", [False, True])
def test_no_cell_is_negative(joint: bool) -> None:
    """Isolated pairs just below a centre: what rounding leaves in the cell before it would have no other to hide in."""
    generator = torch.Generator().manual_seed(0)
    centres = (torch.arange(12) + 0.5) / 3
    below = torch.nextafter(centres[1:], torch.zeros(())).repeat(40)
    for length in torch.cat([below, below * (1 - 6e-8 * torch.rand(len(below), generator=generator))]):
        direction = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
        ends = torch.stack([torch.zeros(3), length * direction])
        soft_classes = torch.rand(2, 1, generator=generator)
        memberships = torch.cat([soft_classes, 1 - soft_classes], dim=1)
        axes = [(ends, centres), (ends.roll(1, dims=1), centres)] if joint else [(ends, centres)]
        histogram = soft_pair_histogram(memberships, axes)
        assert histogram.min() >= 0
        assert float(histogram.sum()) == pytest.approx(1, abs=1e-6)

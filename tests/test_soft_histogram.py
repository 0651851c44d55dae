from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from igps.nn.histogram import (
    OrderedCentres,
    PairHistogram,
    class_pairs,
    pair_histogram,
    potential_memberships,
    soft_pair_histogram,
)

CENTRES = torch.tensor([0.4, 0.9, 1.0, 1.6, 2.7], dtype=torch.float64)
EUCLIDEAN_CENTRES = torch.tensor([0.2, 0.35, 0.8], dtype=torch.float64)
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")),
]


def hat(value: float, centres: Sequence[float]) -> list[float]:
    """The linear kernel of one value, one centre at a time."""
    shares = [0.0] * len(centres)
    if value <= centres[0]:
        shares[0] = 1.0
    elif value >= centres[-1]:
        shares[-1] = 1.0
    else:
        upper = next(k for k, centre in enumerate(centres) if centre > value)
        shares[upper] = (value - centres[upper - 1]) / (centres[upper] - centres[upper - 1])
        shares[upper - 1] = 1 - shares[upper]
    return shares


def by_loops(axes: Sequence[tuple[Tensor, Tensor]], memberships: Tensor) -> np.ndarray:
    """The definition, one pair at a time."""
    m = memberships.tolist()
    n_points, n_classes = memberships.shape
    shares = {}
    for i in range(n_points):
        for j in range(i):
            hats = [hat(math.dist(points[i], points[j]), centres.tolist()) for points, centres in axes]
            shares[i, j] = np.array(hats[0]) if len(hats) == 1 else np.outer(*hats)
    histogram = []
    for a, b in class_pairs(n_classes):
        weights = {(i, j): m[i][a] * m[j][b] + (m[i][b] * m[j][a] if a != b else 0) for i, j in shares}
        histogram.append(sum(weights[pair] * share for pair, share in shares.items()))
    return np.stack(histogram) / len(shares)


def dense(embedding: Tensor, memberships: Tensor, centres: Tensor, *other: Tensor) -> Tensor:
    """The definition over all pairs at once, for its gradients."""
    i, j = torch.triu_indices(len(embedding), len(embedding), 1, device=embedding.device)

    def share(points: Tensor, centres: Tensor) -> Tensor:
        distance = (points[i] - points[j]).norm(dim=1, keepdim=True)
        passed = ((distance - centres[:-1]) / (centres[1:] - centres[:-1])).clamp(0, 1)
        ones = torch.ones_like(distance)
        return torch.cat([ones, passed], dim=1) - torch.cat([passed, 0 * ones], dim=1)

    shares = share(embedding, centres)
    if other:
        shares = shares[:, :, None] * share(*other)[:, None, :]
    rows = []
    for a, b in class_pairs(memberships.shape[1]):
        weight = memberships[i, a] * memberships[j, b] + (memberships[i, b] * memberships[j, a] if a != b else 0)
        rows.append(torch.tensordot(weight, shares, dims=1))
    return torch.stack(rows) / len(i)


def soft(embedding: Tensor, memberships: Tensor, centres: Tensor, *other: Tensor) -> Tensor:
    if not other:
        return soft_pair_histogram(embedding, memberships, centres)
    return soft_pair_histogram(embedding, memberships, centres, points=other[0], euclidean_centres=other[1])


def inputs(n_points: int, *, joint: bool, n_classes: int = 3, seed: int = 0) -> list[Tensor]:
    """Embedding, memberships (many of them zero), centres; and positions and their centres."""
    generator = torch.Generator().manual_seed(seed)
    embedding = torch.randn(n_points, 4, generator=generator, dtype=torch.float64) * 0.6
    memberships = torch.rand(n_points, n_classes, generator=generator, dtype=torch.float64)
    memberships *= torch.rand(n_points, n_classes, generator=generator) < 0.5
    memberships[memberships.sum(dim=1) == 0, 0] = 1
    memberships /= memberships.sum(dim=1, keepdim=True)
    points = torch.rand(n_points, 3, generator=generator, dtype=torch.float64)
    return [embedding, memberships, CENTRES.clone(), *([points, EUCLIDEAN_CENTRES.clone()] if joint else [])]


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("n_classes", [1, 3, 5])
def test_equals_brute_force_loop(joint: bool, n_classes: int) -> None:
    values = inputs(40, joint=joint, n_classes=n_classes)
    axes = [(values[0], values[2]), *([(values[3], values[4])] if joint else [])]
    expected = by_loops(axes, values[1])
    result = soft(*values)
    assert result.shape == (n_classes * (n_classes + 1) // 2, 5, *([3] if joint else []))
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
    embedding, memberships, _ = inputs(40, joint=False)
    layout = torch.tensor(centres, dtype=torch.float64)
    result = soft_pair_histogram(embedding, memberships, layout)
    np.testing.assert_allclose(result, by_loops([(embedding, layout)], memberships), atol=1e-12)


def test_distance_on_a_centre_is_exact() -> None:
    line = torch.arange(9, dtype=torch.float64)[:, None]
    centres = torch.tensor([1.0, 3.0, 4.0, 7.0], dtype=torch.float64)
    result = soft_pair_histogram(line, torch.ones(9, 1, dtype=torch.float64), centres)
    counts = {d: 9 - d for d in range(1, 9)}
    expected = [counts[1] + counts[2] / 2, counts[2] / 2 + counts[3]]
    expected += [
        counts[4] + counts[5] * 2 / 3 + counts[6] / 3,
        counts[5] / 3 + counts[6] * 2 / 3 + counts[7] + counts[8],
    ]
    np.testing.assert_allclose(result[0] * 36, expected, atol=1e-12)


@pytest.mark.parametrize("joint", [False, True])
def test_blocks_and_threads_do_not_show(joint: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    leaves = [value.requires_grad_() for value in inputs(90, joint=joint)]
    whole = soft(*leaves)
    upstream = torch.randn(whole.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    expected = [whole.detach(), *torch.autograd.grad(whole, leaves, upstream)]
    threads = torch.get_num_threads()
    monkeypatch.setattr("igps.nn.histogram._BLOCK", 7)
    monkeypatch.setattr("igps.nn.histogram._MOST_KEPT", 0)
    for n_threads in (1, 3):
        torch.set_num_threads(n_threads)
        try:
            result = soft(*leaves)
            gradients = torch.autograd.grad(result, leaves, upstream)
            with ThreadPoolExecutor(1) as pool:  # a new thread inherits what the workers must not have changed
                assert pool.submit(torch.get_num_threads).result() == torch.get_num_threads() == n_threads
        finally:
            torch.set_num_threads(threads)
        for value, other in zip([result.detach(), *gradients], expected, strict=True):
            np.testing.assert_allclose(value, other, atol=1e-13)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("kept", [True, False])
def test_gradients_equal_those_of_the_dense_definition(
    joint: bool, kept: bool, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by memberships that are zero, whose gradient is not."""
    if not kept:
        monkeypatch.setattr("igps.nn.histogram._MOST_KEPT", 0)
    leaves = [value.to(device).requires_grad_() for value in inputs(80, joint=joint)]
    expected, result = dense(*leaves), soft(*leaves)
    upstream = torch.randn(result.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64).to(device)
    for by_hand, by_torch in zip(
        torch.autograd.grad(result, leaves, upstream), torch.autograd.grad(expected, leaves, upstream), strict=True
    ):
        assert (by_torch.abs() > 1e-9).any()
        torch.testing.assert_close(by_hand, by_torch, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("joint", [False, True])
def test_gradcheck(joint: bool) -> None:
    embedding, _, centres, *other = inputs(9, joint=joint, seed=1)
    logits = torch.randn(9, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    for points, layout in [(embedding, centres), *([tuple(other)] if joint else [])]:
        kinks = (torch.pdist(points)[:, None] - layout).abs()
        assert kinks.min() > 1e-4
    leaves = [value.requires_grad_() for value in (embedding, logits, centres, *other)]

    def histogram(embedding: Tensor, logits: Tensor, *rest: Tensor) -> Tensor:
        return soft(embedding, logits.softmax(dim=1), *rest)

    for gradient in torch.autograd.grad(histogram(*leaves).square().sum(), leaves):
        assert (gradient.abs() > 1e-9).any()
    assert torch.autograd.gradcheck(histogram, leaves)


def test_gradient_through_classes_and_layout() -> None:
    """By the parameters of a learned layout and the embedding, the potential being the embedding's norm."""
    embedding = inputs(9, joint=False, seed=2)[0].requires_grad_()
    layer = PairHistogram(n_classes=3, n_bins=4, distance_range=2.0, learnable=True).double()
    names = ["distance_centres.log_gap", "potential_centres.log_gap"]

    def histogram(embedding: Tensor, *parameters: Tensor) -> Tensor:
        mask = torch.ones(1, 9, dtype=torch.bool)
        batch = (embedding[None], embedding.norm(dim=1)[None], mask)
        return torch.func.functional_call(layer, dict(zip(names, parameters, strict=True)), batch)

    generator = torch.Generator().manual_seed(3)
    parameters = [torch.randn(n, generator=generator, dtype=torch.float64, requires_grad=True) for n in (4, 3)]
    leaves = (embedding, *parameters)
    for gradient in torch.autograd.grad(histogram(*leaves).square().sum(), leaves):
        assert (gradient.abs() > 1e-6).any()
    assert torch.autograd.gradcheck(histogram, leaves)


def test_coincident_points_have_finite_gradients() -> None:
    embedding = torch.zeros(6, 3, dtype=torch.float64)
    embedding[3:] = 0.5
    embedding.requires_grad_()
    centres = torch.tensor([-0.1, 0.3, 1.0], dtype=torch.float64)  # a slope at distance 0
    result = soft_pair_histogram(embedding, torch.ones(6, 1, dtype=torch.float64), centres)
    (gradient,) = torch.autograd.grad(result[0, 0], embedding)
    assert torch.isfinite(gradient).all()
    result = soft_pair_histogram(embedding, torch.ones(6, 1, dtype=torch.float64), centres)
    (gradient,) = torch.autograd.grad(result[0, 2], embedding)
    # 9 of the 15 pairs are at √0.75; pulling one point away along the diagonal stretches 3 of them by 1/√3 each axis.
    np.testing.assert_allclose(gradient[3:], 3 / 15 / 0.7 / math.sqrt(3), rtol=1e-9)


def test_hats_are_the_linear_kernel() -> None:
    potential = torch.tensor([0.0, 0.1, 0.3, 0.35, 0.5, 0.9, 1.0, 5.0], dtype=torch.float64)
    centres = [0.1, 0.35, 0.4, 0.95]
    expected = [hat(float(value), centres) for value in potential]
    result = potential_memberships(potential, torch.tensor(centres, dtype=torch.float64))
    np.testing.assert_allclose(result, expected, atol=1e-14)
    assert torch.equal(potential_memberships(potential, torch.tensor([0.4])), torch.ones(8, 1, dtype=torch.float64))


def test_soft_classes_tend_to_hard_ones() -> None:
    """Where every potential is at the centre of its class, the soft layout is the hard one."""
    embedding = inputs(60, joint=False)[0]
    centres = (torch.arange(4, dtype=torch.float64) + 0.5) * 1.5 / 4
    potential = centres[torch.randint(4, (60,), generator=torch.Generator().manual_seed(0))]
    mask = torch.ones(1, 60, dtype=torch.bool)
    result = PairHistogram(n_bins=16, soft=True).double()(embedding[None], potential[None], mask)[0]
    np.testing.assert_allclose(result, pair_histogram(embedding, potential, n_bins=16), atol=1e-8)


def test_narrow_ramps_tend_to_a_plain_histogram() -> None:
    """Centres in close pairs around the edges: the bins between hold what falls between the edges."""
    embedding = inputs(60, joint=False)[0]
    edges = torch.tensor([0.5, 1.0, 1.7, 2.0], dtype=torch.float64)
    layout = torch.stack([edges - 1e-9, edges + 1e-9], dim=1).flatten()
    result = soft_pair_histogram(embedding, torch.ones(60, 1, dtype=torch.float64), layout)[0]
    bounds = [0, *edges.tolist(), np.inf]
    counts = np.histogram(torch.pdist(embedding), bounds)[0] / (60 * 59 / 2)
    merged = [result[0], *(result[1:-1].view(-1, 2).sum(dim=1)), result[-1]]
    # Within an interval between close pairs, the count is shared by its two ends.
    np.testing.assert_allclose(torch.stack(merged), counts, atol=1e-12)


def test_hard_classes_equal_the_hard_path() -> None:
    """One-hot memberships and equal bins, with and without a Euclidean dimension that is summed out."""
    embedding, _, _, points, _ = inputs(70, joint=True)
    potential, mask = embedding.norm(dim=1), torch.ones(1, 70, dtype=torch.bool)
    expected = pair_histogram(embedding, potential, n_bins=32)
    layer = PairHistogram(n_bins=32, n_euclidean_bins=16).double()
    result = layer(embedding[None], potential[None], mask, points=points[None])[0]
    assert result.shape == (10, 32, 16)
    np.testing.assert_allclose(result.sum(dim=2), expected, atol=1e-7)
    other = pair_histogram(points, potential, n_bins=16, distance_range=1.0)
    np.testing.assert_allclose(result.sum(dim=1), other, atol=1e-7)


def test_values_beyond_the_ranges_stay_in_the_last_cells() -> None:
    embedding, _, _, points, _ = inputs(50, joint=True)
    far, mask = embedding * 1000, torch.ones(1, 50, dtype=torch.bool)
    layer = PairHistogram(n_euclidean_bins=4, learnable=True).double()
    result = layer(far[None], far.norm(dim=1)[None], mask, points=points[None] * 1000)[0].detach()
    assert float(result.sum()) == pytest.approx(1)
    assert float(result[-1, -1, -1]) > 0.9


@pytest.mark.parametrize("options", [{"soft": True}, {"learnable": True, "n_euclidean_bins": 4}])
def test_padding_never_shows(options: dict[str, int]) -> None:
    embedding, _, _, points, _ = inputs(40, joint=True)
    mask = torch.zeros(2, 40, dtype=torch.bool)
    mask[0], mask[1, ::3] = True, True
    padded = embedding.repeat(2, 1, 1)
    padded[~mask] = torch.nan
    padded.requires_grad_()
    layer = PairHistogram(n_bins=8, **options)  # type: ignore[arg-type]
    batch = layer(padded, padded.norm(dim=2), mask, points=points.repeat(2, 1, 1))
    single = embedding[::3].clone().requires_grad_()
    alone = layer(single[None], single.norm(dim=1)[None], torch.ones(1, 14, dtype=torch.bool), points=points[None, ::3])
    torch.testing.assert_close(batch[1], alone[0], rtol=0, atol=1e-14)
    (expected,) = torch.autograd.grad(alone.square().sum(), single)
    (gradient,) = torch.autograd.grad(batch[1].square().sum(), padded)
    torch.testing.assert_close(gradient[1, ::3], expected, rtol=0, atol=1e-12)
    assert expected.abs().max() > 1e-6


@pytest.mark.parametrize("n_euclidean_bins", [0, 16])
def test_learned_layout_starts_as_the_fixed_one(n_euclidean_bins: int) -> None:
    embedding, _, _, points, _ = inputs(60, joint=True)
    attributes = {"depth": points[None, :, 0]}
    rest = {"attributes": {"depth": [-0.1, 0.2, 0.5]}, "n_euclidean_bins": n_euclidean_bins}
    batch = (embedding[None].float(), embedding.norm(dim=1)[None].float(), torch.ones(1, 60, dtype=torch.bool))
    fixed, learned = (
        PairHistogram(**options, **rest)(*batch, attributes=attributes, points=points[None].float())  # type: ignore
        for options in ({"soft": True}, {"learnable": True})
    )
    assert not fixed.requires_grad
    assert learned.requires_grad
    np.testing.assert_allclose(learned.detach(), fixed, atol=1e-6)


def test_fixed_soft_layout_is_centred_in_the_hard_one() -> None:
    layer = PairHistogram(n_classes=4, n_bins=8, distance_range=4.0, potential_range=1.5, soft=True)
    np.testing.assert_allclose(layer.distance_centres(), np.arange(8) * 0.5 + 0.25, rtol=1e-6)
    np.testing.assert_allclose(layer.potential_centres(), np.arange(4) * 0.375 + 0.1875, rtol=1e-6)


@pytest.mark.parametrize("start", [[0.1, 0.2, 0.5, 0.6], [-3.0, -1.0, 0.0, 7.0], [0.4]])
def test_learned_centres_stay_in_order(start: list[float]) -> None:
    centres = OrderedCentres(start, learnable=True)
    assert centres.log_gap is not None
    np.testing.assert_allclose(centres().detach(), start, atol=1e-6)
    generator = torch.Generator().manual_seed(0)
    for spread in (1.0, 30.0, 1000.0):
        with torch.no_grad():
            centres.log_gap.copy_(torch.randn(len(start), generator=generator) * spread)
        values = centres()
        assert (values.diff() > 0).all()
        assert start[0] < 0 or values[0] > 0


def test_training_moves_a_layout_and_keeps_its_order() -> None:
    embedding = inputs(60, joint=False)[0].float()
    batch = (embedding[None], embedding.norm(dim=1)[None], torch.ones(1, 60, dtype=torch.bool))
    layer = PairHistogram(n_bins=8, learnable=True)
    start = [centres().detach() for centres in (layer.distance_centres, layer.potential_centres)]
    optimiser = torch.optim.SGD(layer.parameters(), lr=10.0)
    losses = []
    for _ in range(15):
        loss = (layer(*batch) - 1 / 80).square().sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]
    for centres, before in zip((layer.distance_centres, layer.potential_centres), start, strict=True):
        assert (centres().diff() > 0).all()
        assert (centres() - before).abs().max() > 0.01


def test_attributes_multiply_the_classes() -> None:
    embedding, _, _, points, _ = inputs(40, joint=True)
    potential, depth = embedding.norm(dim=1), points[:, 0]
    potential[0] = 0.75  # on the edge of a hard class
    layer = PairHistogram(n_classes=2, n_bins=5, soft=True, attributes={"depth": [0.2, 0.4, 0.8]}).double()
    batch = (embedding[None], potential[None], torch.ones(1, 40, dtype=torch.bool))
    result = layer(*batch, attributes={"depth": depth[None], "potential": 0 * depth[None]})[0]
    u, d = (
        np.array([hat(float(value), centres) for value in values])
        for values, centres in ((potential, layer.potential_centres().tolist()), (depth, [0.2, 0.4, 0.8]))
    )
    memberships = torch.from_numpy(np.einsum("pa,pb->pab", u, d).reshape(40, 6))
    expected = by_loops([(embedding, layer.distance_centres())], memberships)
    np.testing.assert_allclose(result, expected, atol=1e-7)

    hard = PairHistogram(n_classes=2, n_bins=5, attributes={"depth": [0.2, 0.4, 0.8]}).double()
    one_hot = torch.zeros(40, 6, dtype=torch.float64)
    for i in range(40):
        one_hot[i, 3 * int(potential[i] >= 0.75) + int(depth[i] >= 0.3) + int(depth[i] >= 0.6)] = 1
    result = hard(*batch, attributes={"depth": depth[None]})[0]
    np.testing.assert_allclose(result, by_loops([(embedding, hard.distance_centres())], one_hot), atol=1e-7)


def test_layout_survives_its_state() -> None:
    options = {"learnable": True, "attributes": {"depth": [0.1, 0.3]}, "n_euclidean_bins": 5}
    layer, fresh = (PairHistogram(n_bins=6, distance_range=r, **options) for r in (4.0, 9.0))  # type: ignore[arg-type]
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.normal_(generator=torch.Generator().manual_seed(0))
    fresh.load_state_dict(layer.state_dict())
    embedding, _, _, points, _ = inputs(30, joint=True)
    batch = (embedding[None], embedding.norm(dim=1)[None], torch.ones(1, 30, dtype=torch.bool))
    rest = {"attributes": {"depth": points[None, :, 0]}, "points": points[None]}
    assert torch.equal(fresh(*batch, **rest), layer(*batch, **rest))  # type: ignore[arg-type]


@pytest.mark.parametrize("device", DEVICES)
def test_half_precision_and_autocast_count_in_single(device: str) -> None:
    embedding = inputs(60, joint=False)[0].to(device, torch.bfloat16)
    layer = PairHistogram(n_bins=16, learnable=True).to(device)
    mask = torch.ones(1, 60, dtype=torch.bool, device=device)

    def run(points: Tensor) -> tuple[Tensor, list[Tensor]]:
        leaf = points.clone().requires_grad_()
        result = layer(leaf[None], leaf.float().norm(dim=1)[None], mask)
        return result, list(torch.autograd.grad(result.square().sum(), [leaf, *layer.parameters()]))

    expected, expected_gradients = run(embedding.float())
    with torch.autocast(device, torch.bfloat16):
        result, gradients = run(embedding)
        hard = pair_histogram(embedding, embedding.float().norm(dim=1))
    assert result.dtype == hard.dtype == torch.float32
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(hard, pair_histogram(embedding.float(), embedding.float().norm(dim=1)))
    torch.testing.assert_close(gradients[0].float(), expected_gradients[0], rtol=0.01, atol=1e-6)
    torch.testing.assert_close(gradients[1:], expected_gradients[1:], rtol=1e-4, atol=1e-7)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("joint", [False, True])
def test_cuda_equals_cpu(joint: bool) -> None:
    values = inputs(80, joint=joint)
    np.testing.assert_allclose(soft(*(value.cuda() for value in values)).cpu(), soft(*values), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"embedding": torch.zeros(1, 3), "memberships": torch.ones(1, 1)}, "two points"),
        ({"embedding": torch.zeros(4, 3)}, r"shape \(P, D\)"),
        ({"embedding": torch.full((5, 3), torch.nan)}, "finite"),
        ({"memberships": torch.full((5, 2), 0.4)}, "sum 1"),
        ({"memberships": torch.tensor([[1.5, -0.5]] * 5)}, "non-negative"),
        ({"memberships": torch.full((5, 2), torch.nan)}, "sum 1"),
        ({"centres": torch.tensor([0.5, 0.5, 1.0])}, "ascending"),
        ({"centres": torch.tensor([0.5, torch.inf])}, "ascending"),
        ({"centres": torch.tensor([-2.0, -1.0])}, "positive"),
        ({"points": torch.zeros(5, 3)}, "both or neither"),
        ({"points": torch.zeros(4, 3), "euclidean_centres": torch.tensor([0.1, 0.2])}, r"shape \(P, D\)"),
    ],
)
def test_bad_input_is_refused(change: dict[str, Tensor], message: str) -> None:
    good = {"embedding": torch.rand(5, 3), "memberships": torch.ones(5, 1), "centres": torch.tensor([0.1, 0.2])}
    soft_pair_histogram(**good)
    with pytest.raises(ValueError, match=message):
        soft_pair_histogram(**{**good, **change})


def test_bad_batch_is_refused() -> None:
    embedding, mask = torch.rand(1, 5, 3), torch.ones(1, 5, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"attributes: expected \['depth'\]"):
        PairHistogram(attributes={"depth": [0.1, 0.2]})(embedding, embedding.norm(dim=2), mask)
    with pytest.raises(ValueError, match="points: expected positions"):
        PairHistogram(n_euclidean_bins=4)(embedding, embedding.norm(dim=2), mask)
    with pytest.raises(ValueError, match="finite"):
        PairHistogram(n_euclidean_bins=4)(embedding, torch.full((1, 5), torch.nan), mask, points=embedding)
    with pytest.raises(ValueError, match="n_euclidean_bins=-1"):
        PairHistogram(n_euclidean_bins=-1)
    with pytest.raises(ValueError, match="start: expected finite values in ascending order"):
        PairHistogram(attributes={"depth": [0.2, 0.1]})

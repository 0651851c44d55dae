from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from igps.nn.oriented import OrientedPairHistogram, nearest_directions, point_pair_features


def oriented(
    n_points: int, dimension: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, ...]:
    """Coordinates, points and directions."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n_points, dimension, generator=generator, dtype=dtype)
    directions = normalize(torch.randn(n_points, dimension, generator=generator, dtype=dtype), dim=1)
    return torch.rand(n_points, 5, generator=generator, dtype=dtype), points, directions


def histogram(module: OrientedPairHistogram, coordinates: Tensor, points: Tensor, directions: Tensor) -> Tensor:
    mask = torch.ones(1, len(points), dtype=torch.bool)
    return module(coordinates[None], points[None], directions[None], mask)[0]


def looped_features(points: Tensor, directions: Tensor) -> np.ndarray:
    rows = []
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            line = (points[j] - points[i]).numpy()
            line = line / np.sqrt(line @ line)
            a, b = directions[i].numpy() @ line, -(directions[j].numpy() @ line)
            rows.append((max(a, b), min(a, b), directions[i].numpy() @ directions[j].numpy()))
    return np.array(rows)


def test_features_are_those_of_a_loop() -> None:
    _, points, directions = oriented(12)
    features = torch.stack(point_pair_features(points, directions), dim=1)
    np.testing.assert_allclose(features, looped_features(points, directions), atol=1e-12)


def test_features_of_a_sphere_follow_from_the_distance() -> None:
    """On a sphere of radius R with outward normals, n·u = −d/2R at either end and nᵢ·nⱼ = 1 − d²/2R²."""
    normals = oriented(30)[2]
    points = 2.5 * normals + torch.tensor([3.0, -1.0, 7.0])
    first, second, between = point_pair_features(points, normals)
    distance = torch.nn.functional.pdist(points)
    for towards in (first, second):
        torch.testing.assert_close(towards, -distance / 5, atol=1e-9, rtol=0)
    torch.testing.assert_close(between, 1 - distance**2 / 12.5, atol=1e-9, rtol=0)


def test_points_that_coincide_have_no_line() -> None:
    _, points, directions = oriented(2)
    first, second, _ = point_pair_features(points[:1].expand(2, -1), directions)
    assert first == second == 0


def test_histogram_is_the_sum_of_hats_over_all_pairs() -> None:
    coordinates, points, directions = oriented(25)
    module = OrientedPairHistogram(n_bins=4, n_angle_bins=3, distance_range=1.2)
    result = histogram(module, coordinates, points, directions)
    distance = torch.nn.functional.pdist(coordinates).numpy()
    expected = np.zeros((4, 3, 3, 3))
    bins, cosines = np.array([0.15, 0.45, 0.75, 1.05]), np.array([-2 / 3, 0, 2 / 3])
    for value, features in zip(distance, looped_features(points, directions), strict=True):
        shares = [np.array([np.interp(value, bins, unit) for unit in np.eye(4)])]
        shares += [np.array([np.interp(feature, cosines, unit) for unit in np.eye(3)]) for feature in features]
        expected += np.einsum("b,i,j,k->bijk", *shares) / len(distance)
    np.testing.assert_allclose(result, expected, atol=1e-7)  # the centres are float32
    assert result.sum() == pytest.approx(1)


def test_turning_moving_and_reordering_change_nothing() -> None:
    coordinates, points, directions = oriented(40)
    module = OrientedPairHistogram()
    turn = torch.linalg.qr(oriented(3, seed=5)[1]).Q
    order = torch.randperm(40, generator=torch.Generator().manual_seed(2))
    expected = histogram(module, coordinates, points, directions)
    moved = histogram(module, coordinates[order], (points @ turn + 4)[order], (directions @ turn)[order])
    torch.testing.assert_close(moved, expected, atol=1e-9, rtol=0)
    turned_in = histogram(module, coordinates, points, -directions)
    assert (turned_in - expected).abs().sum() > 0.1


def test_no_cell_is_negative_by_rounding() -> None:
    """χ² refuses a histogram with a cell of −1e−18; a pair close below several centres leaves next to nothing there."""
    module = OrientedPairHistogram()
    for below in torch.logspace(-6, -3, 40).tolist():
        points = torch.tensor([[0.0, 0.0, 0.0], [0.75 - below, 0.0, 0.0]])
        for angle in torch.linspace(0.1, 3.0, 20).tolist():
            turned = angle + math.acos(0.4 - below)
            directions = torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in (angle, turned)])
            assert (histogram(module, points, points, directions) >= 0).all()


def test_padding_is_not_counted() -> None:
    module = OrientedPairHistogram()
    inputs = oriented(20, dtype=torch.float32)
    padded = [torch.cat([values, values.new_full((7, values.shape[1]), torch.nan)])[None] for values in inputs]
    mask = (torch.arange(27) < 20)[None]
    torch.testing.assert_close(module(*padded, mask)[0], histogram(module, *inputs))


def test_gradients_are_those_of_finite_differences() -> None:
    module = OrientedPairHistogram(n_bins=3, n_angle_bins=3, distance_range=1.0, learnable=True).double()
    weights = torch.randn(module.n_cells, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    inputs = [values.requires_grad_() for values in oriented(7)]
    assert len(list(module.parameters())) == 3

    def loss() -> Tensor:
        return (histogram(module, *inputs).flatten() * weights).sum()

    values = (*inputs, *module.parameters())
    for value, gradient in zip(values, torch.autograd.grad(loss(), values), strict=True):
        entry = int(gradient.abs().argmax())
        moved = []
        with torch.no_grad():
            for step in (1e-6, -2e-6):
                value.view(-1)[entry] += step
                moved.append(float(loss()))
            value.view(-1)[entry] += 1e-6
        assert gradient.view(-1)[entry] != 0
        assert gradient.view(-1)[entry] == pytest.approx((moved[0] - moved[1]) / 2e-6, rel=1e-4)


def test_learned_starts_as_the_fixed_one() -> None:
    inputs = oriented(30, dtype=torch.float32)
    fixed, learned = (histogram(OrientedPairHistogram(learnable=learnable), *inputs) for learnable in (False, True))
    torch.testing.assert_close(learned, fixed, atol=1e-6, rtol=0)


def test_half_precision_is_counted_in_single() -> None:
    inputs = oriented(30, dtype=torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under = histogram(OrientedPairHistogram(), *inputs)
    torch.testing.assert_close(under, histogram(OrientedPairHistogram(), *inputs))


def test_nearest_directions_are_those_of_a_loop() -> None:
    points, targets = oriented(9, seed=1)[1], oriented(20, seed=2)[1]
    found = nearest_directions(points, targets, n_nearest=3)
    for point, direction in zip(points, found, strict=True):
        nearest = sorted(targets, key=lambda target, point=point: float((target - point).norm()))[:3]  # type: ignore[misc]
        torch.testing.assert_close(direction, normalize(torch.stack(nearest).mean(dim=0) - point, dim=0))
    whole = nearest_directions(points, targets, n_nearest=50)
    torch.testing.assert_close(whole, normalize(targets.mean(dim=0) - points, dim=1))


def test_errors_say_what_was_expected() -> None:
    coordinates, points, directions = oriented(10)
    module = OrientedPairHistogram()
    with pytest.raises(ValueError, match="points and directions of shape"):
        histogram(module, coordinates, points, directions[:, :2])
    with pytest.raises(ValueError, match="at least two points to form a pair, got 1"):
        histogram(module, coordinates[:1], points[:1], directions[:1])
    with pytest.raises(ValueError, match="expected finite values"):
        histogram(module, coordinates, points * torch.inf, directions)
    with pytest.raises(ValueError, match="n_angle_bins: expected at least 2"):
        OrientedPairHistogram(n_angle_bins=1)
    with pytest.raises(ValueError, match="positive range"):
        OrientedPairHistogram(distance_range=0.0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_equals_cpu() -> None:
    inputs = oriented(50, dtype=torch.float32)
    module = OrientedPairHistogram()
    expected = histogram(module, *inputs)
    mask = torch.ones(1, 50, dtype=torch.bool, device="cuda")
    found = module.cuda()(*[values[None].cuda() for values in inputs], mask)[0]
    torch.testing.assert_close(found.cpu(), expected, atol=1e-6, rtol=0)

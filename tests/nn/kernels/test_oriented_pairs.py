from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from igps.nn._kernels.oriented_pairs import oriented_pair_histogram, point_pair_features
from igps.nn.axes.centres import middles
from loops import cosines, distances, pair_histogram_by_loops

pytestmark = pytest.mark.usefixtures("both_ways")

BINS, ANGLES = middles(6, 3.0, "bins").double(), middles(5, 2.0, "bins").double() - 1


def oriented(
    n_points: int, dimension: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, ...]:
    """Coordinates, points and directions."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n_points, dimension, generator=generator, dtype=dtype)
    directions = normalize(torch.randn(n_points, dimension, generator=generator, dtype=dtype), dim=1)
    return torch.rand(n_points, 5, generator=generator, dtype=dtype), points, directions


def histogram(coordinates: Tensor, points: Tensor, directions: Tensor) -> Tensor:
    """Of all points in one class, by the distance of the coordinates and the cosines."""
    bins, angles = (centres.to(torch.promote_types(points.dtype, torch.float32)) for centres in (BINS, ANGLES))
    one_class = points.new_ones(len(points), 1)
    return oriented_pair_histogram(one_class, [(coordinates, bins)], [(points, directions, angles, angles)])[0]


def test_features_are_those_of_a_loop() -> None:
    _, points, directions = oriented(12)
    i, j = np.triu_indices(12, 1)
    for feature, expected in zip(point_pair_features(points, directions), cosines(points, directions), strict=True):
        np.testing.assert_allclose(feature, expected[i, j], atol=1e-12)


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


@pytest.mark.parametrize("n_distances", [0, 1, 2])
@pytest.mark.parametrize("n_classes", [1, 3])
def test_histogram_is_the_sum_of_hats_over_all_pairs(n_distances: int, n_classes: int) -> None:
    coordinates, points, directions = oriented(25)
    memberships = torch.rand(25, n_classes, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    memberships[::2] = memberships[::2].round(decimals=0)
    memberships[memberships.sum(dim=1) == 0, 0] = 1
    memberships /= memberships.sum(dim=1, keepdim=True)
    layouts = [torch.tensor(centres).double() for centres in ([0.15, 0.45, 0.5, 1.05], [0.3, 1.7, 2.0])]
    towards, between = (torch.tensor(centres).double() for centres in ([-0.7, 0.1, 0.6], [-0.5, 0.3]))
    chosen = list(zip((coordinates, points), layouts, strict=True))[:n_distances]
    result = oriented_pair_histogram(memberships, chosen, [(points, directions, towards, between)])
    axes = [(distances(places), layout.tolist()) for places, layout in chosen]
    three = (towards.tolist(), towards.tolist(), between.tolist())
    axes += zip(cosines(points, directions), three, strict=True)
    np.testing.assert_allclose(result, pair_histogram_by_loops(memberships, axes), atol=1e-12)
    assert result.sum() == pytest.approx(1)


def test_two_sets_of_directions_are_six_dimensions() -> None:
    memberships = torch.eye(2, dtype=torch.float64).repeat(8, 1)
    layout = torch.tensor([-0.4, 0.5]).double()
    sets = [oriented(16, dimension, seed=seed)[1:] for dimension, seed in ((3, 0), (5, 1))]
    result = oriented_pair_histogram(memberships, [], [(*one, layout, layout) for one in sets])
    axes = [(values, layout.tolist()) for one in sets for values in cosines(*one)]
    np.testing.assert_allclose(result, pair_histogram_by_loops(memberships, axes), atol=1e-12)


def test_blocks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = oriented(40)
    whole = histogram(*inputs)
    monkeypatch.setattr("igps.nn._kernels.oriented_pairs._BLOCK", 7 * 40)
    torch.testing.assert_close(histogram(*inputs), whole, atol=1e-14, rtol=0)


def test_turning_moving_and_reordering_change_nothing() -> None:
    coordinates, points, directions = oriented(40)
    turn = torch.linalg.qr(oriented(3, seed=5)[1]).Q
    order = torch.randperm(40, generator=torch.Generator().manual_seed(2))
    expected = histogram(coordinates, points, directions)
    moved = histogram(coordinates[order], (points @ turn + 4)[order], (directions @ turn)[order])
    torch.testing.assert_close(moved, expected, atol=1e-9, rtol=0)
    turned_in = histogram(coordinates, points, -directions)
    assert (turned_in - expected).abs().sum() > 0.1


def test_no_cell_is_negative_by_rounding() -> None:
    """χ² refuses a histogram with a cell of −1e−18; a pair close below several centres leaves next to nothing there."""
    for below in torch.logspace(-6, -3, 40).tolist():
        points = torch.tensor([[0.0, 0.0, 0.0], [0.75 - below, 0.0, 0.0]])
        for angle in torch.linspace(0.1, 3.0, 20).tolist():
            turned = angle + math.acos(0.4 - below)
            directions = torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in (angle, turned)])
            assert (histogram(points, points, directions) >= 0).all()


def test_gradients_are_those_of_finite_differences() -> None:
    generator = torch.Generator().manual_seed(1)
    classes = torch.rand(7, 2, generator=generator, dtype=torch.float64) + 0.1
    layouts = [torch.tensor(centres).double() for centres in ([0.1, 0.4, 0.9], [-0.7, 0.0, 0.6], [-0.5, 0.1, 0.8])]
    values = [value.requires_grad_() for value in (classes, *oriented(7), *layouts)]
    weights = torch.randn(3, 3, 3, 3, 3, generator=generator, dtype=torch.float64)

    def loss() -> Tensor:
        classes, coordinates, points, directions, bins, towards, between = values
        memberships = classes / classes.sum(dim=1, keepdim=True)
        result = oriented_pair_histogram(memberships, [(coordinates, bins)], [(points, directions, towards, between)])
        return (result * weights).sum()

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


def test_half_precision_is_counted_in_single() -> None:
    inputs = oriented(30, dtype=torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under = histogram(*inputs)
    torch.testing.assert_close(under, histogram(*inputs))
    halves = [value.bfloat16() for value in inputs]
    result = histogram(*halves)
    assert result.dtype == torch.float32
    torch.testing.assert_close(result, histogram(*(value.float() for value in halves)))


def test_errors_say_what_was_expected() -> None:
    coordinates, points, directions = oriented(10)
    with pytest.raises(ValueError, match=r"directions: expected the shape of the points, \(10, 3\), got \(10, 2\)"):
        histogram(coordinates, points, directions[:, :2])
    with pytest.raises(ValueError, match="at least two points to form a pair, got 1"):
        histogram(coordinates[:1], points[:1], directions[:1])
    for one in range(3):
        inputs = [coordinates, points, directions]
        inputs[one] = inputs[one] * torch.inf
        with pytest.raises(ValueError, match="expected finite values"):
            histogram(*inputs)
    with pytest.raises(ValueError, match="memberships: expected one row for each of 9 points, got 10"):
        histogram(coordinates[:9], points, directions)
    with pytest.raises(ValueError, match="oriented: expected at least one set of points and directions"):
        oriented_pair_histogram(torch.ones(10, 1), [(coordinates, BINS)], [])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_equals_cpu() -> None:
    inputs = oriented(50, dtype=torch.float32)
    memberships = torch.eye(2).repeat(25, 1)

    def on(device: str) -> Tensor:
        coordinates, points, directions = (value.to(device) for value in inputs)
        bins, angles = BINS.float().to(device), ANGLES.float().to(device)
        sets = [(points, directions, angles, angles)]
        return oriented_pair_histogram(memberships.to(device), [(coordinates, bins)], sets)

    torch.testing.assert_close(on("cuda").cpu(), on("cpu"), atol=1e-6, rtol=0)

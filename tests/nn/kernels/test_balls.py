"""Radii of the largest balls that touch samples, against their definition and where they are known."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

from igps.nn import functional

Radii = Callable[[Tensor, Tensor], Tensor]


def on(mesh, n):
    points, faces = trimesh.sample.sample_surface(mesh, n, seed=0)
    return torch.from_numpy(np.array(points)), torch.from_numpy(np.array(mesh.face_normals[faces]))


def by_definition(points, directions, side):
    """Third smallest radius of balls tangent at x through another point that is not close to the tangent plane."""
    radii = []
    for i, (x, n) in enumerate(
        zip(
            points.tolist(),
            directions.tolist(),
            strict=True,
        )
    ):
        found = []
        for j, y in enumerate(points.tolist()):
            depth = side * sum(a * (b - c) for a, b, c in zip(n, x, y, strict=True))
            if j != i and depth > 0.1 * math.dist(x, y):
                found.append(math.dist(x, y) ** 2 / (2 * depth))
        found = [*sorted(found), math.inf, math.inf, math.inf]
        radii.append(min(max(found[2], 1e-3), 10.0))
    return radii


@pytest.fixture(params=["compiled", "torch"])
def ball_radii(request):
    """Of one shape, by the compiled loop, and by operations of PyTorch where a gradient is asked for."""
    compiled = request.param == "compiled"

    def radii(points, directions):
        leaf = points[None].clone().requires_grad_(not compiled)
        found = functional.ball_radii(
            leaf, directions[None], torch.ones(1, len(points), dtype=torch.bool)
        )[0]
        assert found.requires_grad is not compiled
        return found.detach()

    return radii


def test_radii_are_those_of_the_definition(ball_radii):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(60, 3, generator=generator, dtype=torch.float64)
    directions = normalize(
        torch.randn(60, 3, generator=generator, dtype=torch.float64),
        dim=1,
    )
    found = ball_radii(points, directions)
    for side, column in ((1, 0), (-1, 1)):
        np.testing.assert_allclose(
            found[:, column], by_definition(points, directions, side), rtol=1e-6
        )


def test_near_points_keep_their_digits_in_single_precision(ball_radii):
    """Of a lens beside the origin, whose two sides are near each other."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.tensor([0.3, 0.3, 0.02])
    ball = normalize(torch.randn(400, 3, generator=generator), dim=1)
    points = ball * axes + 0.4
    directions = normalize(ball / axes, dim=1)
    found = ball_radii(points, directions)
    for side, column in ((1, 0), (-1, 1)):
        expected = by_definition(points, directions, side)
        np.testing.assert_allclose(found[:, column], expected, rtol=1e-4)


def test_a_ball_has_its_own_radius_inside_and_none_outside(ball_radii):
    points = normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(1)),
        dim=1,
    )
    radii = ball_radii(0.3 * points, points)
    assert_close(radii[:, 0], torch.full((500,), 0.3), rtol=1e-3, atol=0)
    assert (radii[:, 1] == 10).all()


def test_two_plates_have_half_their_thickness_inside_and_half_their_gap_outside(ball_radii):
    plates = [trimesh.creation.box((0.6, 0.6, 0.1)) for _ in range(2)]
    plates[1].apply_translation((0, 0, 0.3))  # a gap of 0.2
    points, directions = on(trimesh.util.concatenate(plates), 4000)
    inner = points[:, :2].abs().amax(dim=1) < 0.15
    radii = ball_radii(points, directions)
    assert float(radii[inner, 0].median()) == pytest.approx(0.05, rel=0.1)
    into_the_gap = inner & (
        ((points[:, 2] - 0.05).abs() < 1e-6) | ((points[:, 2] - 0.25).abs() < 1e-6)
    )
    assert float(radii[into_the_gap, 1].median()) == pytest.approx(0.1, rel=0.1)


def test_two_points_inside_a_ball_do_not_change_the_other_radii(ball_radii):
    """Closed form: 398 points of a unit sphere keep radius 1, although two noisy points lie at half the radius."""
    points = normalize(
        torch.randn(400, 3, generator=torch.Generator().manual_seed(2)),
        dim=1,
    )
    directions = points.clone()
    points[:2] *= 0.5
    radii = ball_radii(points, directions)[2:, 0]
    assert_close(radii, torch.ones(398), rtol=1e-3, atol=0)


def test_three_samples_are_enough_and_two_are_not(ball_radii):
    points = torch.eye(3)
    outward = torch.tensor([0.0, 0.0, 1.0])
    assert ball_radii(points, outward.expand(3, 3)).tolist() == [[10.0, 10.0]] * 3
    with pytest.raises(
        ValueError, match="samples: expected at least 3 of each body for its balls, got 2"
    ):
        ball_radii(points[:2], outward.expand(2, 3))


def test_points_that_coincide_touch_no_ball(ball_radii):
    points = torch.zeros(5, 3)
    assert (ball_radii(points, torch.tensor([0.0, 0.0, 1.0]).expand(5, 3)) == 10).all()


def test_what_is_not_finite_is_refused(ball_radii):
    points = torch.eye(3)
    points[1, 1] = torch.nan
    with pytest.raises(
        ValueError, match="expected finite points and directions, got NaN or infinity"
    ):
        ball_radii(points, torch.eye(3))


def test_padding_does_not_change_radii(ball_radii):
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(2, 30, 3, generator=generator)
    directions = normalize(torch.randn(2, 30, 3, generator=generator), dim=2)
    mask = torch.arange(30) < torch.tensor([[30], [11]])
    for fill in (0.0, torch.nan):
        padded = points.masked_fill(~mask[:, :, None], fill)
        for gradient in (False, True):
            found = functional.ball_radii(
                padded.clone().requires_grad_(gradient), directions, mask
            ).detach()
            assert (found[1, 11:] == 1).all()
            for i, n in enumerate((30, 11)):
                assert_close(
                    found[i, :n],
                    ball_radii(
                        points[i, :n],
                        directions[i, :n],
                    ),
                    rtol=1e-3,
                    atol=0,
                )

"""How samples lie to principal axes, against loops, and what must not change it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from batches import embedded, scaled, two_bodies
from igps.data.requirements import Requirements
from igps.descriptors.pretrained.axial_histogram import AxialHistogram, principal_axes
from igps.nn.embedding import SpectralEmbedding
from loops import hat

EMBEDDING = SpectralEmbedding(n_eigenpairs=6)


def moved(batch, motion, shift):
    surface = batch.surface
    directions = surface.attributes["surface_direction"] @ motion
    attributes = {"surface_direction": directions}
    points = surface.points @ motion + shift
    return replace(batch, surface=replace(surface, points=points, attributes=attributes))


def test_it_is_the_share_of_samples_in_each_cell():
    """One sample, axis and cell at a time; the axes by NumPy's weighted covariance."""
    batch = two_bodies()
    n_bins = (5, 4, 3, 2)
    found = AxialHistogram(EMBEDDING, n_bins=n_bins)(batch)
    assert found.shape == (2, 3, *n_bins)
    along = np.linspace(-2.2, 2.2, 5).tolist()
    beside = np.linspace(0, 2.2, 4).tolist()
    cosine = np.linspace(-1, 1, 3).tolist()
    outward = np.linspace(-1, 1, 2).tolist()
    for i in range(2):
        real = batch.surface.mask[i]
        points = batch.surface.points[i, real].double().numpy()
        directions = batch.surface.attributes["surface_direction"][i, real].double().numpy()
        weights = embedded(batch, i, "surface", 6).norm(dim=1).numpy() ** -4.0
        centre = np.average(points, axis=0, weights=weights)
        _, axes = np.linalg.eigh(np.cov(points.T, aweights=weights, ddof=0))
        places = points - centre
        places /= np.sqrt((places**2).sum() / len(places))
        expected = np.zeros((3, *n_bins))
        for k in range(3):
            axis = axes[:, 2 - k]
            axis = axis if ((places @ axis) ** 3).sum() > 0 else -axis
            for place, direction in zip(places, directions, strict=True):
                height = place @ axis
                aside = place - height * axis
                distance = np.linalg.norm(aside)
                towards = direction @ axis * (1 if height >= 0 else -1)
                cells = [
                    hat(height, along),
                    hat(distance, beside),
                    hat(towards, cosine),
                    hat(direction @ aside / distance, outward),
                ]
                expected[k] += np.einsum("a,b,c,d->abcd", *cells)
        assert_allclose(
            found[i],
            expected / (3 * len(points)),
            atol=1e-6,
        )


@pytest.mark.parametrize("mirrored", [False, True])
def test_neither_motion_nor_reflection_nor_scale_change_it(mirrored):
    batch = two_bodies()
    histogram = AxialHistogram(EMBEDDING)
    motion = torch.from_numpy(Rotation.random(random_state=0).as_matrix()).float()
    if mirrored:
        motion = -motion
    expected = histogram(batch)
    found = histogram(
        scaled(
            moved(batch, motion, torch.tensor([1.0, -2.0, 0.5])),
            2.0,
        )
    )
    assert_close(found, expected, atol=1e-4, rtol=0)


def test_axes_are_those_of_a_brick_the_longest_first_and_point_to_its_heavy_end():
    generator = torch.Generator().manual_seed(0)
    cube = torch.rand(20000, 3, generator=generator, dtype=torch.float64) - 0.5
    brick = cube * torch.tensor([1.0, 3.0, 2.0])
    far = torch.tensor(
        [[0.0, -4.0, 0.0]],
        dtype=torch.float64,
    )
    turn = torch.from_numpy(Rotation.from_euler("xyz", (0.3, 0.5, -0.2)).as_matrix())
    points = torch.cat([brick, far.expand(50, 3)]) @ turn.T + 7
    weights = torch.ones(len(points), dtype=torch.float64)
    weights[len(brick) :] = 1e-9  # what is far off tells the direction, not the axes
    (centre,), (axes,) = principal_axes(points[None], weights[None])
    assert_allclose(centre[0], [7, 7, 7], atol=0.05)
    assert_allclose((turn.T @ axes).abs(), np.eye(3)[[1, 2, 0]].T, atol=0.05)
    assert float((turn.T @ axes)[1, 0]) < -0.99


def test_a_limb_that_moves_hardly_turns_the_axes():
    """A trunk of low potential, and a heavy limb of high potential that sweeps a right angle."""
    generator = torch.Generator().manual_seed(1)
    cube = torch.rand(600, 3, generator=generator, dtype=torch.float64) - 0.5
    trunk = cube * torch.tensor([0.6, 2.0, 0.4])
    limb = torch.rand(400, 1, generator=generator, dtype=torch.float64) * 2
    weights = torch.cat([torch.full((600,), 0.4), torch.full((400,), 1.0)]).double() ** -4
    axes = []
    plain = []
    for direction in ([1.0, 1.0, 0.0], [1.0, -0.2, 0.0]):
        points = torch.cat([trunk, limb * torch.tensor(direction)])
        axes.append(principal_axes(points[None], weights[None])[1][0, :, 0])
        plain.append(principal_axes(points[None], torch.ones_like(weights)[None])[1][0, :, 0])
    turned, plainly = ((one @ other).abs().arccos().rad2deg() for one, other in (axes, plain))
    assert turned < 10 < 30 < plainly


def test_it_has_gradients_of_places_and_directions():
    batch = two_bodies()
    points = batch.surface.points.clone().requires_grad_()
    moved_batch = replace(batch, surface=replace(batch.surface, points=points))
    histogram = AxialHistogram(EMBEDDING)(moved_batch)
    histogram.square().sum().backward()
    assert points.grad is not None
    assert torch.isfinite(points.grad).all()
    assert float(points.grad.abs().max()) > 0


def test_needs_and_errors():
    assert AxialHistogram(EMBEDDING).requirements == Requirements(
        n_eigenpairs=6, attributes=("surface_direction",)
    )
    with pytest.raises(ValueError, match="n_bins: expected four numbers, each at least 2"):
        AxialHistogram(EMBEDDING, n_bins=(8, 5, 4, 1))
    with pytest.raises(ValueError, match="n_samples: expected at least 2"):
        AxialHistogram(EMBEDDING, n_samples=1)
    batch = two_bodies()
    points = batch.surface.points.clone()
    points[0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="AxialHistogram: expected finite values"):
        AxialHistogram(EMBEDDING)(
            replace(
                batch,
                surface=replace(batch.surface, points=points),
            )
        )

"""Histograms of samples and their directions in cylindrical coordinates about the principal axes of a body."""

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from igps.data.requirements import SURFACE_DIRECTION, Requirements
from igps.nn.axes.points import soft_memberships
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential
from igps.nn.histograms.base import SampleHistogram, counted, joint
from igps.signature.signature import SampleKind

# The weight of a sample is this power of its potential, so that the trunk determines the axes rather than the limbs.
_POWER = -4
_REACH = 2.2  # largest coordinate, in units of the root mean square distance from the centre


class AxialHistogram(SampleHistogram):
    """Histograms of the positions and directions of samples in cylindrical coordinates about each principal axis.

    The coordinates of a sample are its height along the axis, its distance from the axis, and the cosines of its
    direction with the axis and with the radial line from the axis. Unlike histograms of pairs, they tell where in the
    body a sample lies. There is no angle about the axis. In a body that is round about one axis, the other two axes are
    arbitrary, but this affects only their own cells.

    The axes are those of the covariance of the samples, with the weights U⁻⁴, where U is the barycentroid potential. So
    the trunk determines the axes, and moving limbs hardly rotate them. Each axis points to the side where the third
    moment of the samples is positive, so that the histogram does not change with motions and reflections.

    Source: principal axes as in Vranić and Saupe 2001; cylindrical bins as in Papadakis, Pratikakis, Theoharis and
    Perantonis 2010.

    The histogram is differentiable in directions and positions for fixed axes. The axes themselves have no gradient,
    because the gradient is unbounded for close eigenvalues.

    Args:
        embedding: of the potential in the weights of the samples.
        samples, n_samples, n_training_samples: see `SampleHistogram`.
        n_bins: of the height, of the distance from the axis, and of the two cosines.
    """

    along: Tensor
    beside: Tensor
    cosine: Tensor
    outward: Tensor

    def __init__(
        self,
        embedding: nn.Module | None = None,
        samples: SampleKind = "surface",
        *,
        n_bins: tuple[int, int, int, int] = (8, 5, 4, 4),
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        if len(n_bins) != 4 or min(n_bins) < 2:
            raise ValueError(f"n_bins: expected four numbers, each at least 2, got {n_bins}.")
        self.embedding = embedding or SpectralEmbedding()
        self.n_bins = n_bins
        ends = {
            "along": (-_REACH, _REACH),
            "beside": (0, _REACH),
            "cosine": (-1, 1),
            "outward": (-1, 1),
        }
        for n, (name, (first, last)) in zip(n_bins, ends.items(), strict=True):
            self.register_buffer(name, torch.linspace(first, last, n))

    @property
    def shape(self) -> tuple[int, ...]:
        """Three axes, the longest first, and the bins of the four coordinates."""
        return (3, *self.n_bins)

    @property
    def requirements(self) -> Requirements:
        """Requirements of the embedding, and the directions of the samples."""
        return super().requirements | SURFACE_DIRECTION

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, 3, ...) histograms of the samples of N shapes."""
        mask = features.samples.mask
        potential = barycentroid_potential(features.embedded(self.embedding))
        sample_weights = features.weights_or_ones(potential)
        # Padding may hold any value, and must not count.
        is_padding = ~mask
        points = features.positions().masked_fill(is_padding[:, :, None], 0)
        directions = features.attribute("surface_direction")
        directions = directions.masked_fill(is_padding[:, :, None], 0)
        potential = potential.masked_fill(is_padding, 0)
        sample_weights = sample_weights.masked_fill(is_padding, 0)
        total = points.sum() + directions.sum() + potential.sum()
        if not torch.compiler.is_compiling() and not torch.isfinite(total):
            raise ValueError("AxialHistogram: expected finite values, got NaN or infinity.")
        with torch.no_grad():
            weights = potential.double().clamp_min(torch.finfo().tiny).pow(_POWER) * mask
            centre, axes = principal_axes(points, weights)
        centre = centre.to(points.dtype)
        axes = axes.to(points.dtype)
        n_points = mask.sum(dim=1)
        positions = (points - centre) @ axes * mask[:, :, None]
        directions = directions @ axes
        squares = positions.square().sum(dim=(1, 2))
        radius = (squares / n_points).sqrt()
        positions = positions / radius[:, None, None]
        # Components along each axis, (N, 3, P), and along the two other axes, (N, 3, P, 2)
        height = positions.mT
        axial = directions.mT
        across = _along_others(height)
        radial = _along_others(axial)
        outward = (radial * normalize(across, dim=3)).sum(dim=3)
        place = [
            soft_memberships(height, self.along),
            soft_memberships(across.norm(dim=3), self.beside),
        ]
        # Relative to the nearer end of the axis, so that a body and its mirror image agree
        towards_end = torch.where(height < 0, -axial, axial)
        direction = [
            soft_memberships(towards_end, self.cosine),
            soft_memberships(outward, self.outward),
        ]
        places = joint(place) * sample_weights[:, None, :, None]
        counts = counted(places, joint(direction), n_points[:, None])
        return counts.view(-1, *self.shape) / 3


def _along_others(components: Tensor) -> Tensor:
    """(N, 3, P) components along each axis to those along the two other axes, (N, 3, P, 2)."""
    first = components.roll(1, 1)
    second = components.roll(2, 1)
    return torch.stack([first, second], dim=3)


def principal_axes(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (N, 1, 3) and principal axes (N, 3, 3) of points (N, P, 3) with weights (N, P).

    The axes are columns, the longest first. Each axis points to the side where the third moment about the centre is
    positive. In this moment, all points of positive weight count equally.
    """
    weights = (weights / weights.sum(dim=1, keepdim=True))[:, :, None]
    points = points.to(weights.dtype)
    centre = (weights * points).sum(dim=1, keepdim=True)
    centred = (points - centre) * (weights > 0)
    _, axes = torch.linalg.eigh(centred.mT @ (centred * weights))
    axes = axes.flip(2)
    third = (centred @ axes).pow(3).sum(dim=1, keepdim=True)
    return centre, axes * torch.where(third < 0, -1, 1)

"""How the samples of a body lie to its principal axes."""

from contextlib import nullcontext

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn.functional import normalize

from igps.data.requirements import Requirements
from igps.nn.axes.points import soft_memberships
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential
from igps.nn.histograms.base import SampleHistogram, counted, joint
from igps.retrieval.distances import in_transforms
from igps.signature.signature import SampleKind

# The weight of a sample is so great a power of its potential: the trunk decides where the axes lie, limbs hardly
_POWER = -4
# Of places, in units of the root mean square distance from the centre
_REACH = 2.2


class AxialHistogram(SampleHistogram):
    """Where samples lie along each principal axis of the body and beside it, and how their directions lie to it.

    Histograms of pairs do not know where in the body a pair is; this one does. The axes are those of the covariance of
    the samples, each weighted by U⁻⁴, U its barycentroid potential: so the trunk decides, and a limb may move without
    turning them. Each axis points to where the samples' third moment is positive, so that neither a motion nor a
    reflection changes anything. About an axis the histogram has no angle: of a body that is round about one axis, the
    other two are arbitrary, and so only a part of its cells. Source: principal axes as in Vranić and Saupe 2001;
    cylindrical bins as in Papadakis, Pratikakis, Theoharis and Perantonis 2010.

    The histogram is differentiable in directions and places along fixed axes; the axes themselves have no gradient, as
    that of close eigenvalues has no bound.

    Args:
        embedding: of the potential that weighs the samples.
        samples, n_samples, n_training_samples: see `SampleHistogram`.
        n_bins: along the axis, beside it, and of the cosines of the direction with the axis and with the line from it.
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
        ends = {"along": (-_REACH, _REACH), "beside": (0, _REACH), "cosine": (-1, 1), "outward": (-1, 1)}
        for n, (name, (first, last)) in zip(n_bins, ends.items(), strict=True):
            self.register_buffer(name, torch.linspace(first, last, n))

    @property
    def shape(self) -> tuple[int, ...]:
        """Axes, the longest first, and the bins of each."""
        return (3, *self.n_bins)

    @property
    def requirements(self) -> Requirements:
        """Those of the embedding, and the directions."""
        return super().requirements | Requirements(attributes=("surface_direction",))

    def of_samples(self, features: SampleFeatures) -> Tensor:
        """(N, 3, ...) histograms of some samples of N shapes."""
        mask, potential = features.samples.mask, barycentroid_potential(features.embedded(self.embedding))
        # Padding may hold anything, and counts nowhere
        points, directions, potential, own = (
            one.masked_fill(~mask.view(*mask.shape, *[1] * (one.ndim - 2)), 0)
            for one in (
                features.positions(), features.attribute("surface_direction"), potential,
                features.weights_or_ones(potential),
            )
        )  # fmt: skip
        if not torch.compiler.is_compiling() and not torch.isfinite(points.sum() + directions.sum() + potential.sum()):
            raise ValueError("AxialHistogram: expected finite values, got NaN or infinity.")
        with torch.no_grad(), forward_ad._set_fwd_grad_enabled(False) if in_transforms() else nullcontext():
            weights = potential.double().clamp_min(torch.finfo().tiny).pow(_POWER) * mask
            centre, axes = (one.to(points.dtype) for one in principal_axes(points, weights))
        n_points = mask.sum(dim=1)
        places, directions = (points - centre) @ axes * mask[:, :, None], directions @ axes
        places = places / (places.square().sum(dim=(1, 2)) / n_points).sqrt()[:, None, None]
        # (N, 3, P) along each axis, and (N, 3, P, 2) along the two others
        along, of_direction = places.mT, directions.mT
        aside, of_aside = (torch.stack([one.roll(n, 1) for n in (1, 2)], dim=3) for one in (along, of_direction))
        outward = (of_aside * normalize(aside, dim=3)).sum(dim=3)
        place = [soft_memberships(along, self.along), soft_memberships(aside.norm(dim=3), self.beside)]
        # towards the nearer end of the axis: so a body and its mirror image agree
        away = torch.where(along < 0, -of_direction, of_direction)
        direction = [soft_memberships(away, self.cosine), soft_memberships(outward, self.outward)]
        counts = counted(joint(place) * own[:, None, :, None], joint(direction), n_points[:, None])
        return counts.view(-1, *self.shape) / 3


def principal_axes(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The centres (N, 1, 3) of points (N, P, 3) of weights (N, P) and their principal axes (N, 3, 3).

    Axes are in columns, the longest first. Each points to where the third moment of all points of any weight about the
    centre, each counted once, is positive.
    """
    weights = (weights / weights.sum(dim=1, keepdim=True))[:, :, None]
    points = points.to(weights.dtype)
    centre = (weights * points).sum(dim=1, keepdim=True)
    places = (points - centre) * (weights > 0)
    _, axes = torch.linalg.eigh(places.mT @ (places * weights))
    axes = axes.flip(2)
    third = (places @ axes).pow(3).sum(dim=1, keepdim=True)
    return centre, axes * torch.where(third < 0, -1, 1)

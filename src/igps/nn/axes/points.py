"""Axes of points: classes of the samples of a body, by potential, radius of touching balls, or attribute."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from igps._parameters import check_at_least, check_one_of
from igps.data.attribute_sources import named_source
from igps.data.requirements import SURFACE_DIRECTION, Requirements, embedding_requirements
from igps.nn._kernels.pairs_by_torch import find_intervals
from igps.nn.axes.centres import OrderedCentres, interval_centres
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import barycentroid_potential
from igps.nn.specification import Specified
from igps.signature.attributes import AttributeName

Side = Literal["inside", "outside"]
_SIDES = get_args(Side)


class PointAxis(Specified, ABC):
    """Base class of axes of points, which sort samples into classes.

    Args:
        centres: (C,) of the classes, ascending.
        soft: whether a point belongs to the two classes whose centres surround its value, in linear proportion;
            otherwise it belongs only to the nearest class.
        learnable: whether the centres are parameters. Hard classes have no derivative; they are learned by that of
            soft classes (straight-through estimator, Bengio, Léonard and Courville 2013).
    """

    def __init__(self, centres: Tensor | Sequence[float], soft: bool, learnable: bool) -> None:
        super().__init__()
        self.centres = OrderedCentres(centres, learnable)
        self.soft = soft
        self.learnable = learnable

    @property
    def n_classes(self) -> int:
        """The number C of classes."""
        return len(self.centres.start)

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirements for a body, given the embedding of the histogram."""
        return Requirements()

    @abstractmethod
    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """Return the values (N, P) of the samples."""

    def memberships(self, values: Tensor) -> Tensor:
        """Return weights (..., P, C) ≥ 0, rows of sum 1, of finite values (..., P); raise a ValueError for others."""
        classes, weights = self.members(values, torch.ones_like(values, dtype=torch.bool))
        return weights.new_zeros(*values.shape, self.n_classes).scatter_add(-1, classes, weights)

    def members(self, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the classes of values (..., P) and their weights, that is, `memberships` in sparse form.

        Both are (..., P, M): integers, and weights of sum 1, with M = 2 for soft and M = 1 for hard classes. Hard
        classes that are learned have M = 2, one of them with weight 0. Raises a ValueError if a value in the mask
        (..., P) is not finite.
        """
        is_traced = torch.compiler.is_compiling()  # traced code cannot raise
        if not is_traced and not torch.isfinite(torch.where(mask, values, 0)).all():
            raise ValueError(f"{type(self).__name__}: expected finite values, got NaN or infinity.")
        centres = self.centres().to(values.dtype)
        fixed = centres.detach()
        boundaries = (fixed[1:] + fixed[:-1]) / 2
        nearest = torch.bucketize(values.detach(), boundaries, right=True).unsqueeze(-1)
        is_shared = self.soft or (self.learnable and torch.is_grad_enabled())
        if len(centres) == 1 or not is_shared:
            return nearest, torch.ones_like(nearest, dtype=values.dtype)
        below, share = find_intervals(values, centres)
        classes = torch.stack([below, below + 1], dim=-1)
        shares = torch.stack([1 - share, share], dim=-1)
        if self.soft:
            return classes, shares
        # The difference is zero; it has the derivative.
        return classes, (classes == nearest) + (shares - shares.detach())


class Potential(PointAxis):
    """Classes of the barycentroid potential U, the norm of the embedding (Rustamov 2010, section 4).

    Args:
        n_classes: C equal intervals of [0, `reach`], with their centres in the middle.
        reach: end of the last interval; larger values count in the last class.
        embedding: replaces the embedding of the histogram, for example to add a second scale.
        soft, learnable: see `PointAxis`.
    """

    def __init__(
        self,
        n_classes: int = 4,
        reach: float = 1.5,
        *,
        embedding: nn.Module | None = None,
        soft: bool = False,
        learnable: bool = False,
    ) -> None:
        super().__init__(interval_centres(n_classes, reach, "n_classes"), soft, learnable)
        self.embedding = embedding

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirements of the axis's own embedding, or of the histogram's."""
        return embedding_requirements(self.embedding or embedding)

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """Return the potential (N, P)."""
        return barycentroid_potential(features.embedded(self.embedding or embedding))


class BallRadius(PointAxis):
    """Classes of the radius of the largest ball that touches the surface at a surface sample, see `ball_radii`.

    The radius inside is half the local thickness; the radius outside measures how narrow a hollow is. Both are
    pose-invariant except near joints, and distinguish a plate from a rod or a block, and a bowl from a dome.

    Args:
        side: "inside" or "outside".
        smallest, largest: centres of the first and last class, over √area. The centres form a geometric progression;
            a point belongs to two classes, in proportion to the logarithm of its radius.
        n_classes: C.
        learnable: see `PointAxis`.
    """

    def __init__(
        self,
        side: Side = "inside",
        smallest: float = 0.022,
        largest: float = 0.25,
        n_classes: int = 4,
        *,
        learnable: bool = False,
    ) -> None:
        check_one_of(_SIDES, side=side)
        check_at_least(2, n_classes=n_classes)
        if not 0 < smallest < largest < math.inf:
            raise ValueError(
                f"smallest, largest: expected 0 < smallest < largest, got {smallest} and {largest}."
            )
        super().__init__(
            torch.linspace(math.log(smallest), math.log(largest), n_classes),
            soft=True,
            learnable=learnable,
        )
        self.side = side

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the requirement of surface directions."""
        return SURFACE_DIRECTION

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """Return the logarithms (N, P) of the radii over √area; raise a ValueError for interior samples."""
        if features.kind != "surface":
            raise ValueError(
                "samples: expected surface samples for ball radii, got interior samples."
            )
        return features.ball_radii()[..., _SIDES.index(self.side)].log()


class Attribute(PointAxis):
    """Classes of a scalar attribute of the samples: "depth", "electrostatic_potential", or one of your own.

    Args:
        name: of the attribute.
        centres: of the classes, ascending, in the attribute's unit; None with `quantiles`.
        quantiles: number of classes; `fit_centres` sets their centres, which are saved, to quantiles of a collection.
        soft, learnable: see `PointAxis`.

    Raises:
        ValueError: neither or both of `centres` and `quantiles` are given, or there are fewer than 2 quantiles.
    """

    fitted: Tensor

    def __init__(
        self,
        name: str,
        centres: Sequence[float] | None = None,
        *,
        quantiles: int | None = None,
        soft: bool = False,
        learnable: bool = False,
    ) -> None:
        if (centres is None) == (quantiles is None) or (quantiles is not None and quantiles < 2):
            raise ValueError(
                f"{name}: expected centres, or at least 2 quantiles, got {centres} and {quantiles}."
            )
        super().__init__(
            [float(i) for i in range(quantiles or 0)] if centres is None else centres,
            soft,
            learnable,
        )
        self.name = name
        self.quantiles = quantiles
        if quantiles is not None:
            self.register_buffer("fitted", torch.tensor(False))

    @property
    def is_fitted(self) -> bool:
        """Whether the centres are set."""
        return self.quantiles is None or bool(self.fitted)

    def fit(self, values: Tensor) -> None:
        """Set the centres to the quantiles of values (P,) at (i + 1/2) / n; equal quantiles are moved apart."""
        n = len(self.centres.start)
        values = values.double()
        shares = (torch.arange(n, dtype=torch.float64) + 0.5) / n
        centres = torch.quantile(values, shares)
        size = max(float(values.std()), float(values.abs().max()), 1e-12)
        min_gap = size * 1e-4
        for i in range(1, n):
            centres[i] = max(centres[i], centres[i - 1] + min_gap)
        self.centres.start.copy_(centres)
        self.fitted.fill_(True)

    def check_fitted(self) -> None:
        """Raise a ValueError if the centres have not been fitted."""
        if not self.is_fitted:
            raise ValueError(
                f"{self.name}: expected centres, got {self.quantiles} quantiles that are not fitted. Call "
                "igps.nn.fit_centres(descriptor, dataset), or use descriptor.safetensors from `igps retrieve --out`."
            )

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Return the `attribute_requirements` of the attribute."""
        return attribute_requirements(self.name)

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """Return the attribute (N, P); raise a ValueError if the samples do not have it, or it is a direction."""
        self.check_fitted()
        values = features.attribute(self.name)
        if values.ndim != 2:
            raise ValueError(
                f"attributes: expected a scalar, got {self.name!r}, which is a direction."
            )
        return values


def attribute_requirements(name: str) -> Requirements:
    """Return the requirements of an attribute of samples; attributes that users supply have none."""
    if name in get_args(AttributeName):
        return Requirements(attributes=tuple(x for x in get_args(AttributeName) if x == name))
    source = named_source(name)
    return Requirements() if source is None else Requirements(sources={name: source})


def soft_memberships(values: Tensor, centres: Tensor) -> Tensor:
    """Return memberships (..., P, C) of values (..., P), with rows of sum 1: hat functions at ascending centres (C,).

    Values below the first or above the last centre belong only to that class. Differentiable in both arguments.
    """
    # Position of a value between each centre and the next, from 0 to 1; the hats are differences of these positions.
    values = values.unsqueeze(-1)
    position = (values - centres[:-1]) / centres.diff()
    position = position.clamp(0, 1)
    rising = torch.cat([torch.ones_like(values), position], dim=-1)
    falling = torch.cat([position, torch.zeros_like(values)], dim=-1)
    return rising - falling


def largest_members(memberships: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return memberships (N, P, C) in sparse form: classes and weights (N, P, M), see `PointAxis.members`.

    M is the largest number of classes that a point belongs to. With gradients M is C, so that memberships of 0 have a
    gradient as well.
    """
    n_members = memberships.shape[2]
    if not (memberships.requires_grad or torch.compiler.is_compiling()):
        n_each = (memberships > 0).sum(dim=2)
        n_members = int(n_each.masked_fill(~mask, 1).max())
    weights, classes = memberships.topk(n_members, dim=2)
    return classes, weights

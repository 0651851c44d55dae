"""Axes of points: classes of the samples of a body, by their potential, the balls that touch them, or an attribute."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from igps._parameters import check_one_of
from igps.data.attribute_sources import ResidueAttribute
from igps.data.requirements import Requirements, embedding_requirements
from igps.nn._kernels.located import located
from igps.nn.axes.centres import OrderedCentres, middles
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import barycentroid_potential
from igps.nn.specification import Specified
from igps.signature.attributes import AttributeName
from igps.signature.residue_attributes import RESIDUE_ATTRIBUTES

Side = Literal["inside", "outside"]
_SIDES = get_args(Side)


class PointAxis(Specified, ABC):
    """Classes of points.

    Args:
        centres: (C,) of the classes, ascending.
        soft: whether a point belongs to the two classes whose centres surround its value, in linear proportion, or to
            the nearest alone.
        learnable: whether the centres are parameters; implies `soft`, as only soft classes have gradients.
    """

    def __init__(self, centres: Tensor | Sequence[float], soft: bool, learnable: bool) -> None:
        super().__init__()
        self.centres = OrderedCentres(centres, learnable)
        self.soft = soft or learnable

    @property
    def n_classes(self) -> int:
        """C."""
        return len(self.centres.start)

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Of a body, with this embedding for the histogram."""
        return Requirements()

    @abstractmethod
    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """(N, P) of the samples."""

    def memberships(self, values: Tensor) -> Tensor:
        """(..., P, C) non-negative, rows of sum 1, from (..., P) values; a ValueError if one is not finite."""
        classes, weights = self.members(values, torch.ones_like(values, dtype=torch.bool))
        return weights.new_zeros(*values.shape, self.n_classes).scatter_add(-1, classes, weights)

    def members(self, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The classes that points of values (..., P) belong to, and how much: `memberships` without its zeros.

        They are (..., P, M) integers and weights of sum 1, M = 2 for soft classes and 1 for hard ones. A ValueError of
        values that are not finite where the mask is true.
        """
        # What is traced for `torch.compile` cannot raise.
        if not torch.compiler.is_compiling() and not torch.isfinite(torch.where(mask, values, 0)).all():
            raise ValueError(f"{type(self).__name__}: expected finite values, got NaN or infinity.")
        centres = self.centres().to(values.dtype)
        if not self.soft or len(centres) == 1:
            boundaries = (centres.detach()[1:] + centres.detach()[:-1]) / 2
            classes = torch.bucketize(values.detach(), boundaries, right=True).unsqueeze(-1)
            return classes, torch.ones_like(classes, dtype=values.dtype)
        below, share = located(values, centres)
        return torch.stack([below, below + 1], dim=-1), torch.stack([1 - share, share], dim=-1)


class Potential(PointAxis):
    """Classes of the barycentroid potential U, the norm of the embedding (Rustamov 2010, section 4).

    Args:
        n_classes: C equal intervals of [0, `reach`], with their centres in the middle.
        reach: end of the last interval; what lies beyond counts in the last class.
        embedding: other than the histogram's: for a second scale.
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
        super().__init__(middles(n_classes, reach, "classes"), soft, learnable)
        self.embedding = embedding

    def requirements(self, embedding: nn.Module) -> Requirements:
        """Those of the embedding, its own or the histogram's."""
        return embedding_requirements(self.embedding or embedding)

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """(N, P) potential."""
        return barycentroid_potential(features.embedded(self.embedding or embedding))


class BallRadius(PointAxis):
    """Classes of the radius of the largest ball that touches the surface at a sample, from inside or from outside.

    From inside it is half the local thickness, from outside it tells how narrow the hollow is in which a sample lies.
    Both are pose-invariant but near joints, and tell a plate from a rod and a block, and a bowl from a dome. See
    `ball_radii`. Surface samples alone have such balls.

    Args:
        side: "inside" or "outside".
        smallest, largest: centres of the first and last class, over √area; the others lie between them in a geometric
            progression, along which points are in linear proportion in two classes.
        n_classes: C.
    """

    def __init__(
        self, side: Side = "inside", smallest: float = 0.022, largest: float = 0.25, n_classes: int = 4
    ) -> None:
        check_one_of(_SIDES, side=side)
        if not 0 < smallest < largest < math.inf or n_classes < 2:
            raise ValueError(
                f"smallest, largest, n_classes: expected 0 < smallest < largest, and at least two classes, got "
                f"{smallest}, {largest} and {n_classes}."
            )
        super().__init__(torch.linspace(math.log(smallest), math.log(largest), n_classes), soft=True, learnable=False)
        self.side = side

    def requirements(self, embedding: nn.Module) -> Requirements:
        """The directions."""
        return Requirements(attributes=("surface_direction",))

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """(N, P) logarithms of the radii over √area; a ValueError of interior samples."""
        if features.kind != "surface":
            raise ValueError("samples: expected surface samples, which balls touch, got interior ones.")
        return features.ball_radii()[..., _SIDES.index(self.side)].log()


class Attribute(PointAxis):
    """Classes of a scalar attribute of the samples: "depth", "electrostatic_potential", or one of your own.

    Args:
        name: of the attribute.
        centres: of the classes, ascending, in the attribute's unit; None with `quantiles`.
        quantiles: so many classes, whose centres are quantiles of a collection, see `fit_centres`; they are saved.
        soft, learnable: see `PointAxis`.

    Raises:
        ValueError: not one of centres and quantiles.
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
            raise ValueError(f"{name}: expected centres, or at least 2 quantiles, got {centres} and {quantiles}.")
        super().__init__([float(i) for i in range(quantiles or 0)] if centres is None else centres, soft, learnable)
        self.name, self.quantiles = name, quantiles
        if quantiles is not None:
            self.register_buffer("fitted", torch.tensor(False))

    @property
    def is_fitted(self) -> bool:
        """Whether its centres are known."""
        return self.quantiles is None or bool(self.fitted)

    def fit(self, values: Tensor) -> None:
        """Take for centres the quantiles of values (P,) at (i + 1/2) / n; equal ones are moved apart a little."""
        n = len(self.centres.start)
        centres = torch.quantile(values.double(), (torch.arange(n, dtype=torch.float64) + 0.5) / n)
        least = max(float(values.double().std()), float(values.abs().max()), 1e-12) * 1e-4
        for i in range(1, n):
            centres[i] = max(centres[i], centres[i - 1] + least)
        self.centres.start.copy_(centres)
        self.fitted.fill_(True)

    def check_fitted(self) -> None:
        """Raise a ValueError where the centres are still to come."""
        if not self.is_fitted:
            raise ValueError(
                f"{self.name}: expected centres, got {self.quantiles} quantiles of no collection. Call "
                "igps.nn.fit_centres(descriptor, dataset), or take the file descriptor.safetensors that `igps retrieve "
                "--out` writes."
            )

    def requirements(self, embedding: nn.Module) -> Requirements:
        """The attribute, if it is one that Signatures are computed with, or one of residues."""
        return attribute_requirements(self.name)

    def values(self, features: SampleFeatures, embedding: nn.Module) -> Tensor:
        """(N, P) of the attribute; a ValueError if the samples have none of this name, or it is a direction."""
        self.check_fitted()
        values = features.attribute(self.name)
        if values.ndim != 2:
            raise ValueError(f"attributes: expected a scalar to split by, but {self.name!r} is a direction.")
        return values


def attribute_requirements(name: str) -> Requirements:
    """What a sample's attribute needs of a body: nothing where it is one of your own."""
    if name in RESIDUE_ATTRIBUTES:
        return Requirements(sources={name: ResidueAttribute(name)})
    return Requirements(attributes=tuple(one for one in get_args(AttributeName) if one == name))


def soft_memberships(values: Tensor, centres: Tensor) -> Tensor:
    """Soft classes (..., P, C) of values (..., P), rows of sum 1: linear kernels (hats) around ascending centres (C,).

    Below the first and beyond the last a value is of that class alone. Differentiable in both arguments.
    """
    # How far past each centre on the way to the next, 0 to 1: successive differences are the hats, and sum to 1.
    passed = ((values.unsqueeze(-1) - centres[:-1]) / centres.diff()).clamp(0, 1)
    one, none = torch.ones_like(values).unsqueeze(-1), torch.zeros_like(values).unsqueeze(-1)
    return torch.cat([one, passed], dim=-1) - torch.cat([passed, none], dim=-1)


def largest_members(memberships: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Classes and weights (N, P, M) from memberships (N, P, C) in all classes, M as many as any point belongs to.

    With a gradient M is C, so that memberships that are 0 have theirs too.
    """
    n_members = memberships.shape[2]
    if not (memberships.requires_grad or torch.compiler.is_compiling()):
        n_members = int((memberships > 0).sum(dim=2).masked_fill(~mask, 1).max())
    weights, classes = memberships.topk(n_members, dim=2)
    return classes, weights

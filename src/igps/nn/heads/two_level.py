"""A head with levels: other poses of a body rank first, then look-alikes, then other bodies of its class."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps._parameters import check_fraction
from igps.nn.heads.base import Head, principal_directions
from igps.nn.heads.wccn import MEDIAN, WCCNHead
from igps.retrieval.distances import cosine, euclidean, square_root
from igps.retrieval.vectors import MAX_SHORT_WIDTH

# Usual distance of a training shape from the mean: in many dimensions, most pairs of shapes are nearly orthogonal.
_USUAL_LENGTH = MEDIAN / math.sqrt(2)
_STEEPNESS = 10  # exponent of the factor that rises from 0 to 1 at the scales of the body heads
_INDIVIDUAL_SHARE = 0.1  # share of the squared length of an embedding that belongs to the individual heads
_INDIVIDUAL_SCALE = 0.3  # distance by the individual heads at which most of their weight counts
_SAME_INDIVIDUAL = 0.05  # nine in ten pairs of poses of an unseen generated individual are nearer
_MIN_DISTANCE = 1e-6  # shorter distances are rounding errors, and fractional powers have no derivative at 0


class TwoLevelHead(Head):
    """Maps histograms to unit vectors, with a distance that ranks other poses of a body first, then its class.

    An embedding concatenates the embeddings by a class head, a `WCCNHead` fitted to classes, and by body heads, which
    are `WCCNHead`s with `lengths`, fitted to bodies in several poses. The distance is the cosine distance of the class
    embeddings, times the factor 1 − exp(−Σ (dₖ / sₖ)¹⁰), where dₖ are the distances by the body heads and sₖ their
    scales. The factor is nearly 0 if all dₖ are below their scales, as between poses of a body, and nearly 1 if any is
    above its scale. The factor saturates, as the amount by which two bodies differ does not predict their classes.

    Far from the mean of the training shapes, distances between different bodies are as small as distances between poses
    elsewhere. The scales are therefore multiplied by √(ℓ₀ / ℓ). Here ℓ² is the product of the distances of the two
    shapes from the mean, each in quadratic mean over the body heads, and ℓ₀ is the usual distance.

    Bodies can be nearly alike, such as two people. Individual heads, `WCCNHead`s with `lengths`, are fitted by
    `fit_individuals` to individuals in several poses, so that they ignore the effects of bending and triangulation.
    With f = Π fₖ^pₖ, where fₖ are their distances and pₖ their exponents, and w their weight, the distance is (1 − w)
    (1 − exp(−(f / 0.05)¹⁰)) times the distance above plus w (1 − exp(−(f / 0.3)²)). The factor of the first term is
    nearly 0 for an individual in two poses, even if a body head takes them for two bodies. The second term orders the
    shapes that one of the levels considers the same.

    The cosine distance of whole embeddings is close to the cosine distance of the class embeddings. Search engines that
    only support cosine distances find candidates by whole embeddings or by short vectors (`shorten`); candidates are
    then ranked by `distances`.

    Args:
        class_head: fitted to classes.
        body_heads: fitted to bodies, with lengths; if None, a single head for the whole description.
        scales: of the body heads, in units of their distances (with median 0.5).
        share: share of the squared length of an embedding that belongs to the body heads.
        individual_heads: fitted to individuals, with lengths; none for two levels.
        exponents: pₖ of the individual heads, positive, with sum 1.
        weight: weight w of the individual heads.

    Raises:
        ValueError: a body head or individual head has no lengths, a scale or exponent is missing or not positive, the
            sum of the exponents is not 1, or share or weight is not between 0 and 1.
    """

    scales: Tensor
    exponents: Tensor
    share: Tensor
    weight: Tensor
    principal: Tensor

    def __init__(
        self,
        class_head: WCCNHead | None = None,
        body_heads: Sequence[WCCNHead] | None = None,
        *,
        scales: Sequence[float] = (0.1,),
        share: float = 0.5,
        individual_heads: Sequence[WCCNHead] = (),
        exponents: Sequence[float] = (),
        weight: float = 0.05,
    ) -> None:
        super().__init__()
        self.class_head = class_head or WCCNHead()
        self.body_heads = nn.ModuleList(body_heads or [WCCNHead(n_directions=64, shrinkage=0.3, lengths=True)])
        if len(scales) != len(self.body_heads) or min(scales) <= 0 or not 0 < share < 1:
            raise ValueError(
                f"scales, share: expected a positive scale for each of {len(self.body_heads)} body heads, and a share "
                f"between 0 and 1, got {tuple(scales)} and {share}."
            )
        self.individual_heads = nn.ModuleList(individual_heads)
        if not all(bool(x.lengths) for x in (*self._body_heads(), *self._individual_heads())):
            raise ValueError("body_heads, individual_heads: expected heads with lengths. Use WCCNHead(lengths=True).")
        is_positive = len(exponents) == len(individual_heads) and all(exponent > 0 for exponent in exponents)
        if not is_positive or (exponents and abs(sum(exponents) - 1) > _MIN_DISTANCE):
            raise ValueError(
                f"exponents: expected a positive number for each of {len(individual_heads)} individual heads, with sum "
                f"1, got {tuple(exponents)}."
            )
        check_fraction(weight=weight)
        self.register_buffer("scales", torch.tensor(list(scales)))
        self.register_buffer("share", torch.tensor(share))
        self.register_buffer("exponents", torch.tensor(list(exponents)) if individual_heads else None)
        self.register_buffer("weight", torch.tensor(weight) if individual_heads else None)
        self.register_buffer("principal", torch.zeros(0, 0))

    @torch.no_grad()
    def fit(
        self,
        descriptions: Tensor,
        labels: Tensor,
        part_cells: Sequence[int] | None = None,
        *,
        bodies: Tensor | None = None,
    ) -> Self:
        """Fit both levels to the training shapes, see `Head.fit`; `bodies` (N,) are integers, by default the labels."""
        self.class_head.fit(descriptions, labels, part_cells)
        for head in self._body_heads():
            head.fit(descriptions, labels if bodies is None else bodies, part_cells)
        embeddings = self._two_levels(descriptions)
        self.principal = principal_directions(embeddings.double(), MAX_SHORT_WIDTH)[0].to(embeddings.dtype)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map histograms (N, ...) to embeddings (N, D) of length 1, with the columns of the individual heads last."""
        levels = self._two_levels(descriptions)
        if not self.individual_heads:
            return levels
        individuals = [self._root_individual_share * head(descriptions) for head in self._individual_heads()]
        return torch.cat([math.sqrt(1 - _INDIVIDUAL_SHARE) * levels, *individuals], dim=1)

    @torch.no_grad()
    def fit_individuals(
        self, descriptions: Tensor, individuals: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit the individual heads to histograms (N, ...) of individuals (N,) in several poses."""
        if not self.individual_heads:
            raise ValueError("individual_heads: expected heads to fit, got none.")
        for head in self._individual_heads():
            head.fit(descriptions, individuals, part_cells)
        return self

    def within_class(self, embeddings: Tensor) -> Tensor:
        """Return the columns of embeddings (N, D) by the body heads and the individual heads.

        In the columns of the class head, bodies that are nearly alike differ mostly by the scatter of the samples.
        """
        return embeddings[:, self.class_head.n_numbers :]

    def shorten(self, embeddings: Tensor) -> Tensor:
        """Project embeddings (N, D) to (N, ≤ 256) of length 1, on the principal directions of the training shapes.

        The cosines are close to those without the individual heads, with larger errors for shapes unlike the training
        shapes. Raises a ValueError for embeddings of other heads.
        """
        if not len(self.principal):
            raise self._not_fitted()
        levels, individuals = self._split(embeddings)
        if levels.shape[1] != self.principal.shape[1]:
            n_expected = self.principal.shape[1] + individuals.shape[1]
            raise ValueError(f"embeddings: expected {n_expected} numbers each, got {embeddings.shape[1]}.")
        return functional.normalize(levels @ self.principal.T, dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return distances (Q, G), from 0 to 2, between embeddings (Q, D) and (G, D)."""
        (queries, query_individuals), (gallery, gallery_individuals) = self._split(queries), self._split(gallery)
        n = self.class_head.n_numbers
        classes = cosine(queries[:, :n], gallery[:, :n])
        query_bodies, gallery_bodies = (
            _compared(x[:, n:], self._body_heads(), self._root_share) for x in (queries, gallery)
        )
        exponent = torch.zeros_like(classes)
        for query, other, scale in zip(query_bodies, gallery_bodies, self.scales, strict=True):
            exponent = exponent + (euclidean(query, other) / scale).pow(_STEEPNESS)
        lengths = _mean_lengths(query_bodies)[:, None] * _mean_lengths(gallery_bodies)
        distances = classes * -torch.expm1(-exponent * (lengths / _USUAL_LENGTH**2).pow(_STEEPNESS / 4))
        if not self.individual_heads:
            return distances
        heads, root = self._individual_heads(), self._root_individual_share
        compared = (_compared(x, heads, root) for x in (query_individuals, gallery_individuals))
        individuals = torch.ones_like(distances)
        for query, other, power in zip(*compared, self.exponents, strict=True):
            individuals = individuals * euclidean(query, other).clamp_min(_MIN_DISTANCE).pow(power)
        distances = distances * -torch.expm1(-(individuals / _SAME_INDIVIDUAL).pow(_STEEPNESS))
        return (1 - self.weight) * distances - self.weight * torch.expm1(-(individuals / _INDIVIDUAL_SCALE).square())

    def _two_levels(self, descriptions: Tensor) -> Tensor:
        """Return embeddings (N, D) of length 1 from the class head and the body heads, without individuals."""
        classes = (1 - self.share).sqrt() * self.class_head(descriptions)
        return torch.cat([classes, *(self._root_share * head(descriptions) for head in self._body_heads())], dim=1)

    def _split(self, embeddings: Tensor) -> tuple[Tensor, Tensor]:
        """Split embeddings (N, D) into columns of both levels, without their weight, and columns of individuals."""
        if not self.individual_heads:
            return embeddings, embeddings[:, :0]
        n = sum(head.n_numbers for head in self._individual_heads())
        return embeddings[:, :-n] / math.sqrt(1 - _INDIVIDUAL_SHARE), embeddings[:, -n:]

    def _body_heads(self) -> list[WCCNHead]:
        return [head for head in self.body_heads if isinstance(head, WCCNHead)]

    def _individual_heads(self) -> list[WCCNHead]:
        return [head for head in self.individual_heads if isinstance(head, WCCNHead)]

    @property
    def _root_share(self) -> Tensor:
        return (self.share / len(self.body_heads)).sqrt()

    @property
    def _root_individual_share(self) -> float:
        return math.sqrt(_INDIVIDUAL_SHARE / len(self.individual_heads))


def _compared(embeddings: Tensor, heads: Sequence[WCCNHead], root_share: Tensor | float) -> list[Tensor]:
    """Return the `n_compared` columns of embeddings (N, D) by each head, without its weight."""
    parts = embeddings[:, : sum(head.n_numbers for head in heads)].split([head.n_numbers for head in heads], dim=1)
    return [part[:, : head.n_compared] / root_share for part, head in zip(parts, heads, strict=True)]


def _mean_lengths(bodies: Sequence[Tensor]) -> Tensor:
    """Return the distances (N,) of shapes from the mean, in quadratic mean over the body heads."""
    return square_root(torch.stack([x.square().sum(dim=1) for x in bodies]).mean(dim=0))

"""A head with two levels: other poses of a body rank first, then look-alikes, then other bodies of its class."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

from igps._parameters import check_fraction
from igps.nn.heads.base import Head, principal_directions
from igps.nn.heads.wccn import MEDIAN, WCCNHead
from igps.retrieval.distances import cosine, euclidean, square_root
from igps.retrieval.vectors import MAX_SHORT_WIDTH

# Usual distance of a training shape from the mean: in many dimensions, most pairs of shapes are nearly orthogonal.
_USUAL_LENGTH = MEDIAN / math.sqrt(2)
_STEEPNESS = 20  # exponent of the factors that rise from 0 to 1
_SAME_CLASS = 0.55  # nearly all poses of a scanned body have smaller distances by the class head
_SAME_BODY = 0.1  # nearly all pairs of poses of an unseen generated body are nearer
_WEIGHT = 0.05  # of the term that orders bodies that are nearly alike
# Shorter distances are rounding errors, and fractional powers have no derivative at 0
_MIN_DISTANCE = 1e-7
# Of a distance to its scale: greater ones could overflow, and the factor is 1 long before
_MAX_RATIO = 16


class TwoLevelHead(Head):
    """Maps histograms to unit vectors, with a distance that ranks other poses of a body first, then its class.

    An embedding concatenates the embeddings by a class head, a `WCCNHead` fitted to classes, and by body heads, which
    are `WCCNHead`s with `lengths`, fitted to bodies in several poses, so that they ignore the effects of bending and
    triangulation. Let c be the cosine distance of the class embeddings, dₖ the distances by the body heads, and f = Π
    dₖ^pₖ. The distance is 0.95 times

        c (1 − exp(−(c / 0.55)²⁰ − Σ (dₖ / sₖ)²⁰)) (1 − exp(−(f / 0.1)²⁰)),

    plus 0.05 (1 − exp(−(f / 0.1)²)). The first factor is nearly 0 if c and all dₖ are below their scales, 0.55 and sₖ,
    as between poses of a body, and nearly 1 if any is above its scale. The second factor is nearly 0 if f is as small
    as between poses of a body, even if c or one of the dₖ is not. The factors saturate, as the amount by which two
    bodies differ does not predict their classes. The second term orders bodies that are nearly alike, such as two
    people.

    Far from the mean of the training shapes, distances between different bodies are as small as distances between poses
    elsewhere. The scales sₖ are therefore multiplied by √(ℓ₀ / ℓ). Here ℓ² is the product of the distances of the two
    shapes from the mean, each in quadratic mean over the body heads, and ℓ₀ is the usual distance.

    The cosine distance of whole embeddings is close to the cosine distance of the class embeddings. Search engines that
    only support cosine distances find candidates by whole embeddings or by short vectors (`shorten`); candidates are
    then ranked by `distances`.

    Args:
        class_head: fitted to classes.
        body_heads: fitted to bodies, with lengths; if None, a single head for the whole description.
        scales: sₖ of the body heads, in units of their distances (with median 0.5).
        exponents: pₖ of the body heads, positive, with sum 1.
        share: share of the squared length of an embedding that belongs to the body heads.

    Raises:
        ValueError: a body head has no lengths, a scale or exponent is missing or not positive, the sum of the exponents
            is not 1, or the share is not between 0 and 1.
    """

    scales: Tensor
    exponents: Tensor
    share: Tensor
    principal: Tensor

    def __init__(
        self,
        class_head: WCCNHead | None = None,
        body_heads: Sequence[WCCNHead] | None = None,
        *,
        scales: Sequence[float] = (0.1,),
        exponents: Sequence[float] = (1.0,),
        share: float = 0.5,
    ) -> None:
        super().__init__()
        self.class_head = class_head or WCCNHead()
        self.body_heads = nn.ModuleList(
            body_heads or [WCCNHead(n_directions=64, shrinkage=0.3, lengths=True)]
        )
        n_heads = len(self.body_heads)
        check_fraction(share=share)
        if not all(bool(head.lengths) for head in self._body_heads()):
            raise ValueError("body_heads: expected heads with lengths. Use WCCNHead(lengths=True).")
        if len(scales) != n_heads or min(scales) <= 0:
            raise ValueError(
                f"scales: expected a positive scale for each of {n_heads} body heads, got {tuple(scales)}."
            )
        has_sum = math.isclose(sum(exponents), 1)
        if len(exponents) != n_heads or min(exponents) <= 0 or not has_sum:
            raise ValueError(
                f"exponents: expected a positive number for each of {n_heads} body heads, with sum 1, got "
                f"{tuple(exponents)}."
            )
        self.register_buffer("scales", torch.tensor(list(scales)))
        self.register_buffer("exponents", torch.tensor(list(exponents)))
        self.register_buffer("share", torch.tensor(share))
        self.register_buffer("principal", torch.zeros(0, 0))

    @torch.no_grad()
    def fit(
        self,
        descriptions: Tensor,
        labels: Tensor,
        part_cells: Sequence[int] | None = None,
        *,
        bodies: Tensor | None = None,
        body_descriptions: Tensor | None = None,
    ) -> Self:
        """Fit both levels to the training shapes, see `Head.fit`.

        Args:
            descriptions: (N, ...) histograms.
            labels: (N,) classes, integers.
            part_cells: see `Head.fit`.
            bodies: (M,) integers, by default the labels.
            body_descriptions: (M, ...) histograms of these bodies, by default `descriptions`.

        Raises:
            ValueError: not every description of a body has its body; see also `Head.fit`.
        """
        body_descriptions = descriptions if body_descriptions is None else body_descriptions
        bodies = labels if bodies is None else bodies
        if len(bodies) != len(body_descriptions):
            raise ValueError(
                f"bodies: expected one for each of {len(body_descriptions)} descriptions, got {len(bodies)}. With "
                "body_descriptions, pass their bodies."
            )
        self.class_head.fit(descriptions, labels, part_cells)
        for head in self._body_heads():
            head.fit(body_descriptions, bodies, part_cells)
        embeddings = self(descriptions)
        directions, _ = principal_directions(embeddings.double(), MAX_SHORT_WIDTH)
        self.principal = directions.to(embeddings.dtype)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map histograms (N, ...) to embeddings (N, D) of length 1, with the columns of the body heads last."""
        parts = [(1 - self.share).sqrt() * self.class_head(descriptions)]
        for head in self._body_heads():
            parts.append(self._root_share * head(descriptions))
        return torch.cat(parts, dim=1)

    def within_class(self, embeddings: Tensor) -> Tensor:
        """Return the columns of embeddings (N, D) by the body heads.

        In the columns of the class head, bodies that are nearly alike differ mostly by the scatter of the samples.
        """
        return embeddings[:, self.class_head.n_numbers :]

    def compared_within_class(self, embeddings: Tensor) -> Tensor:
        """Return the columns of the body heads without the lengths behind them, which only scale the distance."""
        return torch.cat(self._compared(embeddings), dim=1) * self._root_share

    def shorten(self, embeddings: Tensor) -> Tensor:
        """Project embeddings (N, D) to (N, ≤ 256) of length 1, on the principal directions of the training shapes.

        The cosines are close to those of the embeddings, with larger errors for shapes unlike the training shapes.
        Raises a ValueError for embeddings of other heads.
        """
        if not len(self.principal):
            raise self._not_fitted()
        if embeddings.shape[1] != self.principal.shape[1]:
            raise ValueError(
                f"embeddings: expected {self.principal.shape[1]} numbers each, got {embeddings.shape[1]}."
            )
        return nn.functional.normalize(embeddings @ self.principal.T, dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return distances (Q, G), from 0 to 2, between embeddings (Q, D) and (G, D)."""
        n = self.class_head.n_numbers
        classes = cosine(queries[:, :n], gallery[:, :n])
        query_bodies = self._compared(queries)
        gallery_bodies = self._compared(gallery)
        exponent = torch.zeros_like(classes)
        bodies = torch.ones_like(classes)
        compared = zip(query_bodies, gallery_bodies, self.scales, self.exponents, strict=True)
        for query, other, scale, power in compared:
            distances = euclidean(query, other).clamp_min(_MIN_DISTANCE)
            exponent = exponent + (distances / scale).clamp_max(_MAX_RATIO).pow(_STEEPNESS)
            bodies = bodies * distances.pow(power)
        lengths = _mean_lengths(query_bodies)[:, None] * _mean_lengths(gallery_bodies)
        exponent = exponent * (lengths / _USUAL_LENGTH**2).pow(_STEEPNESS / 4)
        exponent = exponent + (classes / _SAME_CLASS).pow(_STEEPNESS)
        nearness = bodies / _SAME_BODY
        differ = torch.expm1(-exponent) * torch.expm1(-nearness.pow(_STEEPNESS))
        alike = torch.expm1(-nearness.square())
        return (1 - _WEIGHT) * classes * differ - _WEIGHT * alike

    def _compared(self, embeddings: Tensor) -> list[Tensor]:
        """Return the `n_compared` columns of embeddings (N, D) by each body head, without its share."""
        heads = self._body_heads()
        parts = self.within_class(embeddings).split([head.n_numbers for head in heads], dim=1)
        compared = []
        for part, head in zip(parts, heads, strict=True):
            compared.append(part[:, : head.n_compared] / self._root_share)
        return compared

    def _body_heads(self) -> list[WCCNHead]:
        return [head for head in self.body_heads if isinstance(head, WCCNHead)]

    @property
    def _root_share(self) -> Tensor:
        return (self.share / len(self.body_heads)).sqrt()


def _mean_lengths(bodies: Sequence[Tensor]) -> Tensor:
    """Return the distances (N,) of shapes from the mean, in quadratic mean over the body heads."""
    squares = torch.stack([x.square().sum(dim=1) for x in bodies])
    return square_root(squares.mean(dim=0))

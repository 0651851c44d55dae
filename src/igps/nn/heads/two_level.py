"""A head of levels: poses of an individual come first, then its like, then other bodies of its class, then the rest."""

import math
from collections.abc import Iterator, Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps._parameters import check_share
from igps.nn.heads.base import Head, principal_directions
from igps.nn.heads.wccn import MEDIAN, WCCNHead
from igps.retrieval.distances import cosine, euclidean, square_root
from igps.retrieval.vectors import MOST_NUMBERS

# Their usual distance from the mean: of so many directions most two are nearly at right angles
_USUAL_LENGTH = MEDIAN / math.sqrt(2)
# Exponent of the factor that turns from nothing of a distance to all of it
_STEEPNESS = 10
# Of the squared length of an embedding, what belongs to individuals, and from where on all of their weight counts
_INDIVIDUAL_SHARE, _INDIVIDUAL_SCALE = 0.1, 0.3


class TwoLevelHead(Head):
    """Histograms to unit vectors, and a distance of them by which a body's other poses come first, then its class.

    An embedding is that of a class head, a `WCCNHead` fitted to classes, beside those of body heads, with lengths,
    fitted to bodies, which tell whether two shapes are one body. The distance is the cosine distance of the former,
    times 1 − exp(−Σ (dₖ / sₖ)¹⁰), with dₖ the distances by the body heads and sₖ their scales. Where all dₖ are below
    their scales, as between poses of a body, nothing of the distance is left. Where any is above its scale, all of it
    is left: how different two bodies are says nothing of their classes.

    Far from the mean of the training shapes, other bodies come as near to a body as elsewhere its poses do. So the
    scales are smaller there, by √(ℓ / ℓ₀): ℓ² is the product of the two shapes' distances from the mean, each in
    quadratic mean over the body heads, and ℓ₀ the distance that is usual.

    Bodies may be nearly alike, as two people are. An individual head, with lengths, is fitted by `fit_individuals` to
    individuals in poses, so that it knows what bending and triangles change and what not. With f its distance and w its
    weight, the distance is (1 − w) times that above plus w (1 − exp(−(f / 0.3)²)): a small part of it, that orders what
    the levels of bodies take for one.

    The cosine distance of whole embeddings is nearly that of the classes. Engines that know no other distance find
    candidates by it, which are then ranked by the distance itself; so does that of `short` vectors.

    Args:
        class_head: of the classes.
        body_heads: of the bodies, with lengths; one that sees the whole description if None.
        scales: of each of these, in units of its distances (of which the median is 0.5).
        share: of the squared length of an embedding that belongs to the bodies.
        individual_head: of the individuals, with lengths; None for two levels.
        weight: of the distance of individuals in the whole.

    Raises:
        ValueError: body heads or an individual head without lengths, not a positive scale for each, or a share or a
            weight that is none.
    """

    scales: Tensor
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
        individual_head: WCCNHead | None = None,
        weight: float = 0.1,
    ) -> None:
        super().__init__()
        self.class_head = class_head or WCCNHead()
        self.body_heads = nn.ModuleList(body_heads or [WCCNHead(n_directions=64, shrinkage=0.3, lengths=True)])
        if len(scales) != len(self.body_heads) or min(scales) <= 0 or not 0 < share < 1:
            raise ValueError(
                f"scales, share: expected a positive number for each of {len(self.body_heads)} body heads, and one "
                f"between 0 and 1, got {tuple(scales)} and {share}."
            )
        self.individual_head = individual_head
        if not all(bool(head.lengths) for head in (*self._bodies(), *([individual_head] if individual_head else []))):
            raise ValueError(
                "body_heads, individual_head: expected heads with lengths. Make them by WCCNHead(..., lengths=True)."
            )
        check_share(weight=weight)
        self.register_buffer("scales", torch.tensor(list(scales)))
        self.register_buffer("share", torch.tensor(share))
        self.register_buffer("weight", None if individual_head is None else torch.tensor(weight))
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
        """Fit both levels to the histograms (N, ...), classes (N,) and bodies (N,) of the training shapes.

        Args:
            descriptions, labels, part_cells: see `Head.fit`.
            bodies: integers; the classes where None.
        """
        self.class_head.fit(descriptions, labels, part_cells)
        for head in self._bodies():
            head.fit(descriptions, labels if bodies is None else bodies, part_cells)
        embeddings = self._two_levels(descriptions)
        self.principal = principal_directions(embeddings.double(), MOST_NUMBERS)[0].to(embeddings.dtype)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1, the individuals' numbers last."""
        levels = self._two_levels(descriptions)
        if self.individual_head is None:
            return levels
        individuals = self.individual_head(descriptions)
        return torch.cat([math.sqrt(1 - _INDIVIDUAL_SHARE) * levels, math.sqrt(_INDIVIDUAL_SHARE) * individuals], dim=1)

    @torch.no_grad()
    def fit_individuals(
        self, descriptions: Tensor, individuals: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit the individual head, if there is one, to histograms (N, ...) of individuals (N,) in poses."""
        if self.individual_head is None:
            raise ValueError("individual_head: expected a head to fit, got None.")
        self.individual_head.fit(descriptions, individuals, part_cells)
        return self

    def within_class(self, embeddings: Tensor) -> Tensor:
        """The numbers of bodies and individuals in (N, D) embeddings.

        Between bodies that are nearly alike those of classes hold little but the scatter of the samples.
        """
        return embeddings[:, self.class_head.n_numbers :]

    def short(self, embeddings: Tensor) -> Tensor:
        """(N, D) embeddings to (N, ≤ 256) of length 1, along the principal directions of those of the training shapes.

        For engines that take no more numbers: their cosines are nearly those of the embeddings without the individuals,
        farther from them the less a shape is like those of training. A ValueError of other embeddings than its own.
        """
        if not len(self.principal):
            raise self._not_fitted()
        levels, individuals = self._split(embeddings)
        if levels.shape[1] != self.principal.shape[1]:
            n_expected = self.principal.shape[1] + individuals.shape[1]
            raise ValueError(f"embeddings: expected {n_expected} numbers each, got {embeddings.shape[1]}.")
        return functional.normalize(levels @ self.principal.T, dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) embeddings to (Q, G) distances from 0 to 2."""
        (queries, query_individuals), (gallery, gallery_individuals) = self._split(queries), self._split(gallery)
        n = self.class_head.n_numbers
        classes = cosine(queries[:, :n], gallery[:, :n])
        of_queries, of_gallery = self._of_bodies(queries), self._of_bodies(gallery)
        apart = torch.zeros_like(classes)
        for query, other, scale in zip(of_queries, of_gallery, self.scales, strict=True):
            apart = apart + (euclidean(query, other) / scale).pow(_STEEPNESS)
        lengths = _mean_lengths(of_queries)[:, None] * _mean_lengths(of_gallery)
        found = classes * -torch.expm1(-apart * (lengths / _USUAL_LENGTH**2).pow(_STEEPNESS / 4))
        if self.individual_head is None:
            return found
        near = (euclidean(query_individuals, gallery_individuals) / _INDIVIDUAL_SCALE).square()
        return (1 - self.weight) * found - self.weight * torch.expm1(-near)

    def _two_levels(self, descriptions: Tensor) -> Tensor:
        """(N, D) of length 1, of classes and bodies alone, without individuals."""
        classes = (1 - self.share).sqrt() * self.class_head(descriptions)
        return torch.cat([classes, *(self._root_share * head(descriptions) for head in self._bodies())], dim=1)

    def _split(self, embeddings: Tensor) -> tuple[Tensor, Tensor]:
        """The numbers of classes and bodies in (N, D) embeddings, and those of individuals, each in its own units."""
        if self.individual_head is None:
            return embeddings, embeddings[:, :0]
        n = self.individual_head.n_numbers
        levels, individuals = embeddings[:, :-n], embeddings[:, -n:-1]
        return levels / math.sqrt(1 - _INDIVIDUAL_SHARE), individuals / math.sqrt(_INDIVIDUAL_SHARE)

    def _bodies(self) -> Iterator[WCCNHead]:
        return (head for head in self.body_heads if isinstance(head, WCCNHead))

    def _of_bodies(self, embeddings: Tensor) -> list[Tensor]:
        """The numbers of each body head in (N, D) embeddings, in its own units, without the one for the length 1."""
        start, found = self.class_head.n_numbers, []
        for head in self._bodies():
            found.append(embeddings[:, start : start + head.n_compared] / self._root_share)
            start += head.n_numbers
        return found

    @property
    def _root_share(self) -> Tensor:
        return (self.share / len(self.body_heads)).sqrt()


def _mean_lengths(of_bodies: Sequence[Tensor]) -> Tensor:
    """(N,) distances of shapes from the mean, in quadratic mean over the body heads."""
    return square_root(torch.stack([one.square().sum(dim=1) for one in of_bodies]).mean(dim=0))

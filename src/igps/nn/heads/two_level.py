"""A head of two levels: poses of one body come first, then other bodies of its class, then the rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps.nn.heads.base import SizedByData, check_cells, checked_cells, checked_labels, means_of, square_roots
from igps.retrieval.distances import cosine, euclidean, square_root
from igps.retrieval.vectors import MOST_NUMBERS

# Of a part so many principal directions are whitened; what is beyond them is discretisation
_PRINCIPAL = 500
# Where lengths count: the median distance of training shapes, so that all find room in a sphere of radius 1; and how
# many of the shapes tell it
_MEDIAN, _TELLING = 0.5, 1000
# Their usual distance from the mean: of so many directions most two are nearly at right angles
_USUAL_LENGTH = _MEDIAN / math.sqrt(2)
# The factor between nothing and all of a distance turns from one to the other as steeply
_STEEPNESS = 10


class WCCNHead(SizedByData):
    """Histograms to unit vectors, damped along what tells shapes of one label apart and reduced to what tells labels.

    The square roots of each part are centred, and whitened within labels as `WhitenedHead` does it, then projected on
    the directions in which the means of the labels vary most. The parts, each brought to one length, are joined.
    Source: within-class covariance normalisation, Hatch, Kajarekar and Stolcke 2006.

    By `lengths`, the parts are not brought to one length but keep theirs, so that distances are Mahalanobis': two
    shapes that both hardly differ from the mean are close, where the angle between them may be anything. A last number,
    which makes the vectors unit vectors, is no part of those distances.

    Args:
        parts: which parts of a description it looks at; all if None.
        n_directions: of each part, at most as many as it has cells; so many numbers of each part the vectors have, and
            one more in all with `lengths`.
        shrinkage: added to the covariance within labels, in units of its mean eigenvalue.
        lengths: whether lengths count beside directions.
    """

    mean: Tensor
    directions: Tensor
    part_cells: Tensor
    lengths: Tensor

    def __init__(
        self,
        parts: Sequence[int] | None = None,
        n_directions: int = 60,
        shrinkage: float = 0.03,
        *,
        lengths: bool = False,
    ) -> None:
        super().__init__()
        if n_directions < 1:
            raise ValueError(f"n_directions: expected at least 1, got {n_directions}.")
        if shrinkage <= 0:
            raise ValueError(f"shrinkage: expected a positive number, got {shrinkage}.")
        self.n_directions, self.shrinkage = n_directions, shrinkage
        self._parts = None if parts is None else tuple(parts)
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("directions", torch.zeros(n_directions, 0))
        self.register_buffer("part_cells", torch.zeros(0, dtype=torch.long))
        self.register_buffer("lengths", torch.tensor(lengths))

    @torch.no_grad()
    def fit(self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Take mean and directions from the histograms (N, ...) and labels (N,) of the training shapes.

        Args:
            descriptions: histograms.
            labels: integers.
            part_cells: cells of each part, as a `HistogramDescriptor` tells them; None takes all as one part.

        Raises:
            ValueError: shapes that do not match, a part that is not there, or no label of two shapes.
        """
        roots = square_roots(descriptions)
        _, members = checked_labels(roots, labels).unique(return_inverse=True)
        if int(members.max()) + 1 == len(roots):
            raise ValueError("labels: expected a label of at least two shapes, got as many labels as shapes.")
        cells = checked_cells(roots, part_cells)
        if self._parts is not None and not set(self._parts) <= set(range(len(cells))):
            raise ValueError(f"parts: expected some of 0 to {len(cells) - 1}, got {self._parts}.")
        self.part_cells = torch.tensor(cells, device=roots.device)
        seen = self._seen(roots)
        self.mean = seen.mean(dim=0)
        self.directions = seen.new_zeros(self.n_directions, len(self.mean))
        for part, directions in self._by_part(seen):
            found = self._directions(part.double(), members)
            directions[: len(found)] = found
            if self.lengths:
                some = part[:: max(1, len(part) // _TELLING)] @ directions.T
                median = torch.pdist(some).median().clamp_min(torch.finfo(some.dtype).tiny)
                directions *= _MEDIAN / (median * math.sqrt(len(self._sizes())))
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1.

        Raises:
            RuntimeError: it has not been fitted.
        """
        roots = square_roots(descriptions)
        if not len(self.mean):
            raise RuntimeError("WCCNHead: expected to be fitted first. Call fit(descriptions, labels).")
        check_cells(roots, int(self.part_cells.sum()))
        projected = [part @ directions[: part.shape[1]].T for part, directions in self._by_part(self._seen(roots))]
        if not self.lengths:
            projected = [functional.normalize(part, dim=1) for part in projected]
            return functional.normalize(torch.cat(projected, dim=1), dim=1)
        vectors = torch.cat(projected, dim=1)
        # farther from the mean than any training shape is farthest
        vectors = vectors / torch.linalg.norm(vectors, dim=1, keepdim=True).clamp_min(1)
        height = (1 - vectors.square().sum(dim=1, keepdim=True)).clamp_min(0)
        return torch.cat([vectors, square_root(height)], dim=1)

    @property
    def n_compared(self) -> int:
        """Numbers of a vector that distances are of: without the one that makes the length 1, once fitted."""
        return sum(min(len(self.directions), size) for size in self._sizes())

    @property
    def n_numbers(self) -> int:
        """D of the vectors, once fitted."""
        return self.n_compared + int(self.lengths)

    def _directions(self, part: Tensor, members: Tensor) -> Tensor:
        """(k, cells) that whiten a centred part (N, cells) and keep what tells labels."""
        principal = _principal(part, _PRINCIPAL)
        found = part @ principal.T
        means = means_of(found, members)
        residuals = found - means[members]
        spread, axes = torch.linalg.eigh(residuals.T @ residuals)
        rank = min(len(found) - len(means), len(spread))
        relative = spread.clamp_min(0) * rank / spread.sum()
        whitening = (axes * (self.shrinkage / (self.shrinkage + relative)).sqrt()) @ axes.T
        return _principal(means @ whitening, self.n_directions) @ whitening @ principal

    def _sizes(self) -> list[int]:
        """Cells of each part that it looks at."""
        cells: list[int] = self.part_cells.tolist()
        return cells if self._parts is None else [cells[i] for i in self._parts]

    def _by_part(self, seen: Tensor) -> list[tuple[Tensor, Tensor]]:
        """(N, cells) centred, and the (n_directions, cells) directions, of each part in `_seen` roots."""
        sizes = self._sizes()
        return list(zip((seen - self.mean).split(sizes, dim=1), self.directions.split(sizes, dim=1), strict=True))

    def _seen(self, roots: Tensor) -> Tensor:
        """(N, cells) of the parts that it looks at."""
        if self._parts is None:
            return roots
        parts = roots.split(self.part_cells.tolist(), dim=1)
        return torch.cat([parts[i] for i in self._parts], dim=1)


class TwoLevelHead(SizedByData):
    """Descriptions to unit vectors, and a distance of them by which a body's other poses come first, then its class.

    A vector is that of a `WCCNHead` fitted to the labels of classes, beside those of witnesses of whether two shapes
    are one body, heads with lengths that are fitted to the labels of bodies. The distance is the cosine distance of the
    former, times 1 − exp(−Σ (dₖ / reachₖ)¹⁰), dₖ the distances by the witnesses. Within all reaches, where the poses of
    a body lie, nothing of the distance is left; beyond any of them, where how different two bodies are says nothing of
    their classes, all of it.

    Far from the mean of the training shapes, other bodies come as near to a body as elsewhere its poses do. So a reach
    there is shorter: it is over √(ℓ / ℓ₀), ℓ² the product of the two shapes' distances from the mean, each in quadratic
    mean over the witnesses, and ℓ₀ the distance that is usual.

    The cosine distance of the whole vector is nearly that of the classes, and serves engines that know no other to find
    what is ranked by the distance then; so does that of `short` vectors.

    Args:
        of_classes: head of the level of classes.
        of_bodies: heads of the level of bodies, with lengths; one that sees the whole description if None.
        reaches: of each of these, in units of its distances (of which the median is 0.5).
        share: of the squared length of a vector that belongs to the bodies.

    Raises:
        ValueError: heads of bodies without lengths, not a positive reach for each, or a share that is none.
    """

    reaches: Tensor
    share: Tensor
    principal: Tensor

    def __init__(
        self,
        of_classes: WCCNHead | None = None,
        of_bodies: Sequence[WCCNHead] | None = None,
        *,
        reaches: Sequence[float] = (0.1,),
        share: float = 0.5,
    ) -> None:
        super().__init__()
        self.of_classes = of_classes or WCCNHead()
        self.of_bodies = nn.ModuleList(of_bodies or [WCCNHead(n_directions=64, shrinkage=0.3, lengths=True)])
        if len(reaches) != len(self.of_bodies) or min(reaches) <= 0 or not 0 < share < 1:
            raise ValueError(
                f"reaches, share: expected a positive number for each of {len(self.of_bodies)} heads of bodies, and "
                f"one between 0 and 1, got {tuple(reaches)} and {share}."
            )
        if not all(bool(head.lengths) for head in self.witnesses):
            raise ValueError("of_bodies: expected heads with lengths. Make them by WCCNHead(..., lengths=True).")
        self.register_buffer("reaches", torch.tensor(list(reaches)))
        self.register_buffer("share", torch.tensor(share))
        self.register_buffer("principal", torch.zeros(0, 0))

    @property
    def part_cells(self) -> Tensor:
        """Cells of each part of the descriptions that it was fitted to."""
        return self.of_classes.part_cells

    @property
    def witnesses(self) -> list[WCCNHead]:
        """The heads of the level of bodies."""
        return [head for head in self.of_bodies if isinstance(head, WCCNHead)]

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
            descriptions, labels, part_cells: see `WCCNHead.fit`.
            bodies: integers; the classes where None.
        """
        self.of_classes.fit(descriptions, labels, part_cells)
        for head in self.witnesses:
            head.fit(descriptions, labels if bodies is None else bodies, part_cells)
        vectors = self(descriptions)
        self.principal = _principal(vectors.double(), MOST_NUMBERS).to(vectors.dtype)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1.

        Raises:
            RuntimeError: it has not been fitted.
        """
        classes = (1 - self.share).sqrt() * self.of_classes(descriptions)
        bodies = [self._root_share * head(descriptions) for head in self.witnesses]
        return torch.cat([classes, *bodies], dim=1)

    def short(self, vectors: Tensor) -> Tensor:
        """(N, D) vectors to (N, ≤ 256) of length 1, along the principal directions of those of the training shapes.

        For engines that take no more numbers: their cosines are nearly those of the vectors, farther from them the less
        a shape is like those of training.

        Raises:
            RuntimeError: it has not been fitted.
            ValueError: other vectors than its own.
        """
        if not len(self.principal):
            raise RuntimeError("TwoLevelHead: expected to be fitted first. Call fit(descriptions, labels).")
        if vectors.shape[1] != self.principal.shape[1]:
            raise ValueError(f"vectors: expected {self.principal.shape[1]} numbers each, got {vectors.shape[1]}.")
        return functional.normalize(vectors @ self.principal.T, dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) vectors to (Q, G) distances from 0 to 2."""
        start = self.of_classes.n_numbers
        classes = cosine(queries[:, :start], gallery[:, :start])
        of_queries, of_gallery = self._witnessed(queries), self._witnessed(gallery)
        apart = torch.zeros_like(classes)
        for query, other, reach in zip(of_queries, of_gallery, self.reaches, strict=True):
            apart = apart + (euclidean(query, other) / reach).pow(_STEEPNESS)
        lengths = _lengths(of_queries)[:, None] * _lengths(of_gallery)
        return classes * -torch.expm1(-apart * (lengths / _USUAL_LENGTH**2).pow(_STEEPNESS / 4))

    def _witnessed(self, vectors: Tensor) -> list[Tensor]:
        """The numbers of each witness in (N, D) vectors, in its own units, without the one that makes the length 1."""
        start, found = self.of_classes.n_numbers, []
        for head in self.witnesses:
            found.append(vectors[:, start : start + head.n_compared] / self._root_share)
            start += head.n_numbers
        return found

    @property
    def _root_share(self) -> Tensor:
        return (self.share / len(self.of_bodies)).sqrt()


def _lengths(witnessed: Sequence[Tensor]) -> Tensor:
    """(N,) distances of shapes from the mean, in quadratic mean over the witnesses."""
    return square_root(torch.stack([one.square().sum(dim=1) for one in witnessed]).mean(dim=0))


def _principal(rows: Tensor, n: int) -> Tensor:
    """(k, D) orthonormal principal directions of rows (N, D) about the origin, the largest first, k ≤ n."""
    n_rows, width = rows.shape
    if width <= n_rows:
        squares, axes = torch.linalg.eigh(rows.T @ rows)
    else:  # the same from the smaller matrix
        squares, axes = torch.linalg.eigh(rows @ rows.T)
    # What is left of the others is rounding: it has no direction.
    kept = int((squares > 1e-10 * squares[-1]).sum().clamp_max(n))
    squares, axes = squares.flip(0)[:kept], axes.flip(1)[:, :kept]
    return axes.T if width <= n_rows else (axes.T @ rows) / squares.sqrt()[:, None]

"""A head of two levels: poses of one body come first, then other bodies of its class, then the rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps.nn.heads import SizedByData, check_cells, checked_cells, checked_labels, means_of, square_roots
from igps.retrieval.distances import cosine, euclidean, square_root

# Of a part so many principal directions are whitened; what is beyond them is discretisation
_PRINCIPAL = 500
# Where lengths count: the median distance of training shapes, so that all find room in a sphere of radius 1; and how
# many of the shapes tell it
_MEDIAN, _TELLING = 0.5, 1000


class LevelHead(SizedByData):
    """Histograms to unit vectors, damped along what tells shapes of one label apart and reduced to what tells labels.

    The square roots of each part are centred, and whitened within labels as `WhitenedHead` does it, then projected on
    the directions in which the means of the labels vary most. The parts, each brought to one length, are joined, and
    projected on their principal directions. Source: within-class covariance normalisation, Hatch, Kajarekar and Stolcke
    2006.

    By `lengths`, the parts are not brought to one length but keep theirs, so that distances are Mahalanobis': two
    shapes that both hardly differ from the mean are close, where the angle between them may be anything. A last number,
    which makes the vectors unit vectors, is no part of those distances.

    Args:
        parts: which parts of a description it looks at; all if None.
        width: D of the vectors, at most; one more with `lengths`.
        n_directions: of each part, at most.
        shrinkage: added to the covariance within labels, in units of its mean eigenvalue.
        lengths: whether lengths count beside directions.
    """

    mean: Tensor
    directions: Tensor
    joined: Tensor
    part_cells: Tensor
    lengths: Tensor

    def __init__(
        self,
        parts: Sequence[int] | None = None,
        width: int = 128,
        n_directions: int = 60,
        shrinkage: float = 0.03,
        *,
        lengths: bool = False,
    ) -> None:
        super().__init__()
        if min(width, n_directions) < 1:
            raise ValueError(f"width, n_directions: expected at least 1, got {width} and {n_directions}.")
        if shrinkage <= 0:
            raise ValueError(f"shrinkage: expected a positive number, got {shrinkage}.")
        self.width, self.n_directions, self.shrinkage = width, n_directions, shrinkage
        self._parts = None if parts is None else tuple(parts)
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("directions", torch.zeros(n_directions, 0))
        self.register_buffer("joined", torch.zeros(0, 0))
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
        self.mean = roots.mean(dim=0)
        self.directions = roots.new_zeros(self.n_directions, len(self.mean))
        for part, directions in zip(self._chosen(roots - self.mean), self._chosen(self.directions), strict=True):
            found = self._directions(part.double(), members)
            directions[: len(found)] = found
            if self.lengths:
                some = part[:: max(1, len(part) // _TELLING)] @ directions.T
                median = torch.pdist(some).median().clamp_min(torch.finfo(some.dtype).tiny)
                directions *= _MEDIAN / (median * math.sqrt(len(self._chosen(roots))))
        self.joined = torch.eye(len(self._chosen(roots)) * self.n_directions, dtype=roots.dtype, device=roots.device)
        self.joined = _principal(self._vectors(roots).double(), self.width).to(roots.dtype)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1.

        Raises:
            RuntimeError: it has not been fitted.
        """
        roots = square_roots(descriptions)
        if not len(self.mean):
            raise RuntimeError("LevelHead: expected to be fitted first. Call fit(descriptions, labels).")
        check_cells(roots, len(self.mean))
        vectors = self._vectors(roots)
        if not self.lengths:
            return functional.normalize(vectors, dim=1)
        # farther from the mean than any training shape is farthest
        vectors = vectors / torch.linalg.norm(vectors, dim=1, keepdim=True).clamp_min(1)
        height = (1 - vectors.square().sum(dim=1, keepdim=True)).clamp_min(0)
        return torch.cat([vectors, square_root(height)], dim=1)

    @property
    def n_numbers(self) -> int:
        """D of the vectors, once fitted."""
        return len(self.joined) + int(self.lengths)

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

    def _vectors(self, roots: Tensor) -> Tensor:
        projected = [
            part @ directions.T
            for part, directions in zip(self._chosen(roots - self.mean), self._chosen(self.directions), strict=True)
        ]
        if not self.lengths:
            projected = [functional.normalize(part, dim=1) for part in projected]
        return torch.cat(projected, dim=1) @ self.joined.T

    def _chosen(self, cells: Tensor) -> list[Tensor]:
        """Views of (N, cells) values, one of each part that it looks at."""
        parts = cells.split(self.part_cells.tolist(), dim=1)
        return list(parts) if self._parts is None else [parts[i] for i in self._parts]


class TwoLevelHead(nn.Module):
    """Descriptions to unit vectors, and a distance of them by which a body's other poses come first, then its class.

    A vector is that of a `LevelHead` fitted to the labels of classes, beside those of witnesses of whether two shapes
    are one body, heads that are fitted to the labels of bodies. The distance is the cosine distance of the former,
    times 1 − exp(−Σ (dₖ / reachₖ)⁶), dₖ the distances by the witnesses. Within all reaches, where the poses of a body
    lie, nothing of the distance is left; beyond any of them, where how different two bodies are says nothing of their
    classes, all of it. The cosine distance of the whole vector is nearly that of the classes, and serves engines that
    know no other to find what is ranked by the distance then.

    Args:
        of_classes: head of the level of classes.
        of_bodies: heads of the level of bodies; one that sees the whole description if None.
        reaches: of each of these, in units of its distances (of which the median is 0.5 where lengths count).
        share: of the squared length of a vector that belongs to the bodies.
    """

    reaches: Tensor
    share: Tensor

    def __init__(
        self,
        of_classes: LevelHead | None = None,
        of_bodies: Sequence[LevelHead] | None = None,
        *,
        reaches: Sequence[float] = (0.1,),
        share: float = 0.5,
    ) -> None:
        super().__init__()
        self.of_classes = of_classes or LevelHead(width=192)
        self.of_bodies = nn.ModuleList(of_bodies or [LevelHead(width=64, shrinkage=0.3, lengths=True)])
        if len(reaches) != len(self.of_bodies) or min(reaches) <= 0 or not 0 < share < 1:
            raise ValueError(
                f"reaches, share: expected a positive number for each of {len(self.of_bodies)} heads of bodies, and "
                f"one between 0 and 1, got {tuple(reaches)} and {share}."
            )
        self.register_buffer("reaches", torch.tensor(list(reaches)))
        self.register_buffer("share", torch.tensor(share))

    @property
    def part_cells(self) -> Tensor:
        """Cells of each part of the descriptions that it was fitted to."""
        return self.of_classes.part_cells

    @property
    def witnesses(self) -> list[LevelHead]:
        """The heads of the level of bodies."""
        return [head for head in self.of_bodies if isinstance(head, LevelHead)]

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
            descriptions, labels, part_cells: see `LevelHead.fit`.
            bodies: integers; the classes where None.
        """
        self.of_classes.fit(descriptions, labels, part_cells)
        for head in self.witnesses:
            head.fit(descriptions, labels if bodies is None else bodies, part_cells)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1.

        Raises:
            RuntimeError: it has not been fitted.
        """
        classes = (1 - self.share).sqrt() * self.of_classes(descriptions)
        bodies = [self._root_share * head(descriptions) for head in self.witnesses]
        return torch.cat([classes, *bodies], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) vectors to (Q, G) distances from 0 to 2."""
        start = self.of_classes.n_numbers
        classes = cosine(queries[:, :start], gallery[:, :start])
        apart = torch.zeros_like(classes)
        for head, reach in zip(self.witnesses, self.reaches, strict=True):
            own = slice(start, start + len(head.joined))  # without what makes the length 1
            apart = apart + (euclidean(queries[:, own], gallery[:, own]) / (self._root_share * reach)).pow(6)
            start += head.n_numbers
        return classes * -torch.expm1(-apart)

    @property
    def _root_share(self) -> Tensor:
        return (self.share / len(self.of_bodies)).sqrt()


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

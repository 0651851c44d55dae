"""A head whitened within classes, which keeps what tells classes apart."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from igps._parameters import check_at_least, check_positive
from igps.nn.heads.base import (
    Head,
    check_cells,
    checked_parts,
    class_means,
    class_members,
    damped,
    principal_directions,
    square_roots,
    within_class_whitening,
)
from igps.retrieval.distances import square_root

# Of a part so many principal directions are whitened; what is beyond them is discretisation
_PRINCIPAL = 500
# Where lengths count: the median distance of training shapes, so that all find room in a sphere of radius 1; and how
# many of the shapes the median is taken over
MEDIAN, _SAMPLED = 0.5, 1000


class WCCNHead(Head):
    """Histograms to unit vectors, whitened within classes and reduced to the directions that tell classes apart.

    The square roots of each part are centred and whitened, see `within_class_whitening`, then projected on the
    directions in which the means of the classes vary most. The parts, each brought to one length, are joined.

    By `lengths`, the parts keep their lengths, so that distances are Mahalanobis': two shapes that both hardly differ
    from the mean are close, where the angle between them may be anything. One more number, the last, makes the vectors
    unit vectors, and is no part of those distances.

    Args:
        parts: which parts of a description it looks at; all if None.
        n_directions: numbers of each part in a vector, at most as many as the part has cells.
        shrinkage: added to the covariance within classes, in units of its mean eigenvalue.
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
        check_at_least(1, n_directions=n_directions)
        check_positive(shrinkage=shrinkage)
        self.n_directions, self.shrinkage = n_directions, shrinkage
        self._parts = None if parts is None else tuple(parts)
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("directions", torch.zeros(n_directions, 0))
        self.register_buffer("part_cells", torch.zeros(0, dtype=torch.long))
        self.register_buffer("lengths", torch.tensor(lengths))
        self._note_buffers()

    @torch.no_grad()
    def fit(self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Take mean and directions from the training shapes, see `Head.fit`."""
        roots = square_roots(descriptions)
        members = class_members(roots, labels)
        self.part_cells = checked_parts(roots, part_cells)
        self._note_buffers()
        n_parts = len(self.part_cells)
        if self._parts is not None and not set(self._parts) <= set(range(n_parts)):
            raise ValueError(f"parts: expected some of 0 to {n_parts - 1}, got {self._parts}.")
        seen = self._seen(roots)
        self.mean = seen.mean(dim=0)
        self.directions = seen.new_zeros(self.n_directions, len(self.mean))
        for part, directions in self._by_part(seen):
            found = self._directions(part.double(), members)
            directions[: len(found)] = found
            if self.lengths:
                some = part[:: max(1, len(part) // _SAMPLED)] @ directions.T
                median = torch.pdist(some).median().clamp_min(torch.finfo(some.dtype).tiny)
                directions *= MEDIAN / (median * math.sqrt(len(self._sizes())))
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1."""
        roots = square_roots(descriptions)
        if not len(self.mean):
            raise self._not_fitted()
        check_cells(roots, sum(self._noted["part_cells"]))
        projected = [part @ directions[: part.shape[1]].T for part, directions in self._by_part(self._seen(roots))]
        if not self._noted["lengths"]:
            projected = [functional.normalize(part, dim=1) for part in projected]
            return functional.normalize(torch.cat(projected, dim=1), dim=1)
        vectors = torch.cat(projected, dim=1)
        # What is farther from the mean than any training shape is put on the sphere
        vectors = vectors / torch.linalg.norm(vectors, dim=1, keepdim=True).clamp_min(1)
        height = (1 - vectors.square().sum(dim=1, keepdim=True)).clamp_min(0)
        return torch.cat([vectors, square_root(height)], dim=1)

    @property
    def n_compared(self) -> int:
        """How many numbers of a vector distances use, once fitted: all but the one that makes the length 1."""
        return sum(min(len(self.directions), size) for size in self._sizes())

    @property
    def n_numbers(self) -> int:
        """D of the vectors, once fitted."""
        return self.n_compared + self._noted["lengths"]

    def _directions(self, part: Tensor, members: Tensor) -> Tensor:
        """(k, cells) that whiten a centred part (N, cells) and keep what tells classes apart."""
        principal, _ = principal_directions(part, _PRINCIPAL)
        found = part @ principal.T
        means = class_means(found, members)
        rank, width = min(len(found) - len(means), len(principal)), len(principal)
        whitening = within_class_whitening(found - means[members], rank, self.shrinkage, width)
        kept, _ = principal_directions(damped(means, *whitening), self.n_directions)
        return damped(kept, *whitening) @ principal

    def _sizes(self) -> list[int]:
        """Cells of each part that it looks at."""
        cells: list[int] = self._noted["part_cells"]
        return cells if self._parts is None else [cells[i] for i in self._parts]

    def _by_part(self, seen: Tensor) -> list[tuple[Tensor, Tensor]]:
        """(N, cells) centred, and the (n_directions, cells) directions, of each part in `_seen` roots."""
        sizes = self._sizes()
        centred = seen - self.mean
        return list(zip(centred.split(sizes, 1), self.directions.to(centred.dtype).split(sizes, 1), strict=True))

    def _seen(self, roots: Tensor) -> Tensor:
        """(N, cells) of the parts that it looks at."""
        if self._parts is None:
            return roots
        parts = roots.split(self._noted["part_cells"], dim=1)
        return torch.cat([parts[i] for i in self._parts], dim=1)

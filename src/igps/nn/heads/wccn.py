"""A head that whitens within classes and projects on the directions that distinguish classes."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from igps._parameters import check_at_least, check_positive
from igps._tensors import above_zero
from igps.nn.heads.base import (
    Head,
    check_cells,
    check_parts,
    class_means,
    class_members,
    damped,
    principal_directions,
    square_roots,
    within_class_whitening,
)
from igps.retrieval.distances import square_root

_N_PRINCIPAL = 500  # principal directions of a part that are whitened; the others contain discretisation errors
MEDIAN = 0.5  # median distance of training shapes, with lengths, so that all shapes fit in a sphere of radius 1
_N_MEDIAN_SHAPES = 1000  # approximate number of training shapes that the median is computed from


class WCCNHead(Head):
    """Maps histograms to unit vectors, whitened within classes and reduced to directions that distinguish classes.

    The square roots of each part are centred and whitened, see `within_class_whitening`, then projected on the
    directions in which the class means vary most. The parts are normalised to equal lengths and concatenated.

    With `lengths`, the parts keep their lengths, so that distances are Mahalanobis distances: two shapes near the mean
    are close, although the angle between them is arbitrary. An additional last column, which these distances do not
    use, makes the vectors unit vectors.

    Args:
        parts: indices of the parts of a description that the head uses; all if None.
        n_directions: number of columns of each part in a vector, at most the number of its cells.
        shrinkage: added to the covariance within classes, in units of its mean eigenvalue.
        lengths: whether vectors keep their lengths.
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
        self.n_directions = n_directions
        self.shrinkage = shrinkage
        self._parts = None if parts is None else tuple(parts)
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("directions", torch.zeros(n_directions, 0))
        self.register_buffer("part_cells", torch.zeros(0, dtype=torch.long))
        self.register_buffer("lengths", torch.tensor(lengths))
        self._note_buffers()

    @torch.no_grad()
    def fit(
        self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit mean and directions to the training shapes, see `Head.fit`."""
        roots = square_roots(descriptions)
        members = class_members(roots, labels)
        self.part_cells = check_parts(roots, part_cells)
        self._note_buffers()
        n_parts = len(self.part_cells)
        if self._parts is not None and not set(self._parts) <= set(range(n_parts)):
            raise ValueError(f"parts: expected indices from 0 to {n_parts - 1}, got {self._parts}.")
        used = self._select_parts(roots)
        self.mean = used.mean(dim=0)
        self.directions = used.new_zeros(self.n_directions, len(self.mean))
        for part, directions in self._by_part(used):
            own_directions = self._directions(part.double(), members)
            directions[: len(own_directions)] = own_directions
            if self.lengths:
                step = max(1, len(part) // _N_MEDIAN_SHAPES)
                distances = torch.pdist(part[::step] @ directions.T)
                median = above_zero(distances.median())
                directions *= MEDIAN / (median * math.sqrt(len(self._sizes())))
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map histograms (N, ...) to vectors (N, D) of length 1."""
        roots = square_roots(descriptions)
        if not len(self.mean):
            raise self._not_fitted()
        check_cells(roots, sum(self._noted["part_cells"]))
        parts = self._by_part(self._select_parts(roots))
        projected = [part @ directions[: part.shape[1]].T for part, directions in parts]
        if not self._noted["lengths"]:
            projected = [functional.normalize(part, dim=1) for part in projected]
            return functional.normalize(torch.cat(projected, dim=1), dim=1)
        vectors = torch.cat(projected, dim=1)
        # Shapes farther from the mean than any training shape are moved onto the sphere.
        lengths = torch.linalg.norm(vectors, dim=1, keepdim=True)
        vectors = vectors / lengths.clamp_min(1)
        squares = vectors.square().sum(dim=1, keepdim=True)
        height = square_root((1 - squares).clamp_min(0))
        return torch.cat([vectors, height], dim=1)

    @property
    def n_compared(self) -> int:
        """The number of columns that distances use, once fitted: all but the column that makes the length 1."""
        return sum(min(len(self.directions), size) for size in self._sizes())

    @property
    def n_numbers(self) -> int:
        """The width D of the vectors, once fitted."""
        return self.n_compared + self._noted["lengths"]

    def _directions(self, part: Tensor, members: Tensor) -> Tensor:
        """Return directions (k, cells) that whiten a centred part (N, cells) and distinguish the classes."""
        principal, _ = principal_directions(part, _N_PRINCIPAL)
        projected = part @ principal.T
        means = class_means(projected, members)
        rank = min(len(projected) - len(means), len(principal))
        width = len(principal)
        whitening = within_class_whitening(projected - means[members], rank, self.shrinkage, width)
        between_classes, _ = principal_directions(damped(means, *whitening), self.n_directions)
        return damped(between_classes, *whitening) @ principal

    def _sizes(self) -> list[int]:
        """Return the number of cells of each used part."""
        cells: list[int] = self._noted["part_cells"]
        return cells if self._parts is None else [cells[i] for i in self._parts]

    def _by_part(self, used: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the centred cells (N, cells) and the directions (n_directions, cells) of each used part."""
        sizes = self._sizes()
        centred = used - self.mean
        directions = self.directions.to(centred.dtype)
        parts = zip(centred.split(sizes, 1), directions.split(sizes, 1), strict=True)
        return list(parts)

    def _select_parts(self, roots: Tensor) -> Tensor:
        """Return the cells (N, cells) of all used parts."""
        if self._parts is None:
            return roots
        parts = roots.split(self._noted["part_cells"], dim=1)
        return torch.cat([parts[i] for i in self._parts], dim=1)

"""A head that is trained by gradients, and a distance that blends a head's distance with a plain one."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps._parameters import check_at_least
from igps._tensors import above_zero
from igps.nn.heads.base import Head, check_cells, square_roots
from igps.retrieval.distances import chi_square


class ProjectionHead(Head):
    """One or two layers from histograms to unit vectors, trained by gradients.

    The inputs are the square roots of histograms, whose Euclidean distances are Hellinger distances; the root reduces
    the influence of the largest cells. The first layer takes its size from the first descriptions.

    Args:
        width: embedding width D.
        n_hidden: units of the hidden layer; 0 makes the head linear.
        dropout: share of hidden units dropped in training.
        cell_dropout: share of cells dropped in training.
    """

    mean: Tensor
    scale: Tensor

    def __init__(
        self, width: int = 64, n_hidden: int = 256, dropout: float = 0.5, cell_dropout: float = 0.2
    ) -> None:
        super().__init__()
        check_at_least(1, width=width)
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("scale", torch.ones(()))
        layers: list[nn.Module] = [nn.Dropout(cell_dropout), nn.LazyLinear(n_hidden or width)]
        if n_hidden:
            layers += [nn.GELU(), nn.Dropout(dropout), nn.Linear(n_hidden, width)]
        self.layers = nn.Sequential(*layers)

    @torch.no_grad()
    def fit(
        self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit the centring and scaling of the inputs to the histograms (N, ...) of the training shapes, N ≥ 2.

        The layers are trained by gradients; labels and parts are ignored.
        """
        roots = square_roots(descriptions)
        if len(roots) < 2:
            raise ValueError(
                f"descriptions: expected those of at least two training shapes, got {len(roots)}."
            )
        self.mean = roots.mean(dim=0)
        # One scale for all cells, as a scale for each would amplify the cells that are nearly always empty.
        self.scale.copy_(above_zero(roots.std(dim=0).mean()))
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map histograms (N, ...) to embeddings (N, D) of length 1."""
        roots = square_roots(descriptions)
        if len(self.mean):
            check_cells(roots, len(self.mean))
            roots = (roots - self.mean) / self.scale
        return functional.normalize(self.layers(roots), dim=1)


class BlendedDistance(nn.Module):
    """A weighted sum of the plain distance χ² and a head's distance, each over its median between training shapes.

    A head with free parameters specialises in the training classes; the sum with the plain distance can also improve
    the distances of other classes. Without a head, the plain distance is used alone.

    Args:
        head: maps descriptions to embeddings; None for the plain distance.
        share: weight of the head's distance, from 0 (only the plain distance) to 1 (only the head's, over its median).
    """

    plain_unit: Tensor
    learned_unit: Tensor

    def __init__(self, head: Head | None = None, *, share: float = 0.5) -> None:
        super().__init__()
        if not 0 <= share <= 1:
            raise ValueError(f"share: expected a number from 0 to 1, got {share}.")
        self.head = head
        self.share = share
        self.register_buffer("plain_unit", torch.ones(()))
        self.register_buffer("learned_unit", torch.ones(()))

    @torch.no_grad()
    def calibrate(self, descriptions: Tensor) -> None:
        """Fit the units to the descriptions (N, ...) of the training shapes, after the head is trained."""
        if self.head is None:
            return
        embedding = self.head(descriptions)
        self.plain_unit.copy_(_median(chi_square(descriptions, descriptions)))
        self.learned_unit.copy_(_median(self.head.distances(embedding, embedding)))

    def forward(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return distances (Q, G) between descriptions (Q, ...) and (G, ...)."""
        plain = chi_square(queries, gallery)
        if self.head is None:
            return plain
        learned = self.head.distances(self.head(queries), self.head(gallery))
        plain_share = (1 - self.share) * plain / self.plain_unit
        return plain_share + self.share * learned / self.learned_unit


def _median(distances: Tensor) -> Tensor:
    """Return the median of the distances (N, N) between different shapes, which is not 0."""
    n = len(distances)
    i, j = torch.triu_indices(n, n, 1)
    return above_zero(distances[i, j].median())

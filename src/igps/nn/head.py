"""What gradients learn on top of histograms: an embedding, weights of the χ² cells, a correction of the distance."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps.retrieval import chi_square, cosine


def square_roots(histograms: Tensor, n_cells: int) -> Tensor:
    """(N, ...) histograms to the (N, n_cells) square roots of their cells, unit vectors with a finite gradient.

    Raises:
        ValueError: another number of cells.
    """
    cells = histograms.flatten(1)
    if cells.shape[1] != n_cells:
        raise ValueError(f"histograms: expected {n_cells} cells, got {cells.shape[1]}.")
    # The root's gradient is infinite at an empty cell, where it is of no use.
    filled = cells > 0
    return torch.where(filled, torch.where(filled, cells, 1.0).sqrt(), 0.0)


class MetricHead(nn.Module):
    """Histograms to unit vectors whose cosine distance is a learned metric.

    The square root of a histogram is a unit vector too (its distances are Hellinger's), which tames its largest cells.

    Args:
        n_cells: cells of a histogram, over all its dimensions.
        width: D of the embedding.
        n_hidden: units of the hidden layer; 0 makes the head linear.
        dropout: share of hidden units dropped in training.
        cell_dropout: share of cells dropped in training.
    """

    mean: Tensor
    scale: Tensor

    def __init__(
        self, n_cells: int, width: int = 64, n_hidden: int = 256, dropout: float = 0.5, cell_dropout: float = 0.2
    ) -> None:
        super().__init__()
        for name, value in (("n_cells", n_cells), ("width", width)):
            if value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}.")
        self.register_buffer("mean", torch.zeros(n_cells))
        self.register_buffer("scale", torch.ones(()))
        layers: list[nn.Module] = [nn.Dropout(cell_dropout), nn.Linear(n_cells, n_hidden or width)]
        if n_hidden:
            layers += [nn.GELU(), nn.Dropout(dropout), nn.Linear(n_hidden, width)]
        self.layers = nn.Sequential(*layers)

    @torch.no_grad()
    def calibrate(self, histograms: Tensor) -> None:
        """Centre and scale the inputs by the histograms (N, ...) of the training shapes, N at least 2."""
        roots = square_roots(histograms, len(self.mean))
        if len(roots) < 2:
            raise ValueError(f"histograms: expected at least two training shapes, got {len(roots)}.")
        self.mean.copy_(roots.mean(dim=0))
        # One scale for all cells: a scale for each would blow up the cells that are nearly always empty.
        self.scale.copy_(roots.std(dim=0).mean().clamp_min(torch.finfo(roots.dtype).tiny))

    def forward(self, histograms: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1."""
        roots = square_roots(histograms, len(self.mean))
        return functional.normalize(self.layers((roots - self.mean) / self.scale), dim=1)


class LearnedChiSquare(nn.Module):
    """χ² with a non-negative weight for each cell; as made, the plain χ².

    Args:
        shape: of a histogram, or a shape that broadcasts to it, so that cells share weights (such as (1, B)).
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        # softplus⁻¹(1)
        self.raw = nn.Parameter(torch.full(shape, 1.0).expm1().log())

    @property
    def weights(self) -> Tensor:
        """The weights, 1 as made."""
        return functional.softplus(self.raw)

    def forward(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, ...) and (G, ...) histograms to (Q, G) distances."""
        return chi_square(queries, gallery, self.weights)


class CorrectedDistance(nn.Module):
    """A plain distance, corrected by a head: a weighted sum of the two, each in units of its median in training.

    A free metric forgets what it was not trained on; as a correction it may gain on classes never seen as well. Without
    a head this is the plain distance.

    Args:
        head: histograms to embeddings, or None.
        plain: (Q, ...) and (G, ...) histograms to (Q, G) distances.
        share: of the head's distance in the sum, from 0 (plain) to 1 (the head alone).
    """

    plain_unit: Tensor
    learned_unit: Tensor

    def __init__(self, head: nn.Module | None = None, plain: nn.Module | None = None, share: float = 0.5) -> None:
        super().__init__()
        if not 0 <= share <= 1:
            raise ValueError(f"share: expected a number from 0 to 1, got {share}.")
        self.head = head
        self.plain = plain
        self.share = share
        self.register_buffer("plain_unit", torch.ones(()))
        self.register_buffer("learned_unit", torch.ones(()))

    @torch.no_grad()
    def calibrate(self, histograms: Tensor) -> None:
        """Take the units from the histograms (N, ...) of the training shapes, after the head is trained."""
        if self.head is None:
            return
        pairs = tuple(torch.triu_indices(len(histograms), len(histograms), 1))
        embedding = self.head(histograms)
        for unit, distances in (
            (self.plain_unit, self.plain_distance(histograms, histograms)),
            (self.learned_unit, cosine(embedding, embedding)),
        ):
            unit.copy_(distances[pairs].median().clamp_min(torch.finfo(distances.dtype).tiny))

    def forward(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, ...) and (G, ...) histograms to (Q, G) distances."""
        plain = self.plain_distance(queries, gallery)
        if self.head is None:
            return plain
        learned = cosine(self.head(queries), self.head(gallery))
        return (1 - self.share) * plain / self.plain_unit + self.share * learned / self.learned_unit

    def plain_distance(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, ...) and (G, ...) histograms to (Q, G) distances without the head."""
        return chi_square(queries, gallery) if self.plain is None else self.plain(queries, gallery)

"""Histograms beside the size of a body."""

import torch
from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.nn.descriptor import HistogramDescriptor
from igps.retrieval import chi_square

_HALF_SIZE = 0.3  # difference in size, in logarithms, at which half of the χ² distance counts


class SizedHistograms(HistogramDescriptor):
    """Histograms and the size of a body.

    The distance of two bodies is d·s / (0.3 + s), where d is the χ² distance of the histograms and s the difference in
    size, |Δ log area| + |Δ log volume|. The last two numbers of a description are these logarithms.
    """

    search_distance = None

    @property
    def n_features(self) -> int:
        """Number of cells of all parts, plus two for the logarithms."""
        return super().n_features + 2

    def without_size(self) -> HistogramDescriptor:
        """Return a descriptor of the histograms alone."""
        invariant_to = (*self.invariant_to, "scale")
        return HistogramDescriptor(
            self.parts,
            name=self.name,
            source=self.source,
            invariant_to=invariant_to,
            shares=self.shares,
        )

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, cells + 2) descriptions: histograms, log area, log volume."""
        size = torch.stack([batch.area, batch.volume], dim=1).log()
        return torch.cat([super().describe(batch), size.float()], dim=1)

    def column_names(self, width: int) -> list[str]:
        """Return the names of the cells, then those of the logarithms."""
        return [*super().column_names(width - 2), "size.log_area", "size.log_volume"]

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) distances."""
        size = torch.cdist(queries[:, -2:], gallery[:, -2:], p=1)
        return chi_square(queries[:, :-2], gallery[:, :-2]) * size / (_HALF_SIZE + size)

    def coordinates(self, descriptions: Tensor, *, within_class: bool = False) -> Tensor:
        """(N, cells) square roots of the histograms, without the logarithms, which would dominate all distances."""
        return descriptions[:, :-2].sqrt()

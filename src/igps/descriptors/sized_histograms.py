"""Histograms beside the size of a body."""

import torch
from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.descriptors.size_and_side import add_size
from igps.nn.descriptor import HistogramDescriptor
from igps.retrieval import chi_square


class SizedHistograms(HistogramDescriptor):
    """Histograms and the size of a body.

    The distance of two bodies is d + (d + n) s / 0.5 as in `SizeAndSide`, where d is the χ² distance of the
    histograms, s the difference in size, |Δ log area| + |Δ log volume|, and n a quarter of the scale. The last two
    numbers of a description are these logarithms.
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
        differences = torch.cdist(queries[:, -2:], gallery[:, -2:], p=1)
        distances = chi_square(queries[:, :-2], gallery[:, :-2])
        return add_size(distances, differences, self.scale or 0.0)

    def coordinates(self, descriptions: Tensor, *, within_class: bool = False) -> Tensor:
        """(N, cells) square roots of the histograms, without the logarithms, which would dominate all distances."""
        return descriptions[:, :-2].sqrt()

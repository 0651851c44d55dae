"""Descriptors that are combined with histograms of attributes of the samples."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.descriptors.size_and_side import SCALES, SizeAndSide, scale_of
from igps.nn.axes import Attribute, InteriorDistance
from igps.nn.descriptor import Descriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square

_N_SAMPLES = 2000
# Number of distance bins, and how many of them are merged at each level of the comparison. Fine textures need narrow
# bins, conformations of a molecule change distances, and for some bodies only the mixture of attributes counts.
_N_BINS = 32
_N_MERGED_BINS = (1, 4, 32)


class WithAttributes(Descriptor):
    """A descriptor with joint histograms of attributes and interior distances: `NAME+ATTRIBUTE` or `NAME+ATTRIBUTE=w`.

    The distance of two bodies is d + w·(s/t)·c. Here d is the distance by the descriptor, s its scale (the median
    distance between bodies of one class), c the χ² distance of the histograms of the attribute, averaged over 32, 8 and
    1 distance bins, and t the scale of `interior`, which compares similar histograms. So form and attribute count alike
    for a weight w of 1. An attribute has eight classes, whose centres are quantiles of the collection.

    Args:
        descriptor: a descriptor of known scale.
        attributes: names of scalar attributes.
        weights: one for each attribute.

    Raises:
        ValueError: the scale of the descriptor is not known, or a weight is not positive.
    """

    def __init__(
        self, descriptor: Descriptor, attributes: Sequence[str], weights: Sequence[float]
    ) -> None:
        super().__init__()
        scale = scale_of(descriptor)
        if scale is None or not all(0 < weight < float("inf") for weight in weights):
            raise ValueError(
                f"with: expected positive weights and a descriptor of known scale, got {weights} and "
                f"{descriptor.name!r}. Set its attribute `scale` to the median of its distances within a class."
            )
        self.descriptor = descriptor
        self.scale = scale
        self.attributes = tuple(attributes)
        self.weights = tuple(weight * scale / SCALES["interior"] for weight in weights)
        embedding = SpectralEmbedding(n_eigenpairs=50)

        def histogram(name: str) -> PairHistogram:
            axes = (Attribute(name, quantiles=8, soft=True), InteriorDistance(_N_BINS))
            return PairHistogram(axes, embedding, n_samples=_N_SAMPLES)

        self.inside = HistogramDescriptor([histogram(name) for name in attributes])
        self.name = descriptor.name
        for name, weight in zip(attributes, weights, strict=True):
            self.name += f"+{name}" if weight == 1 else f"+{name}={weight:g}"
        self.source = f"{descriptor.source}; Rustamov 2010, section 4"
        self.invariant_to = descriptor.invariant_to
        self.requirements = descriptor.requirements | self.inside.requirements

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, D + cells) descriptions: the descriptor's own, then the histograms."""
        inside = self.inside(batch).flatten(1) * len(self.weights)
        return torch.cat([self.descriptor(batch).flatten(1), inside], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) distances."""
        form, *histograms = self._split(queries)
        forms, *gallery_histograms = self._split(gallery)
        distances = self.descriptor.distances(form, forms)
        of_attributes = self.of_attributes().values()
        for one, own, others in zip(of_attributes, histograms, gallery_histograms, strict=True):
            distances = distances + one.distances(own, others)
        return distances

    def of_attributes(self) -> dict[str, HistogramDescriptor]:
        """Return by name what each attribute adds: its histogram, and the weighted distance by it."""
        rows = zip(self.attributes, self.inside.parts, self.weights, strict=True)
        return {name: _OfAttribute(histograms, weight) for name, histograms, weight in rows}

    def coordinates(self, descriptions: Tensor, *, within_class: bool = False) -> Tensor:
        """(N, ≤ D + cells) coordinates of the descriptor, then square roots of the weighted histograms."""
        form, *histograms = self._split(descriptions)
        blocks = [self.descriptor.coordinates(form, within_class=within_class)]
        for weight, cells in zip(self.weights, histograms, strict=True):
            blocks.append((weight * cells).sqrt())
        return torch.cat(blocks, dim=1)

    def _split(self, descriptions: Tensor) -> list[Tensor]:
        """Split descriptions (N, D + cells) into the descriptor's own, in its shape, and each attribute's histogram."""
        sizes = list(self.inside.part_cells)
        n_form = descriptions.shape[1] - sum(sizes)
        form, *histograms = torch.split(descriptions, [n_form, *sizes], dim=1)
        return [form.unflatten(1, self.descriptor.description_shape), *histograms]


class _OfAttribute(HistogramDescriptor):
    """The histogram of an attribute, compared at all widths of the distance bins."""

    def __init__(self, histograms: Any, weight: float) -> None:
        super().__init__([list(histograms)])
        self.weight = weight

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, cells) and (G, cells) to (Q, G) distances."""
        distances = [
            chi_square(_merged(queries, n_merged), _merged(gallery, n_merged))
            for n_merged in _N_MERGED_BINS
        ]
        return self.weight * torch.stack(distances).mean(dim=0)


def split_attributes(descriptor: Descriptor) -> tuple[Descriptor, dict[str, HistogramDescriptor]]:
    """Return a descriptor without attributes, and what each attribute adds, by name, before size counts."""
    if isinstance(descriptor, SizeAndSide):
        form, attributes = split_attributes(descriptor.descriptor)
        return descriptor.wrap(form), attributes
    if isinstance(descriptor, WithAttributes):
        return descriptor.descriptor, descriptor.of_attributes()
    return descriptor, {}


def _merged(cells: Tensor, n_merged: int) -> Tensor:
    """Sum each run of `n_merged` neighbouring distance bins."""
    return cells.unflatten(1, (-1, n_merged)).sum(dim=2)

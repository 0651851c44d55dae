"""Any descriptor, and beside it what bodies are like inside: attributes of their own, by interior distance."""

from collections.abc import Sequence

import torch
from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.descriptors.individual import SCALES, scale_of
from igps.nn.axes import Attribute, InteriorDistance
from igps.nn.descriptor import Descriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square

_N_SAMPLES = 2000
# Bins of distance, and how many of them are taken together for the levels of the comparison: fine textures need narrow
# bins, conformations of a molecule change distances, and of some bodies it is the mixture alone that counts.
_N_BINS, _LEVELS = 32, (1, 4, 32)


class WithAttributes(Descriptor):
    """A descriptor and joint histograms of attributes and interior distances: `NAME+ATTRIBUTE`, or `NAME+ATTRIBUTE=w`.

    With d the distance of the descriptor and s its scale between bodies of one class, that of the bodies is
    d + w·s/t·c: c the χ² distance of the attribute's histograms, in the mean over 32, 8 and 1 bins of distance, and t
    the scale of `interior`, which is of that kind. So a weight of 1 lets form and attributes count alike. Classes of an
    attribute are eight quantiles of the collection.

    Args:
        descriptor: any whose scale is known.
        attributes: names of scalars.
        weights: of each attribute.

    Raises:
        ValueError: the descriptor's scale is not known, or a weight is not positive.
    """

    def __init__(self, descriptor: Descriptor, attributes: Sequence[str], weights: Sequence[float]) -> None:
        super().__init__()
        scale = scale_of(descriptor)
        if scale is None or not all(0 < weight < float("inf") for weight in weights):
            raise ValueError(
                f"with: expected positive weights and a descriptor whose distances are known, got {weights} and "
                f"{descriptor.name!r}. Set its attribute `scale` to the median of its distances within a class."
            )
        self.descriptor, self.scale = descriptor, scale
        self.weights = tuple(weight * scale / SCALES["interior"] for weight in weights)
        embedding = SpectralEmbedding(n_eigenpairs=50)

        def histogram(name: str) -> PairHistogram:
            axes = (Attribute(name, quantiles=8, soft=True), InteriorDistance(_N_BINS))
            return PairHistogram(axes, embedding, n_samples=_N_SAMPLES)

        self.inside = HistogramDescriptor([histogram(name) for name in attributes])
        marks = (f"+{name}" + f"={weight:g}" * (weight != 1) for name, weight in zip(attributes, weights, strict=True))
        self.name, self.source = descriptor.name + "".join(marks), f"{descriptor.source}; Rustamov 2010, section 4"
        self.invariant_to = descriptor.invariant_to
        self.requirements = descriptor.requirements | self.inside.requirements

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, D + cells)."""
        inside = self.inside(batch).flatten(1) * len(self.weights)
        return torch.cat([self.descriptor(batch).flatten(1), inside], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G)."""
        (form, *own), (forms, *others) = self._split(queries), self._split(gallery)
        found = self.descriptor.distances(form, forms)
        for weight, one, other in zip(self.weights, own, others, strict=True):
            for n_together in _LEVELS:
                levels = (cells.unflatten(1, (-1, n_together)).sum(dim=2) for cells in (one, other))
                found = found + weight / len(_LEVELS) * chi_square(*levels)
        return found

    def coordinates(self, descriptions: Tensor, *, of_one_kind: bool = False) -> Tensor:
        """(N, ≤ D + cells) the coordinates of the descriptor, and roots of the histograms times their weights."""
        form, *own = self._split(descriptions)
        roots = [(weight * cells).sqrt() for weight, cells in zip(self.weights, own, strict=True)]
        return torch.cat([self.descriptor.coordinates(form, of_one_kind=of_one_kind), *roots], dim=1)

    def _split(self, descriptions: Tensor) -> list[Tensor]:
        """The descriptor's part of (N, D + cells) descriptions, in its shape, and the histograms of each attribute."""
        sizes = list(self.inside.part_cells)
        form, *own = torch.split(descriptions, [descriptions.shape[1] - sum(sizes), *sizes], dim=1)
        return [form.unflatten(1, self.descriptor.description_shape), *own]

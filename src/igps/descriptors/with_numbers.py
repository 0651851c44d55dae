"""Histograms and plain numbers of bodies, for heads that use both."""

import torch
from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.descriptors.measures import COLUMNS, Measures
from igps.nn.descriptor import Descriptor
from igps.retrieval import euclidean

N_NUMBERS = len(COLUMNS) - 1
"""The number of plain numbers that do not depend on size."""


class Numbers(Descriptor):
    """Plain numbers without size, by `Measures`, followed by size, the logarithm of ∛volume."""

    name = "numbers"
    invariant_to = ("motion",)
    requirements = Measures.requirements

    def __init__(self) -> None:
        super().__init__()
        self.measures = Measures()
        self.sized = Measures(size=True)
        self.source = self.measures.source

    @property
    def n_features(self) -> int:
        """12 + 1."""
        return N_NUMBERS + 1

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, 12 + 1) numbers; a ValueError if the bodies have no measures."""
        size = self.sized(batch)[:, -1:]  # the last column is the volume
        return torch.cat([self.measures(batch), size], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)


class WithNumbers(Descriptor):
    """A descriptor of histograms, followed by `Numbers`.

    Args:
        descriptor: of histograms, flattened to (N, cells).
    """

    def __init__(self, descriptor: Descriptor) -> None:
        super().__init__()
        self.descriptor = descriptor
        self.numbers = Numbers()
        self.name = f"{descriptor.name}_numbers"
        self.source = f"{descriptor.source}; {self.numbers.source}"
        self.invariant_to = tuple(x for x in descriptor.invariant_to if x == "motion")
        self.requirements = descriptor.requirements | self.numbers.requirements

    @property
    def n_features(self) -> int:
        """The number of cells, of numbers, and 1 for size."""
        return self.descriptor.n_features + self.numbers.n_features

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, cells + 12 + 1) descriptions."""
        form = self.descriptor(batch).flatten(1)
        return torch.cat([form, self.numbers(batch)], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances; a head has a better one."""
        return euclidean(queries, gallery)

"""The Global Point Signature of the surface: the paper's histograms without the volume (Rustamov 2007)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from igps.baselines.interior import paper_histograms
from igps.baselines.system import Body
from igps.retrieval.distances import chi_square


@dataclass(frozen=True)
class GPS:
    """Histograms of the commute-time embedding's distances between surface samples, by pairs of potential classes.

    Source: Rustamov 2007, with the 4 classes, 64 bins and χ² of the comparison in Rustamov 2010.
    """

    name: ClassVar[str] = "gps"
    source: ClassVar[str] = "Rustamov 2007"
    invariant_to: ClassVar[tuple[str, ...]] = ("motion", "scale", "pose")

    def describe(self, body: Body) -> NDArray[np.float32]:
        """(10, 64) histograms of the surface samples; all cells sum to 1."""
        return paper_histograms(body.signature, "surface")

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) χ² distances."""
        return chi_square(queries, gallery)

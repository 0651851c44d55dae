"""The paper's own descriptor: joint histograms of interior distance and potential (Rustamov 2010)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps.baselines.system import Body
from igps.data.dataset import collate
from igps.geometry.signature import Signature
from igps.nn.descriptor import SampleKind, VolumetricDescriptor
from igps.retrieval.distances import chi_square


@dataclass(frozen=True)
class Interior:
    """Histograms of the commute-time embedding's distances between interior samples, by pairs of potential classes.

    Source: Rustamov 2010, sections 3 and 4: 4 classes, 64 bins, χ².
    """

    name: ClassVar[str] = "interior"
    source: ClassVar[str] = "Rustamov 2010"
    invariant_to: ClassVar[tuple[str, ...]] = ("motion", "scale", "pose")

    def describe(self, body: Body) -> NDArray[np.float32]:
        """(10, 64) histograms of the interior samples; all cells sum to 1."""
        return paper_histograms(body.signature, "interior")

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) χ² distances."""
        return chi_square(queries, gallery)


def paper_histograms(signature: Signature, samples: SampleKind) -> NDArray[np.float32]:
    """(10, 64) histograms of `VolumetricDescriptor.paper`, without unit; all cells sum to 1."""
    with torch.inference_mode():
        return VolumetricDescriptor.paper(samples)(collate([signature]))[0].numpy()

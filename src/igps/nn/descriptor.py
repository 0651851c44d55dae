"""The descriptor of the paper: a spectral embedding and the histograms of its distances."""

from __future__ import annotations

from typing import Literal

from torch import Tensor, nn

from igps.data.dataset import SignatureBatch
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential
from igps.nn.histogram import PairHistogram

SampleKind = Literal["interior", "surface"]


class VolumetricDescriptor(nn.Module):
    """Signatures to histograms: embedding, potential, and joint histograms over all pairs of samples.

    Args:
        embedding: eigenfunctions (..., P, K), eigenvalues (..., K) and areas (...) to coordinates (..., P, D).
        histogram: (N, P, D) coordinates, (N, P) potential and (N, P) mask to (N, cells..., B); it is also given the
            samples' attributes, each (N, P), and points, (N, P, 3) in units of √area.
        samples: "interior" is the volumetric descriptor; "surface" its counterpart on the surface, the histograms of
            the Global Point Signature (Rustamov 2007).
    """

    def __init__(
        self,
        embedding: nn.Module | None = None,
        histogram: nn.Module | None = None,
        samples: SampleKind = "interior",
    ) -> None:
        super().__init__()
        if samples not in ("interior", "surface"):
            raise ValueError(f"samples: expected 'interior' or 'surface', got {samples!r}.")
        self.embedding = embedding or SpectralEmbedding()
        self.histogram = histogram or PairHistogram()
        self.samples: SampleKind = samples

    @classmethod
    def paper(cls, samples: SampleKind = "interior") -> VolumetricDescriptor:
        """Rustamov 2010: commute time, 4 potential classes, 64 distance bins; nothing to learn."""
        return cls(SpectralEmbedding(), PairHistogram(n_classes=4, n_bins=64), samples)

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, C(C+1)/2, B) histograms, with Euclidean bins (N, C(C+1)/2, B, E), each shape's of sum 1."""
        samples = batch.interior if self.samples == "interior" else batch.surface
        coordinates = self.embedding(samples.eigenfunctions, batch.eigenvalues, batch.area)
        length = batch.area.sqrt().to(samples.points.dtype)[:, None, None]
        return self.histogram(
            coordinates,
            barycentroid_potential(coordinates),
            samples.mask,
            attributes=samples.attributes,
            points=samples.points / length,
        )

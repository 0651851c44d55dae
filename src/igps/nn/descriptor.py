"""Descriptors: a spectral embedding and the histograms of its distances; one layout, or several side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from igps.data.dataset import SignatureBatch
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential
from igps.nn.fitted import WhitenedHead
from igps.nn.histogram import PairHistogram

SampleKind = Literal["interior", "surface"]

PRETRAINED = Path(__file__).with_name("pretrained.safetensors")
"""The parameters of `VolumetricDescriptor.pretrained`, written by training/pretrain.py."""

# Class centres of further scalars; those of the depth have their boundaries at 0.015, 0.03 and 0.06 of √area.
_DEPTH = (0.0075, 0.0225, 0.0375, 0.0825)
_ELECTROSTATIC_POTENTIAL = (2.4, 2.8, 3.2, 3.6)


class VolumetricDescriptor(nn.Module):
    """Signatures to histograms: embedding, potential, and joint histograms over all pairs of samples.

    Args:
        embedding: eigenfunctions (..., P, K), eigenvalues (..., K) and areas (...) to coordinates (..., P, D).
        histogram: (N, P, D) coordinates, (N, P) potential and (N, P) mask to (N, cells..., B); it is also given the
            samples' attributes, each (N, P), and points, (N, P, 3) in units of √area.
        samples: "interior" is the volumetric descriptor; "surface" its counterpart on the surface, the histograms of
            the Global Point Signature (Rustamov 2007).
        n_samples: of a shape with more samples, a subset of so many that is always the same; None uses all.
        n_training_samples: in training mode, a random subset of so many samples, another one each time: it is faster,
            and a head cannot learn the samples by heart. None uses the same as in evaluation.
    """

    def __init__(
        self,
        embedding: nn.Module | None = None,
        histogram: nn.Module | None = None,
        samples: SampleKind = "interior",
        *,
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__()
        if samples not in ("interior", "surface"):
            raise ValueError(f"samples: expected 'interior' or 'surface', got {samples!r}.")
        for name, value in (("n_samples", n_samples), ("n_training_samples", n_training_samples)):
            if value is not None and value < 2:
                raise ValueError(f"{name}: expected None or at least 2, to form a pair, got {value}.")
        self.embedding = embedding or SpectralEmbedding()
        self.histogram = histogram or PairHistogram()
        self.samples: SampleKind = samples
        self.n_samples = n_samples
        self.n_training_samples = n_training_samples

    @classmethod
    def paper(cls, samples: SampleKind = "interior") -> VolumetricDescriptor:
        """Rustamov 2010: commute time, 4 potential classes, 64 distance bins; nothing to learn."""
        return cls(SpectralEmbedding(), PairHistogram(n_classes=4, n_bins=64), samples)

    @classmethod
    def pretrained(cls) -> EmbeddedDescriptor:
        """`CombinedDescriptor.rich` under a `WhitenedHead` that was fitted to generated articulated shapes.

        It needs no label of the shapes that it compares. Distances are `cosine` distances. The model card is in the
        README; training/pretrain.py makes the file.
        """
        stored = {name: tensor.float() for name, tensor in load_file(PRETRAINED).items()}
        n_directions, n_cells = stored["directions"].shape
        head = WhitenedHead(n_cells, n_directions)
        head.load_state_dict(stored)
        return EmbeddedDescriptor(CombinedDescriptor.rich(), head).eval()

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, C(C+1)/2, B) histograms, with Euclidean bins (N, C(C+1)/2, B, E), each shape's of sum 1."""
        samples = batch.interior if self.samples == "interior" else batch.surface
        if self.training and self.n_training_samples is not None:
            samples = samples.subset(self.n_training_samples)
        elif self.n_samples is not None:
            samples = samples.subset(self.n_samples, seed=0)
        coordinates = self.embedding(samples.eigenfunctions, batch.eigenvalues, batch.area)
        length = batch.area.sqrt().to(samples.points.dtype)[:, None, None]
        return self.histogram(
            coordinates,
            barycentroid_potential(coordinates),
            samples.mask,
            attributes=samples.attributes,
            points=samples.points / length,
        )


class CombinedDescriptor(nn.Module):
    """Several descriptors side by side as one histogram, in which each has the same share.

    The χ² distance of combined histograms is the mean of the χ² distances of the parts.

    Args:
        parts: each `SignatureBatch` to (N, cells...) of sum 1.
    """

    def __init__(self, parts: Sequence[nn.Module]) -> None:
        super().__init__()
        if not parts:
            raise ValueError("parts: expected at least one descriptor, got none.")
        self.parts = nn.ModuleList(parts)

    @classmethod
    def multiscale(cls) -> CombinedDescriptor:
        """Interior distances alone, of the first 250, 50 and 16 eigenpairs: fine, middle and coarse."""
        return cls(
            [
                _layout(250, PairHistogram(8, 64)),
                _layout(50, PairHistogram(8, 64)),
                _layout(16, PairHistogram(8, 64, distance_range=3.0)),
            ]
        )

    @classmethod
    def rich(cls) -> CombinedDescriptor:
        """Interior distances joined with Euclidean distances, depth and electrostatic potential of the samples.

        It needs signatures with `SignatureConfig(attributes=("depth", "electrostatic_potential"))`; 50 eigenpairs do.
        """
        return cls(
            [
                _layout(50, PairHistogram(8, 64)),
                _layout(16, PairHistogram(8, 64, distance_range=3.0)),
                _layout(50, PairHistogram(4, 32, n_euclidean_bins=16)),
                _layout(50, PairHistogram(3, 12, attributes={"depth": _DEPTH}, n_euclidean_bins=8)),
                _layout(50, PairHistogram(4, 32, attributes={"depth": _DEPTH})),
                _layout(50, PairHistogram(4, 32, attributes={"electrostatic_potential": _ELECTROSTATIC_POTENTIAL})),
            ]
        )

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, cells) histograms, each shape's of sum 1."""
        return torch.cat([part(batch).flatten(1) for part in self.parts], dim=1) / len(self.parts)


class EmbeddedDescriptor(nn.Module):
    """A descriptor and the head that embeds its histograms.

    Args:
        descriptor: `SignatureBatch` to histograms (N, ...).
        head: histograms to (N, D) of length 1.
    """

    def __init__(self, descriptor: nn.Module, head: nn.Module) -> None:
        super().__init__()
        self.descriptor = descriptor
        self.head = head

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, D) embeddings of length 1."""
        return self.head(self.descriptor(batch))


def _layout(n_eigenpairs: int, histogram: PairHistogram) -> VolumetricDescriptor:
    # Of the bodies with the most samples 1,500 tell the histograms well enough, and the time grows with their square.
    return VolumetricDescriptor(SpectralEmbedding(n_eigenpairs=n_eigenpairs), histogram, n_samples=1500)

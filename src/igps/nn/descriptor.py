"""Descriptors: a spectral embedding and the histograms of its distances; one layout, or several side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from igps.data.dataset import SampleBatch, SignatureBatch
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential
from igps.nn.fitted import WhitenedHead
from igps.nn.histogram import PairHistogram
from igps.nn.oriented import OrientedPairHistogram, nearest_directions

SampleKind = Literal["interior", "surface"]
Space = Literal["position", "embedding"]
Distance = Literal["interior", "euclidean"]

PRETRAINED = Path(__file__).with_name("pretrained.safetensors")
"""The parameters of `VolumetricDescriptor.pretrained`, written by training/pretrain.py."""

# Class centres of further scalars; those of the depth have their boundaries at 0.015, 0.03 and 0.06 of √area.
_DEPTH = (0.0075, 0.0225, 0.0375, 0.0825)
_ELECTROSTATIC_POTENTIAL = (2.4, 2.8, 3.2, 3.6)

# Of the bodies with the most samples so many tell the histograms well enough, and the time grows with their square.
_N_SAMPLES = 1500
_N_ORIENTED_SAMPLES = 1000
# Of the spectral filters of learnable layouts.
_N_KNOTS = 12


class _SampledDescriptor(nn.Module):
    """What descriptors of a shape's samples share: which samples they take."""

    def __init__(self, samples: SampleKind, n_samples: int | None, n_training_samples: int | None) -> None:
        super().__init__()
        if samples not in ("interior", "surface"):
            raise ValueError(f"samples: expected 'interior' or 'surface', got {samples!r}.")
        for name, value in (("n_samples", n_samples), ("n_training_samples", n_training_samples)):
            if value is not None and value < 2:
                raise ValueError(f"{name}: expected None or at least 2, to form a pair, got {value}.")
        self.samples: SampleKind = samples
        self.n_samples = n_samples
        self.n_training_samples = n_training_samples

    @property
    def part_cells(self) -> tuple[int, ...]:
        """Cells of a histogram, over all its dimensions; of one part, as there are several in `CombinedDescriptor`."""
        return (int(self.histogram.n_cells),)  # type: ignore[arg-type, union-attr]

    def _embedded(self, samples: SampleBatch, batch: SignatureBatch) -> Tensor:
        return self.embedding(samples.eigenfunctions, batch.eigenvalues, batch.area)  # type: ignore[operator]

    def _chosen(self, batch: SignatureBatch) -> SampleBatch:
        samples = batch.interior if self.samples == "interior" else batch.surface
        if self.training and self.n_training_samples is not None:
            return samples.subset(self.n_training_samples)
        return samples if self.n_samples is None else samples.subset(self.n_samples, seed=0)


class VolumetricDescriptor(_SampledDescriptor):
    """Signatures to histograms: embedding, potential, and joint histograms over all pairs of samples.

    Args:
        embedding: eigenfunctions (..., P, K), eigenvalues (..., K) and areas (...) to coordinates (..., P, D).
        histogram: (N, P, D) coordinates, (N, P) potential and (N, P) mask to (N, cells..., B); it is also given the
            samples' attributes, each (N, P) or (N, P, 3), and points, (N, P, 3) in units of √area.
        samples: "interior" is the volumetric descriptor; "surface" its counterpart on the surface, the histograms of
            the Global Point Signature (Rustamov 2007).
        second_embedding: its coordinates take the place of the points, and so its distances that of the Euclidean
            ones: a joint histogram of interior distances on two scales.
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
        second_embedding: nn.Module | None = None,
        n_samples: int | None = None,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        self.embedding = embedding or SpectralEmbedding()
        self.second_embedding = second_embedding
        self.histogram = histogram or PairHistogram()

    @classmethod
    def paper(cls, samples: SampleKind = "interior") -> VolumetricDescriptor:
        """Rustamov 2010: commute time, 4 potential classes, 64 distance bins; nothing to learn."""
        return cls(SpectralEmbedding(), PairHistogram(n_classes=4, n_bins=64), samples)

    @classmethod
    def pretrained(cls) -> EmbeddedDescriptor:
        """`CombinedDescriptor.rich` under a `WhitenedHead`, both trained on generated articulated shapes.

        It needs no label of the shapes that it compares. Distances are `cosine` distances. The model card is in the
        README; training/pretrain.py makes the file.
        """
        return load_embedded(PRETRAINED)

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, C(C+1)/2, B) histograms, with Euclidean bins (N, C(C+1)/2, B, E), each shape's of sum 1."""
        samples = self._chosen(batch)
        coordinates = self._embedded(samples, batch)
        points = (
            _in_units(samples, batch)
            if self.second_embedding is None
            else self.second_embedding(samples.eigenfunctions, batch.eigenvalues, batch.area)
        )
        return self.histogram(
            coordinates,
            barycentroid_potential(coordinates),
            samples.mask,
            attributes=samples.attributes,
            points=points,
        )


class OrientedDescriptor(_SampledDescriptor):
    """Signatures to histograms of distance and `point_pair_features`: how samples and the surface lie together.

    The direction of a sample is that to the surface next to it. It sees corners, hollows and symmetry, which distances
    alone tell little of.

    Args:
        embedding: see `VolumetricDescriptor`; none with distance="euclidean", which has no use for it.
        histogram: coordinates, points, directions and mask of N shapes to (N, cells...).
        samples: "interior" or "surface".
        space: "position" takes lines and directions in space, and needs the attribute "surface_direction"; "embedding"
            takes them between the embedded samples, the direction of an interior sample being to the embedded surface
            samples nearest to it, that of a surface sample away from the interior ones: it consists of interior
            distances alone and hardly changes with pose.
        distance: which is counted, "interior" or "euclidean", the latter over √area. On the surface the euclidean one
            makes histograms after Wahl et al. 2003.
        n_samples, n_training_samples: see `VolumetricDescriptor`.
    """

    def __init__(
        self,
        embedding: nn.Module | None = None,
        histogram: nn.Module | None = None,
        samples: SampleKind = "interior",
        *,
        space: Space = "position",
        distance: Distance = "interior",
        n_samples: int | None = _N_ORIENTED_SAMPLES,
        n_training_samples: int | None = None,
    ) -> None:
        super().__init__(samples, n_samples, n_training_samples)
        if space not in ("position", "embedding"):
            raise ValueError(f"space: expected 'position' or 'embedding', got {space!r}.")
        if distance not in ("interior", "euclidean"):
            raise ValueError(f"distance: expected 'interior' or 'euclidean', got {distance!r}.")
        if space == "embedding" and distance == "euclidean":
            raise ValueError("distance: expected 'interior' with space='embedding', got 'euclidean'.")
        if embedding is not None and distance == "euclidean":
            raise ValueError("embedding: expected None with distance='euclidean', which has no use for it.")
        self.embedding = None if distance == "euclidean" else embedding or SpectralEmbedding()
        self.histogram = histogram or OrientedPairHistogram(distance_range=1.0 if distance == "euclidean" else 3.0)
        self.space: Space = space

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, B, A, A, A) histograms, each shape's of sum 1.

        Raises:
            ValueError: the samples have no "surface_direction".
        """
        samples = self._chosen(batch)
        points = _in_units(samples, batch)
        coordinates = points if self.embedding is None else self._embedded(samples, batch)
        if self.space == "position":
            if "surface_direction" not in samples.attributes:
                raise ValueError(
                    f"attributes: expected 'surface_direction' among those of the {self.samples} samples, got "
                    f"{sorted(samples.attributes)}. Name it in SignatureConfig(attributes=...)."
                )
            return self.histogram(coordinates, points, samples.attributes["surface_direction"], samples.mask)
        other, outward = (batch.surface, 1) if self.samples == "interior" else (batch.interior, -1)
        targets = self._embedded(other, batch)
        directions = torch.stack(
            [outward * nearest_directions(coordinates[i], targets[i, real]) for i, real in enumerate(other.mask)]
        )
        return self.histogram(coordinates, coordinates, directions, samples.mask)


class CombinedDescriptor(nn.Module):
    """Several descriptors side by side as one histogram, in which each has the same share.

    The χ² distance of combined histograms is the mean of the χ² distances of the parts. A part may be combined itself.

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
        """Interior distances alone, in four parts.

        The histograms of the first 250, 50 and 16 eigenpairs (fine, middle and coarse); the joint histogram of the
        distances of 50 and of 4; how the interior samples lie to the surface in the embedding of 16, and how the
        surface samples lie to the interior ones in that of 8.
        """
        return cls(
            [
                cls(
                    [
                        _layout(250, PairHistogram(8, 64)),
                        _layout(50, PairHistogram(8, 64)),
                        _layout(16, PairHistogram(8, 64, distance_range=3.0)),
                    ]
                ),
                VolumetricDescriptor(
                    SpectralEmbedding(n_eigenpairs=50),
                    PairHistogram(1, 24, distance_range=3.0, n_euclidean_bins=24, euclidean_range=2.5),
                    second_embedding=SpectralEmbedding(n_eigenpairs=4),
                    n_samples=_N_SAMPLES,
                ),
                OrientedDescriptor(SpectralEmbedding(n_eigenpairs=16), space="embedding"),
                OrientedDescriptor(SpectralEmbedding(n_eigenpairs=8), samples="surface", space="embedding"),
            ]
        )

    @classmethod
    def rich(
        cls, *, learnable: bool = False, n_samples: int | None = None, n_training_samples: int | None = None
    ) -> CombinedDescriptor:
        """Interior distances joined with all else there is, in three parts.

        The histograms with Euclidean distances, depth and electrostatic potential of the samples; how interior samples
        lie to each other and to the surface, by interior distance; and the same of surface samples, by Euclidean
        distance. It needs signatures with
        `SignatureConfig(attributes=("depth", "electrostatic_potential", "surface_direction"))`; 50 eigenpairs do.

        Args:
            learnable: whether the centres of bins and classes and the spectral filters are parameters; the classes are
                soft ones then.
            n_samples: of each part; by default as many as its histograms need.
            n_training_samples: of each part, see `VolumetricDescriptor`.
        """
        layouts = (
            (50, PairHistogram(8, 64, learnable=learnable)),
            (16, PairHistogram(8, 64, distance_range=3.0, learnable=learnable)),
            (50, PairHistogram(4, 32, n_euclidean_bins=16, learnable=learnable)),
            (50, PairHistogram(3, 12, attributes={"depth": _DEPTH}, n_euclidean_bins=8, learnable=learnable)),
            (50, PairHistogram(4, 32, attributes={"depth": _DEPTH}, learnable=learnable)),
            (
                50,
                PairHistogram(
                    4, 32, attributes={"electrostatic_potential": _ELECTROSTATIC_POTENTIAL}, learnable=learnable
                ),
            ),
        )
        n_knots = _N_KNOTS if learnable else 0
        return cls(
            [
                cls(
                    [
                        _layout(n, histogram, n_knots, n_samples or _N_SAMPLES, n_training_samples)
                        for n, histogram in layouts
                    ]
                ),
                OrientedDescriptor(
                    SpectralEmbedding(n_eigenpairs=50, n_knots=n_knots),
                    OrientedPairHistogram(learnable=learnable),
                    n_samples=n_samples or _N_ORIENTED_SAMPLES,
                    n_training_samples=n_training_samples,
                ),
                OrientedDescriptor(
                    histogram=OrientedPairHistogram(distance_range=1.0, learnable=learnable),
                    samples="surface",
                    distance="euclidean",
                    n_samples=n_samples or _N_ORIENTED_SAMPLES,
                    n_training_samples=n_training_samples,
                ),
            ]
        )

    @property
    def part_cells(self) -> tuple[int, ...]:
        """Cells of each part."""
        return tuple(sum(part.part_cells) for part in self.parts)  # type: ignore[arg-type]

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


def save_embedded(module: EmbeddedDescriptor, path: Path) -> None:
    """Write a `CombinedDescriptor.rich` under a `WhitenedHead` to a safetensors file, the head in half precision."""
    state = {
        name: (tensor.half() if name.startswith("head.") else tensor).contiguous()
        for name, tensor in module.state_dict().items()
    }
    save_file(state, path)


def load_embedded(path: Path) -> EmbeddedDescriptor:
    """What `save_embedded` wrote, in evaluation mode."""
    stored = {name: tensor.float() for name, tensor in load_file(path).items()}
    # Fixed layouts have no parameters, their filters none to store.
    descriptor = CombinedDescriptor.rich(learnable=any(name.endswith("log_gain") for name in stored))
    head = WhitenedHead(descriptor.part_cells, len(stored["head.directions"]))
    module = EmbeddedDescriptor(descriptor, head)
    module.load_state_dict(stored)
    return module.eval()


def _in_units(samples: SampleBatch, batch: SignatureBatch) -> Tensor:
    """(N, P, 3) points in units of √area."""
    return samples.points / batch.area.sqrt().to(samples.points.dtype)[:, None, None]


def _layout(
    n_eigenpairs: int,
    histogram: PairHistogram,
    n_knots: int = 0,
    n_samples: int = _N_SAMPLES,
    n_training_samples: int | None = None,
) -> VolumetricDescriptor:
    return VolumetricDescriptor(
        SpectralEmbedding(n_eigenpairs=n_eigenpairs, n_knots=n_knots),
        histogram,
        n_samples=n_samples,
        n_training_samples=n_training_samples,
    )

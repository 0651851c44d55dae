"""What a descriptor is: how bodies are described, what that needs, and how two descriptions are compared."""

import contextlib
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import accumulate
from operator import or_
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from igps._arrays import Singles
from igps._threads import one_thread
from igps.data.batch import Body, SignatureBatch
from igps.data.collation import collate
from igps.data.requirements import Requirements
from igps.mesh.mesh import Mesh
from igps.nn._kernels import blocks
from igps.nn.batch_features import BatchFeatures
from igps.nn.heads.base import Head
from igps.nn.histograms.base import DescriptionPart
from igps.nn.specification import Specified, save_module
from igps.retrieval import chi_square
from igps.retrieval.vectors import MOST_NUMBERS, SearchDistance
from igps.signature.signature import SignatureConfig, compute_signature

NAME = re.compile(r"\w{1,100}(\+\w{1,40}(=[\d.e-]{1,10})?){0,9}")
"""What the name of a descriptor in a file is: files are called after it."""


class Descriptor(Specified, ABC):
    """A descriptor: a module from a `SignatureBatch` to descriptions (N, ...), with the distance that compares them.

    A descriptor of your own defines `describe`, its `name`, and where the defaults do not fit its `requirements` and
    `distances`. All commands take it as `--descriptor package.module:NAME`, all functions as an object.

    Example:
        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> from igps.retrieval.distances import euclidean
        >>> class Spectrum(Descriptor):  # eigenvalues times the area (Reuter et al. 2006)
        ...     name = "spectrum"
        ...     invariant_to = ("motion", "scale", "pose")
        ...
        ...     def describe(self, batch):
        ...         return (batch.eigenvalues[:, :10] * batch.area[:, None]).float()
        ...
        ...     def distances(self, queries, gallery):
        ...         return euclidean(queries, gallery)
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=20))
        >>> (Spectrum()(collate([signature])) / (4 * torch.pi)).round().int().tolist()  # n (n + 1), 2n + 1 times
        [[2, 2, 2, 6, 6, 6, 6, 6, 12, 12]]

    Attributes:
        name: by which it is asked for and listed.
        source: author, year.
        invariant_to: which of "motion" (rotation, translation, reflection), "scale" and "pose" (isometric bending)
            leave its descriptions as they are, but for discretisation.
        requirements: of a body; all eigenpairs, unless redefined.
        searched_by: the distance by which an index finds candidates, "cosine" for unit vectors or "chi_square" for
            histograms; what is near by `distances` must be among the few hundred that are nearest by it. None where
            neither is: an index compares with all.
        card: facts about a fitted descriptor, by name.
        scale: the median of its distances between bodies of one class, by which size and side are weighed against it,
            see `IndividualDescriptor`; None if it is not known.
        description_shape: of the entries of a description in the eyes of `distances`, (-1,) where it is a row.
    """

    name: str = "descriptor"
    source: str = ""
    invariant_to: tuple[str, ...] = ()
    requirements: Requirements = Requirements(whole_spectrum=True)
    searched_by: SearchDistance | None = None
    card: Mapping[str, Any] = MappingProxyType({})
    scale: float | None = None
    description_shape: tuple[int, ...] = (-1,)

    @property
    def n_features(self) -> int:
        """The size of a description; found by describing a ball where a descriptor does not define it."""
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=3)
        mesh = Mesh(ball.vertices, ball.faces)
        config = self.requirements.apply_to(SignatureConfig(n_surface_samples=100, resolution=10, min_samples=0))
        with torch.no_grad():
            return self(collate([compute_signature(mesh, config)], [mesh]))[0].numel()

    def save(self, path: str | Path, card: Mapping[str, Any] | None = None) -> None:
        """Write it to a safetensors file, or a folder to share, which `igps.load` and every `--descriptor` takes.

        Args:
            path: such as ``mine.safetensors``; a file that is there is replaced. A name without this ending is that of
                a folder, which gets ``model.safetensors`` and its card, ``README.md``, as hubs of models expect them.
            card: what a reader should know of it, for JSON; its own if None.

        Raises:
            ValueError: it is made of other modules than the library's, or its name is not of letters, digits and _.
        """
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: expected letters, digits and _, got {self.name!r}. Make it with another.")
        save_module(self, path, dict(self.card if card is None else card))

    @abstractmethod
    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, ...) descriptions of N shapes that have what is needed; finite numbers."""

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, ...) descriptions of N shapes; a ValueError if the batch lacks what the descriptor needs."""
        self.requirements.check(batch)
        # On other devices nothing is gained, and what is traced runs later.
        with one_thread() if blocks.in_loops(batch.device) else contextlib.nullcontext():
            return self.describe(batch)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, ...) and (G, ...) descriptions to (Q, G) distances ≥ 0, smaller is closer; χ² unless redefined."""
        return chi_square(queries, gallery)

    def coordinates(self, descriptions: Tensor, *, of_one_kind: bool = False) -> Tensor:
        """(N, ...) descriptions to (N, D) for statistics, which compare by Euclidean distance.

        Square roots of histograms (Hellinger), and others as they are, unless redefined.

        Args:
            descriptions: of bodies.
            of_one_kind: whether all bodies are of one kind, such as an organ; what tells kinds apart may be left out.
        """
        rows = descriptions.flatten(1)
        return rows.sqrt() if self.searched_by == "chi_square" else rows

    def short(self, descriptions: Tensor) -> Tensor:
        """(N, D) descriptions to (N, ≤ 256), for engines that compare so few by the cosine; or a ValueError."""
        raise ValueError(f"short: expected a descriptor of vectors, such as pretrained, got {self.name!r}.")


class BodyDescriptor(Descriptor):
    """A descriptor that looks at one body at a time, in NumPy; it has no gradient.

    Those of the library are made with parameters; one out of range is a ValueError.

    Example:
        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> class Roundness(BodyDescriptor):
        ...     name = "roundness"
        ...
        ...     def describe_body(self, body):
        ...         return np.array([36 * np.pi * body.volume**2 / body.area**3])
        ...
        ...     def distances(self, queries, gallery):
        ...         return (queries - gallery.T).abs()
        >>> cube = trimesh.creation.box().subdivide().subdivide().subdivide()
        >>> signature = compute_signature(cube, SignatureConfig(n_eigenpairs=20))
        >>> round(float(Roundness()(collate([signature]))), 4)  # π / 6; of a ball 1
        0.5236
    """

    @abstractmethod
    def describe_body(self, body: Body) -> Singles:
        """The description of one body; raises a ValueError for a body that it cannot describe."""

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, ...) descriptions, on the device of the batch."""
        descriptions = [np.asarray(self.describe_body(body), dtype=np.float32) for body in batch.bodies()]
        return torch.from_numpy(np.stack(descriptions)).to(batch.device)


class HistogramDescriptor(Descriptor):
    """Histograms of samples or of their pairs, one or several side by side, compared by χ².

    Several are flattened and joined into one histogram of sum 1, in which each part has the same share, and in a part
    each of its histograms. The χ² distance is then the mean of those of the parts. Embeddings that are the same module,
    and samples that are the same subset, are computed once for all.

    Example:
        >>> from igps.nn.histograms.pairs import PairHistogram
        >>> two = HistogramDescriptor([PairHistogram(), PairHistogram(["interior_distance"])], name="two")
        >>> two.part_cells, two.distances(torch.eye(3)[:1], torch.eye(3)).tolist()
        ((640, 64), [[0.0, 1.0, 1.0]])

    Args:
        histograms: one `DescriptionPart`, such as a `PairHistogram`; or the parts, each one or several of them.
        name, source, invariant_to: see `Descriptor`.

    Raises:
        ValueError: no histogram.
    """

    searched_by: SearchDistance | None = "chi_square"

    def __init__(
        self,
        histograms: DescriptionPart | Sequence[DescriptionPart | Sequence[DescriptionPart]],
        *,
        name: str = "histogram",
        source: str = "",
        invariant_to: Sequence[str] = (),
    ) -> None:
        super().__init__()
        parts = [histograms] if isinstance(histograms, DescriptionPart) else list(histograms)
        groups = [[part] if isinstance(part, DescriptionPart) else list(part) for part in parts]
        if not groups or not all(groups):
            raise ValueError("histograms: expected at least one in each part, got none.")
        self.histograms = nn.ModuleList(histogram for group in groups for histogram in group)
        # Histograms in each part; None where a single one is given, which keeps its shape in descriptions
        self._sizes = None if isinstance(histograms, DescriptionPart) else tuple(len(group) for group in groups)
        self.name, self.source, self.invariant_to = name, source, tuple(invariant_to)
        self.requirements = reduce(or_, (histogram.requirements for group in groups for histogram in group))

    @property
    def parts(self) -> tuple[tuple[DescriptionPart, ...], ...]:
        """The histograms of each part."""
        histograms = [one for one in self.histograms if isinstance(one, DescriptionPart)]
        sizes = self._sizes or (1,)
        # By slices: PyTorch 2.6 traces an iterator, taken some at a time, as if it began anew each time
        return tuple(tuple(histograms[end - size : end]) for size, end in zip(sizes, accumulate(sizes), strict=True))

    @property
    def part_cells(self) -> tuple[int, ...]:
        """Cells of each part."""
        return tuple(sum(histogram.n_cells for histogram in part) for part in self.parts)

    @property
    def n_features(self) -> int:
        """Cells of all parts."""
        return sum(self.part_cells)

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, C(C+1)/2, B, ...) histograms of a single one, (N, cells) of several; each body's of sum 1."""
        features = BatchFeatures(batch, self.training)
        if self._sizes is None:
            return self.parts[0][0](features)
        shares = [(1 / (len(self.parts) * len(part)), histogram) for part in self.parts for histogram in part]
        return torch.cat([share * histogram(features).flatten(1) for share, histogram in shares], dim=1)


class EmbeddedDescriptor(Descriptor):
    """A descriptor under a head fitted to its descriptions, compared by the head's distance.

    Args:
        descriptor: `SignatureBatch` to descriptions.
        head: of these descriptions.
        name, source: see `Descriptor`.
        invariant_to: see `Descriptor`; that of `descriptor` if None, though a head may have learned more.
    """

    searched_by: SearchDistance | None = "cosine"

    def __init__(
        self,
        descriptor: Descriptor,
        head: Head,
        *,
        name: str = "embedded",
        source: str = "",
        invariant_to: Sequence[str] | None = None,
    ) -> None:
        super().__init__()
        self.descriptor, self.head = descriptor, head
        self.name, self.source = name, source
        self.invariant_to = descriptor.invariant_to if invariant_to is None else tuple(invariant_to)
        self.requirements = descriptor.requirements

    @property
    def n_features(self) -> int:
        """D of the embeddings."""
        device = next(self.head.buffers()).device
        with torch.no_grad():
            return self.head(torch.ones(2, self.descriptor.n_features, device=device)).shape[1]

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, D) embeddings of length 1."""
        return self.head(self.descriptor(batch))

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) embeddings to (Q, G) distances of the head."""
        return self.head.distances(queries, gallery)

    def coordinates(self, embeddings: Tensor, *, of_one_kind: bool = False) -> Tensor:
        """(N, D) embeddings as they are, or what tells bodies of one kind apart, see `Head.within_class`."""
        return self.head.within_class(embeddings) if of_one_kind else embeddings

    def short(self, embeddings: Tensor) -> Tensor:
        """(N, D) embeddings to (N, ≤ 256) of length 1: themselves, or those of `Head.short`, which may have none."""
        return embeddings if embeddings.shape[1] <= MOST_NUMBERS else self.head.short(embeddings)

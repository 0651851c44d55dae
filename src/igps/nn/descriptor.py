"""Base classes of descriptors: description of bodies, requirements, and distances between descriptions."""

import contextlib
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
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
from igps.nn._kernels import batches
from igps.nn._kernels.batches import on_one_thread
from igps.nn.batch_features import BatchFeatures
from igps.nn.heads.base import Head
from igps.nn.histograms.base import DescriptionPart
from igps.nn.specification import Specified, save_module
from igps.retrieval import chi_square
from igps.retrieval.vectors import MAX_SHORT_WIDTH, SearchDistance
from igps.signature.signature import SAMPLE_KINDS, SignatureConfig, compute_signature

NAME = re.compile(r"\w{1,100}(\+\w{1,40}(=[\d.e-]{1,10})?){0,9}")
"""Pattern for the names of descriptors that can be saved, as file names are derived from these names."""

# Weight, in a search for candidates, of the numbers of an embedding that distinguish bodies of one class. Among
# 1,000,000 varied descriptions by `pretrained`, 640 candidates hold 99.9 % of the nearest ten, 320 hold 99.8 %. With a
# weight of 16 and 100,000 rows, 64 hold 95.5 % in place of 98.5 %; without one, 640 of 200,000 hold about 85 %.
_WITHIN_CLASS_WEIGHT = 25.0


class Descriptor(Specified, ABC):
    """A descriptor: a module from a `SignatureBatch` to descriptions (N, ...), with a distance between descriptions.

    To write a descriptor of your own, define `describe` and `name`, and override `requirements` and `distances` if the
    defaults do not fit. All commands take it as `--descriptor package.module:NAME`, all functions as an object.

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
        name: the name by which the descriptor is selected and listed.
        source: author, year.
        invariant_to: which of "motion" (rotation, translation, reflection), "scale" and "pose" (isometric bending)
            leave descriptions unchanged, apart from discretisation.
        requirements: data that a body must have; by default, all eigenpairs.
        search_distance: the distance by which an index finds candidates, "cosine" for unit vectors or "chi_square" for
            histograms. The nearest bodies by `distances` must be among the few hundred nearest bodies by this distance.
            If None, an index compares a query with all bodies.
        card: facts about a fitted descriptor, by name.
        scale: median distance between bodies of one class, from which `SizeAndSide` derives the weights
            of size and side; None if unknown.
        description_shape: shape of one description, as `distances` takes it; (-1,) if it is a vector.
    """

    name: str = "descriptor"
    source: str = ""
    invariant_to: tuple[str, ...] = ()
    requirements: Requirements = Requirements(whole_spectrum=True)
    search_distance: SearchDistance | None = None
    card: Mapping[str, Any] = MappingProxyType({})
    scale: float | None = None
    description_shape: tuple[int, ...] = (-1,)

    @property
    def n_features(self) -> int:
        """The number of entries of a description; by default, determined by describing a ball."""
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=3)
        mesh = Mesh(ball.vertices, ball.faces)
        config = self.requirements.apply_to(
            SignatureConfig(n_surface_samples=100, resolution=10, min_samples=0)
        )
        batch = collate([compute_signature(mesh, config)], [mesh])
        with torch.no_grad():
            return self(batch)[0].numel()

    def save(self, path: str | Path, card: Mapping[str, Any] | None = None) -> None:
        """Save the descriptor as a safetensors file or a folder, for `igps.load` and all `--descriptor` options.

        Args:
            path: such as ``mine.safetensors``; an existing file is overwritten. A path without this suffix is a folder,
                which gets the files ``model.safetensors`` and ``README.md`` (the card) that model hubs expect.
            card: facts about the descriptor that JSON can represent; its own `card` if None.

        Raises:
            ValueError: the descriptor contains modules of other packages, or its name is not of letters, digits and _.
        """
        if not NAME.fullmatch(self.name):
            raise ValueError(
                f"name: expected letters, digits and _, got {self.name!r}. Choose another name."
            )
        save_module(self, path, dict(self.card if card is None else card))

    @abstractmethod
    def describe(self, batch: SignatureBatch) -> Tensor:
        """Return finite descriptions (N, ...) of N shapes that meet the requirements."""

    def forward(self, batch: SignatureBatch) -> Tensor:
        """Return descriptions (N, ...) of N shapes.

        Raises:
            TypeError: something else than a batch.
            ValueError: the batch does not meet the requirements, or a parameter is not finite.
        """
        if not isinstance(batch, SignatureBatch):
            raise TypeError(
                f"batch: expected a SignatureBatch, got {type(batch).__name__}. Give dataset.batch([0, 1]), or "
                "igps.collate([item]) for an item or a Signature; igps.describe describes a whole dataset."
            )
        if batches.uses_loops(batch.device):
            _check_finite(self)
        self.requirements.check(batch)
        # On other devices, a limit on threads has no advantage; traced code runs later, without the limit.
        has_limit = batches.uses_loops(batch.device)
        with one_thread() if has_limit else contextlib.nullcontext():
            return self.describe(batch)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return distances (Q, G) ≥ 0 between descriptions (Q, ...) and (G, ...); by default, χ² distances."""
        return chi_square(queries, gallery)

    def search_weights(self, width: int) -> list[float] | None:
        """Return the weights of the `width` numbers of a description in `search_distance`; None if they are equal."""
        return None

    def coordinates(self, descriptions: Tensor, *, within_class: bool = False) -> Tensor:
        """Map descriptions (N, ...) to vectors (N, D) for statistics by Euclidean distance.

        By default, histograms are mapped to their square roots (Hellinger distance), other descriptions to themselves.
        If all bodies are of one class, such as an organ (`within_class`), entries that distinguish classes may be left
        out.
        """
        rows = descriptions.flatten(1)
        return rows.sqrt() if self.search_distance == "chi_square" else rows

    def column_names(self, width: int) -> list[str]:
        """Return names for the `width` numbers of a description in a table, after their parts if it has several."""
        return [f"v{i}" for i in range(width)]

    def fit_collection(
        self, measures: Sequence[Mapping[str, float]], units: Sequence[str | None]
    ) -> bool:
        """Adapt to the plain numbers of N bodies of a collection and their units; return whether anything changed."""
        return False

    def shorten(self, descriptions: Tensor) -> Tensor:
        """Map descriptions (N, D) to (N, ≤ 256) for engines with cosine distances; by default, a ValueError."""
        raise ValueError(
            f"shorten: expected a descriptor of vectors, such as pretrained, got {self.name!r}."
        )


def _check_finite(module: nn.Module) -> None:
    """Raise a ValueError that names a parameter with NaN or infinity, for which the samples would be blamed."""
    for name, parameter in module.named_parameters():
        if not bool(parameter.detach().isfinite().all()):
            raise ValueError(
                f"{name}: expected a finite parameter, got NaN or infinity. Lower the learning rate, or clip gradients."
            )


class BodyDescriptor(Descriptor):
    """A descriptor that describes one body at a time, in NumPy, without gradients.

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
        """Return the description of one body; raise a ValueError if it cannot be described."""

    def describe(self, batch: SignatureBatch) -> Tensor:
        """Return descriptions (N, ...) on the device of the batch."""
        descriptions = np.stack([self.describe_body(body) for body in batch.bodies()])
        return torch.from_numpy(descriptions.astype(np.float32)).to(batch.device)


class HistogramDescriptor(Descriptor):
    """One or several histograms of samples or of their pairs, compared by χ².

    Several histograms are flattened and concatenated to one histogram of sum 1. Within a part all histograms have equal
    shares; the χ² distance is the mean of the distances of the parts, weighted by their shares. Histograms that use the
    same embedding module, or the same subset of samples, share the computation.

    Example:
        >>> from igps.nn.histograms.pairs import PairHistogram
        >>> two = HistogramDescriptor([PairHistogram(), PairHistogram(["interior_distance"])], name="two")
        >>> two.part_cells, two.distances(torch.eye(3)[:1], torch.eye(3)).tolist()
        ((640, 64), [[0.0, 1.0, 1.0]])

    Args:
        histograms: a `DescriptionPart`, such as a `PairHistogram`; or a list of parts, each of one or several of them.
        name, source, invariant_to: see `Descriptor`.
        shares: the share of each part, which are divided by their sum; equal shares if None.

    Raises:
        ValueError: no histogram, or not one positive share for each part.
    """

    search_distance: SearchDistance | None = "chi_square"

    def __init__(
        self,
        histograms: DescriptionPart | Sequence[DescriptionPart | Sequence[DescriptionPart]],
        *,
        name: str = "histogram",
        source: str = "",
        invariant_to: Sequence[str] = (),
        shares: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        parts = [histograms] if isinstance(histograms, DescriptionPart) else list(histograms)
        groups = [[part] if isinstance(part, DescriptionPart) else list(part) for part in parts]
        if not groups or not all(groups):
            raise ValueError("histograms: expected at least one in each part, got none.")
        self.shares = [1.0] * len(groups) if shares is None else list(shares)
        is_positive = all(0 < share < math.inf for share in self.shares)
        if len(self.shares) != len(groups) or not is_positive:
            raise ValueError(
                f"shares: expected a positive number for each of {len(groups)} parts, got {self.shares}."
            )
        flat = [histogram for group in groups for histogram in group]
        self.histograms = nn.ModuleList(flat)
        # Histograms in each part; None for a single histogram, whose descriptions keep its shape.
        self._sizes = None
        if not isinstance(histograms, DescriptionPart):
            self._sizes = tuple(len(group) for group in groups)
        self.name = name
        self.source = source
        self.invariant_to = tuple(invariant_to)
        n_read = zip(SAMPLE_KINDS, self._n_read(training=False), strict=True)
        samples = tuple(kind for kind, n in n_read if n > 0)
        requirements = reduce(or_, (histogram.requirements for histogram in flat))
        self.requirements = replace(requirements, samples=samples)

    def _n_read(self, training: bool) -> tuple[float, float]:
        """Return the largest numbers of interior and surface samples of a body that are read."""
        read = [histogram.n_read(training) for part in self.parts for histogram in part]
        return max(n for n, _ in read), max(n for _, n in read)

    @property
    def parts(self) -> tuple[tuple[DescriptionPart, ...], ...]:
        """The histograms of each part."""
        histograms = [x for x in self.histograms if isinstance(x, DescriptionPart)]
        parts = []
        first = 0
        for size in self._sizes or (1,):
            parts.append(tuple(histograms[first : first + size]))
            first += size
        return tuple(parts)

    @property
    def histogram_shares(self) -> list[tuple[float, DescriptionPart]]:
        """Each histogram with its share of a description; the shares sum to 1."""
        total = sum(self.shares)
        return [
            (share / total / len(part), histogram)
            for share, part in zip(self.shares, self.parts, strict=True)
            for histogram in part
        ]

    @property
    def part_cells(self) -> tuple[int, ...]:
        """The number of cells of each part."""
        return tuple(sum(histogram.n_cells for histogram in part) for part in self.parts)

    @property
    def n_features(self) -> int:
        """The number of cells of all parts."""
        return sum(self.part_cells)

    def column_names(self, width: int) -> list[str]:
        """Return `v0` and so on, of several parts `part1.v0`."""
        if len(self.parts) == 1:
            return super().column_names(width)
        cells = enumerate(self.part_cells, 1)
        return [f"part{part}.v{i}" for part, n_cells in cells for i in range(n_cells)]

    def describe(self, batch: SignatureBatch) -> Tensor:
        """Return descriptions of sum 1: of a single histogram in its shape (N, ...), of several as (N, cells)."""
        if self._sizes is None:
            return self.parts[0][0](batch)
        shares = self.histogram_shares

        def concatenated(group: SignatureBatch) -> Tensor:
            features = BatchFeatures(group, self.training)
            cells = [share * histogram(features).flatten(1) for share, histogram in shares]
            return torch.cat(cells, dim=1)

        n_read = self._n_read(self.training)

        def described(bodies: SignatureBatch) -> Tensor:
            return batches.map_by_size(concatenated, bodies, n_read)

        return on_one_thread(described, batch, self)


class EmbeddedDescriptor(Descriptor):
    """A descriptor followed by a head; embeddings are compared by the head's distance.

    Args:
        descriptor: maps a `SignatureBatch` to descriptions.
        head: fitted to these descriptions.
        name, source: see `Descriptor`.
        invariant_to: see `Descriptor`; if None, as of `descriptor`, although the head may have learned more.
    """

    search_distance: SearchDistance | None = "cosine"

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
        self.descriptor = descriptor
        self.head = head
        self.name = name
        self.source = source
        self.invariant_to = descriptor.invariant_to if invariant_to is None else tuple(invariant_to)
        self.requirements = descriptor.requirements

    @property
    def n_features(self) -> int:
        """The embedding width D."""
        device = next(self.head.buffers()).device
        descriptions = torch.ones(2, self.descriptor.n_features, device=device)
        with torch.no_grad():
            return self.head(descriptions).shape[1]

    def describe(self, batch: SignatureBatch) -> Tensor:
        """Return embeddings (N, D) of length 1."""
        return self.head(self.descriptor(batch))

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return the head's distances (Q, G) between embeddings (Q, D) and (G, D)."""
        return self.head.distances(queries, gallery)

    def search_weights(self, width: int) -> list[float] | None:
        """Return a weight for each number of an embedding, more for those that distinguish bodies of one class.

        Among many bodies of one class, the nearest by the head's distance are those that these numbers show to be near.
        """
        columns = torch.arange(width)[None]
        within_class = self.head.within_class(columns)[0]
        if len(within_class) == width:
            return None
        weights = torch.ones(width)
        weights[within_class] = 0.0  # such as lengths, which would outweigh all directions
        weights[self.head.compared_within_class(columns)[0]] = _WITHIN_CLASS_WEIGHT
        return weights.tolist()

    def column_names(self, width: int) -> list[str]:
        """Return `class.0` and so on for the numbers that distinguish classes, `body.0` for those within a class."""
        columns = torch.arange(width)[None]
        n_of_bodies = self.head.within_class(columns).shape[1]
        if n_of_bodies == width:
            return super().column_names(width)
        n_of_classes = width - n_of_bodies
        classes = [f"class.{i}" for i in range(n_of_classes)]
        return classes + [f"body.{i}" for i in range(n_of_bodies)]

    def coordinates(self, embeddings: Tensor, *, within_class: bool = False) -> Tensor:
        """Return embeddings (N, D), for bodies of one class reduced by `Head.within_class`."""
        return self.head.within_class(embeddings) if within_class else embeddings

    def shorten(self, embeddings: Tensor) -> Tensor:
        """Return embeddings (N, D) with D ≤ 256 unchanged, others shortened by `Head.shorten`."""
        if embeddings.shape[1] <= MAX_SHORT_WIDTH:
            return embeddings
        return self.head.shorten(embeddings)

"""Torch Dataset of cached Signatures."""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from igps.data.added_attributes import (
    AttributeSource,
    PointFunction,
    split_attributes,
    with_attribute,
)
from igps.data.batch import LabelledSignature, SignatureBatch
from igps.data.cache import default_cache_dir
from igps.data.cache_hit import CacheHit
from igps.data.collation import collate
from igps.data.filling import Failure, fill, find_cached
from igps.data.in_memory import bodies_in_memory
from igps.data.indices import Indices, resolve_indices, scalar_index
from igps.data.pipeline import PreTransform, SignaturePipeline
from igps.data.requirements import AnyDescriptor, requirements_of
from igps.data.sources import Bodies, ClassRule, bodies_of
from igps.failures import Failed, Limits
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Signature, SignatureConfig


class SignatureDataset(Dataset[LabelledSignature]):
    """Dataset of Signatures, which are computed on first access and cached on disk.

    Example:
        >>> import tempfile, trimesh
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = ball.export(f"{folder}/ball.off")
        ...     dataset = SignatureDataset(folder, SignatureConfig(n_eigenpairs=20), f"{folder}/cache")
        ...     item = dataset["ball.off"]
        >>> len(dataset), item.id, item.signature.eigenvalues.shape
        (1, 'ball.off', (20,))

    Args:
        root_or_paths: a folder (see `find_bodies`), files, or `Bodies`; or a mapping of names to objects in memory,
            each of which `as_mesh` accepts. Images and pairs `(labels, spacing)` of an array give a body per label.
        config: parameters of the Signatures. The default is 250 eigenpairs, unless the descriptor sets a number.
        cache_dir: directory of the cache; the user's cache directory if None. A cache key is the hash of the content
            of the file, the load options, all parameters, and the version of the algorithm.
        descriptor: a descriptor, such as `igps.descriptor(NAME)`; the Signatures meet its requirements, and batches
            take only the samples that it reads.
        labels: class names of the given paths.
        classes: rule for the class of a body, see `ClassRule`; "folder" if None.
        reading: options for reading files.
        attributes: additional attributes of the samples by name. Each is an `AttributeSource`, or a function
            `(body, points)`, from (P, 3) in coordinates of the file to (P,) or (P, C). Values of a source are cached.
            Values of a function are cached if it has an attribute `cache_tag`, a text that you change whenever the
            function gives other values; otherwise it is called at each access.
        pre_transform: transform of every Signature before it is cached; its `cache_tag` is part of the cache key.
        transform: transform of a Signature at each access; see `igps.data.transforms`.

    Attributes:
        bodies: files, names, classes, and further columns of `labels.csv`.
        pipeline: computes Signatures with `config` and `reading`.
        classes: class names in the order of their indices.

    Raises:
        FileNotFoundError: the folder does not exist, or has no bodies.
        ValueError: the configuration does not meet the requirements of the descriptor.
    """

    def __init__(  # noqa: PLR0913 (a folder, and settings that all have a default)
        self,
        root_or_paths: str | Path | Sequence[str | Path] | Bodies | Mapping[str, Any],
        config: SignatureConfig | None = None,
        cache_dir: str | Path | None = None,
        *,
        descriptor: AnyDescriptor | None = None,
        labels: Sequence[str] | None = None,
        classes: ClassRule | None = None,
        reading: LoadOptions | None = None,
        attributes: Mapping[str, AttributeSource | PointFunction] | None = None,
        pre_transform: PreTransform | None = None,
        transform: Callable[[Signature], Signature] | None = None,
    ) -> None:
        config = config or SignatureConfig()
        reading = reading or LoadOptions()
        attributes = attributes or {}
        self._sample_kinds: tuple[SampleKind, ...] = SAMPLE_KINDS
        if descriptor is not None:
            requirements = requirements_of(descriptor)
            config = requirements.apply_to(config)
            attributes = {**requirements.sources, **attributes}
            self._sample_kinds = requirements.samples
        sources, self._functions = split_attributes(attributes)
        meshes: Mapping[BodyRef, Mesh | MeshError] = {}
        if isinstance(root_or_paths, Mapping):
            root_or_paths, meshes = bodies_in_memory(root_or_paths, labels, reading)
            labels = None  # of objects; those of bodies are known
        directory = Path(cache_dir or default_cache_dir())
        bodies = bodies_of(root_or_paths, labels, reading, sources.values(), directory)
        self.bodies = bodies.with_classes(classes or "folder")
        self.classes: tuple[str, ...] = tuple(sorted(set(self.bodies.labels or ())))
        if pre_transform is not None and self._functions:
            raise ValueError(
                "pre_transform: expected attributes with a cache_tag, got a function without one. "
                'Give it one, such as height.cache_tag = "height 1".'
            )
        self.config = config.resolved()
        self.reading = reading
        self.pipeline = SignaturePipeline(
            self.config, reading, directory, sources, pre_transform, meshes
        )
        self.transform = transform
        self._hits: tuple[CacheHit | None, ...] = (None,) * len(self.bodies)  # known cache entries
        self._loaded: list[Signature] | None = None  # used instead of the cache

    @property
    def labels(self) -> Tensor:
        """(N,) int64 index of the class of each body in `classes`, −1 if unknown."""
        labels = [-1] * len(self)
        if self.bodies.labels is not None:
            index = self.class_to_idx
            labels = [index[name] for name in self.bodies.labels]
        return torch.tensor(labels, dtype=torch.int64, device="cpu")

    @property
    def targets(self) -> list[int]:
        """The `labels` as a list, by the name that torchvision's datasets use."""
        targets: list[int] = self.labels.tolist()
        return targets

    @property
    def class_to_idx(self) -> dict[str, int]:
        """The index of each class by its name."""
        return {name: i for i, name in enumerate(self.classes)}

    def __repr__(self) -> str:
        shown = ", ".join(self.classes[:5])
        more = ", …" if len(self.classes) > 5 else ""
        classes = f", {len(self.classes)} classes: {shown}{more}" if self.classes else ""
        return f"SignatureDataset({len(self)} bodies{classes}; {self.config.n_kept} eigenpairs)"

    @property
    def sizes(self) -> Tensor:
        """(N,) int64 number of interior samples of each body, for `BucketBatchSampler`; reads all Signatures."""
        sizes = [len(signature.interior) for signature in self.signatures()]
        return torch.tensor(sizes, dtype=torch.int64, device="cpu")

    def __len__(self) -> int:
        return len(self.bodies)

    def __iter__(self) -> Iterator[LabelledSignature]:
        return map(self._item, range(len(self)))

    @overload
    def __getitem__(self, index: int | str) -> LabelledSignature: ...  # type: ignore[overload-overlap]
    @overload
    def __getitem__(self, index: Indices) -> Self: ...
    def __getitem__(self, index: int | str | Indices) -> LabelledSignature | Self:
        """Return an item for an integer or a name, or a dataset for a slice, integers, names, or a mask."""
        if isinstance(index, str):
            index = self.bodies.number(index)
        index = scalar_index(index)
        if isinstance(index, int | np.integer):
            return self._item(range(len(self))[index])
        if not isinstance(index, slice | Tensor):
            index = [self.bodies.number(x) if isinstance(x, str) else x for x in index]
        return self.subset(resolve_indices(index, len(self)))

    def _item(self, i: int) -> LabelledSignature:
        label = -1
        if self.bodies.labels is not None:
            label = self.classes.index(self.bodies.labels[i])
        signature = self._signature(i)
        if self.transform is not None:
            signature = self.transform(signature)
        return LabelledSignature(signature, label, self.bodies.names[i], self._sample_kinds)

    def _signature(self, i: int) -> Signature:
        """Return a Signature before `transform`."""
        name = self.bodies.names[i]
        if self._loaded is not None:
            return replace(self._loaded[i], name=name)
        body = self.bodies[i]
        hit = self._hits[i]
        cached = None if hit is None else self.pipeline.read(hit)
        signature = replace(cached or self.pipeline.signature(body), name=name)
        for attribute, function in self._functions.items():
            values: dict[SampleKind, Any] = {
                "interior": function(body, signature.interior.points),
                "surface": function(body, signature.surface.points),
            }
            signature = with_attribute(signature, attribute, values)
        return signature

    def signatures(self) -> Iterator[Signature]:
        """Iterate over the Signatures before `transform`, which are computed if they are not cached."""
        return map(self._signature, range(len(self)))

    def mesh(self, index: int) -> Mesh:
        """Return a mesh, read and checked as for its Signature; raise a MeshError if it cannot be used."""
        return self.pipeline.mesh(self.bodies[index])

    def key(self, index: int) -> str:
        """Return the cache key of a Signature; raise a MeshError if its file cannot be read."""
        return self.pipeline.key(self.bodies[index])

    def cached_keys(self) -> list[str | None]:
        """Return the key of each cached Signature with its attributes; None if not cached, or changed at access."""
        if self._functions or self.transform is not None:
            return [None] * len(self)
        return [None if hit is None else hit.whole_key for hit in self._find_hits()]

    def all_notes(self) -> list[tuple[str, ...]]:
        """Return the notes on how each mesh was changed. After `precompute`, files are not read again."""
        return [() if header is None else header.notes for header in self._headers()]

    def units(self) -> list[str | None]:
        """Return the unit of length of each body; None if it is unknown, or there is no cached Signature."""
        return [None if header is None else header.unit for header in self._headers()]

    def measures(self) -> list[Mapping[str, float]]:
        """Return the plain numbers of each body by name, see `igps.measures`.

        A body has none without a cached Signature, or if neither the configuration nor the descriptor asks for them.
        """
        return [{} if header is None else header.measures for header in self._headers()]

    def measured(self, n_workers: int | None = None) -> Self:
        """Return the dataset with plain numbers in its Signatures, computed by `n_workers` where they are missing."""
        if self.config.measures or self._loaded is not None:
            return self
        dataset = copy.copy(self)
        dataset.config = replace(self.config, measures=True)
        dataset.pipeline = replace(self.pipeline, config=dataset.config)
        dataset._hits = (None,) * len(self)
        dataset.precompute(n_workers=n_workers, progress=False)
        return dataset

    def _headers(self) -> Sequence[Signature | CacheHit | None]:
        """Return what holds the notes, the unit and the measures of each body; None if that is not known."""
        return self._find_hits() if self._loaded is None else self._loaded

    def batch(self, indices: Sequence[int], meshes: bool = False) -> SignatureBatch:
        """Return a batch of some of the items, optionally with their meshes."""
        items = [self[i] for i in indices]
        their_meshes = [self.mesh(i) for i in indices] if meshes else None
        return collate(items, their_meshes)

    def subset(self, indices: Sequence[int]) -> Self:
        """Return a dataset of some of the bodies, with the same `classes`, so that labels are unchanged."""
        chosen = copy.copy(self)
        chosen.bodies = self.bodies.subset(indices)
        chosen._hits = tuple(self._hits[i] for i in indices)
        if self._loaded is not None:  # copies for workers should hold no other Signatures
            chosen._loaded = [self._loaded[i] for i in indices]
        return chosen

    def usable(self, failures: Sequence[Failure]) -> Self:
        """Return a dataset without the bodies that failed."""
        failed = {failure.id for failure in failures}
        usable = [i for i, name in enumerate(self.bodies.names) if name not in failed]
        return self.subset(usable)

    def to_memory(self, change: Callable[[Signature], Signature] | None = None) -> Self:
        """Return a dataset with all Signatures, before `transform`, in memory.

        Signatures that are not cached are computed. If given, `change` is applied to each; `FewerSamples` saves memory.
        """
        dataset = copy.copy(self)
        dataset._loaded = []
        for signature in self.signatures():
            kept = signature if change is None else change(signature)
            dataset._loaded.append(copy.deepcopy(kept))
        if change is not None:  # the cache entries no longer belong to the Signatures
            dataset._hits = (None,) * len(self)
        return dataset

    def precompute(
        self,
        executor: Executor | None = None,
        *,
        n_workers: int | None = None,
        strict: bool = False,
        progress: bool = True,
        limits: Limits | None = None,
    ) -> list[Failure]:
        """Compute the Signatures that are not cached, and return the bodies that cannot be used.

        Afterwards, this dataset and its subsets do not read the files. Call it again if files have changed.

        Args:
            executor: any `concurrent.futures.Executor`, such as that of a cluster, whose workers must see the files and
                the cache under the same paths; own processes if None.
            n_workers: number of own processes; the number of cores if None.
            strict: raise an error for the first body that cannot be used.
            progress: show a progress bar.
            limits: limits of time and memory for each body; a body that exceeds them fails.

        Raises:
            MeshError: a body cannot be used, if `strict`.
            MachineError: the machine is at fault, for example its disk is full. Finished Signatures are kept.
        """
        if self._loaded is not None:
            return []
        hits, failures = fill(
            self.pipeline, self.bodies, executor, n_workers, strict, progress, limits
        )
        self._hits = tuple(hits)
        return failures

    def _find_hits(self) -> list[CacheHit | None]:
        """Return the cache entry of each body, None if there is none."""
        if self._loaded is not None or None not in self._hits:
            return list(self._hits)
        found = find_cached(self.pipeline, self.bodies)
        current = [None if isinstance(hit, Failed) else hit for hit in found]
        return [known or hit for known, hit in zip(self._hits, current, strict=True)]

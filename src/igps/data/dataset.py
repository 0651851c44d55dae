"""A torch Dataset of Signatures, computed on first access and cached."""

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

from igps._parallel import Limits
from igps.data.attributes import AttributeSource, PointFunction, split_attributes, with_attribute
from igps.data.batch import LabelledSignature, SignatureBatch
from igps.data.cache import SignatureCache, default_cache_dir
from igps.data.collation import collate
from igps.data.collection import CollectionFile, Contents, write_collection
from igps.data.filling import Failure, fill, find_cached
from igps.data.in_memory import bodies_in_memory
from igps.data.indices import Indices, resolve_indices, scalar_index
from igps.data.pipeline import CacheHit, PreTransform, SignaturePipeline
from igps.data.requirements import AnyDescriptor, requirements_of
from igps.data.sources import Bodies, ClassRule, bodies_of
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SAMPLE_KINDS, Signature, SignatureConfig


class SignatureDataset(Dataset[LabelledSignature]):
    """Signatures of bodies in files, computed on first access and cached on disk.

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
        root_or_paths: a folder (see `find_bodies`), files, or `Bodies`; or objects in memory by name: what `Mesh.of`
            takes, of images all labels, and of arrays, given as pairs `(labels, spacing)`.
        config: parameters of the Signatures; 250 eigenpairs where neither it nor a descriptor names a number.
        cache_dir: where Signatures are kept, by the content of the file, how it is read, every parameter, and the
            algorithm's version; the user's cache directory if None. One with more eigenpairs or attributes serves too.
        descriptor: what the Signatures are for, by name or itself: they get what it requires.
        labels: classes of the given paths, by name.
        classes: what the class of a body is, see `ClassRule`; as the folder tells it if None.
        reading: how files are read.
        attributes: further attributes of the samples, by name: an `AttributeSource` or a function `(body, points)`,
            whose values are kept beside the Signatures, which stay; or a function of points, (P, 3) in the file's
            coordinates, to (P,) or (P, C), which is called at each reading.
        pre_transform: a change of every Signature, cached with it; its `cache_tag` is part of the key.
        transform: a change of a Signature at each access; see `igps.data.transforms`.

    Attributes:
        bodies: files, names, classes, and further columns of the table of labels.
        pipeline: how a body becomes a Signature, by `config` and `reading`.
        classes: all names of classes, in the order of their numbers.

    Raises:
        FileNotFoundError: no such folder, or no body in it.
        ValueError: the configuration has less than the descriptor requires.
    """

    def __init__(
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
        config, reading, given = config or SignatureConfig(), reading or LoadOptions(), dict(attributes or {})
        if descriptor is not None:
            requirements = requirements_of(descriptor)
            config, given = requirements.apply_to(config), {**requirements.sources, **given}
        sources, self._functions = split_attributes(given)
        meshes: Mapping[BodyRef, Mesh | MeshError] = {}
        if isinstance(root_or_paths, Mapping):
            (root_or_paths, meshes), labels = bodies_in_memory(root_or_paths, labels, reading, config), None
        self.bodies = bodies_of(root_or_paths, labels, reading, sources.values()).with_classes(classes or "folder")
        self.classes: tuple[str, ...] = tuple(sorted(set(self.bodies.labels or ())))
        if pre_transform is not None and self._functions:
            raise ValueError("pre_transform: expected attributes with a cache_tag beside it, got a function of points.")
        directory = Path(cache_dir or default_cache_dir())
        self.config, self.reading = config.resolved(), reading
        self.pipeline = SignaturePipeline(self.config, reading, directory, sources, pre_transform, meshes)
        self.transform = transform
        # The cache entries that `precompute` found; Signatures outside of the cache, and each body's number among them
        self._hits: tuple[CacheHit | None, ...] = (None,) * len(self.bodies)
        self._loaded: CollectionFile | list[Signature] | None = None
        self._numbers: tuple[int, ...] = tuple(range(len(self.bodies)))

    @property
    def labels(self) -> Tensor:
        """(N,) int64 index of each body's class in `classes`, −1 where unknown."""
        index = {name: i for i, name in enumerate(self.classes)}
        known = None if self.bodies.labels is None else [index[name] for name in self.bodies.labels]
        return torch.tensor(known or [-1] * len(self), dtype=torch.int64, device="cpu")

    @property
    def sizes(self) -> Tensor:
        """(N,) int64 interior samples of each body, for `BucketBatchSampler`. Each Signature is looked at for it."""
        return torch.tensor([len(one.interior) for one in self.signatures()], dtype=torch.int64, device="cpu")

    def __len__(self) -> int:
        return len(self.bodies)

    def __iter__(self) -> Iterator[LabelledSignature]:
        return map(self._item, range(len(self)))

    @overload
    def __getitem__(self, index: int | str) -> LabelledSignature: ...  # type: ignore[overload-overlap]
    @overload
    def __getitem__(self, index: Indices) -> Self: ...
    def __getitem__(self, index: int | str | Indices) -> LabelledSignature | Self:
        """An item by number or name; the dataset of some of the bodies by slice, numbers, names, or mask."""
        if isinstance(index, str):
            index = self.bodies.number(index)
        index = scalar_index(index)
        if isinstance(index, int | np.integer):
            return self._item(range(len(self))[index])
        if not isinstance(index, slice | Tensor):
            index = [self.bodies.number(one) if isinstance(one, str) else one for one in index]
        return self.subset(resolve_indices(index, len(self)))

    def _item(self, i: int) -> LabelledSignature:
        label = -1 if self.bodies.labels is None else self.classes.index(self.bodies.labels[i])
        signature = self._signature(i)
        changed = signature if self.transform is None else self.transform(signature)
        return LabelledSignature(changed, label, self.bodies.names[i])

    def _signature(self, i: int) -> Signature:
        """Without the transform."""
        name = self.bodies.names[i]
        if self._loaded is not None:
            return replace(self._loaded[self._numbers[i]], name=name)
        found = None if (hit := self._hits[i]) is None else self.pipeline.read(hit)
        signature = replace(found or self.pipeline.signature(self.bodies[i]), name=name)
        for attribute, function in self._functions.items():
            values = {kind: function(getattr(signature, kind).points) for kind in SAMPLE_KINDS}
            signature = with_attribute(signature, attribute, values)
        return signature

    def signatures(self) -> Iterator[Signature]:
        """All Signatures, as they are before `transform`; those not cached are computed."""
        return map(self._signature, range(len(self)))

    def mesh(self, index: int) -> Mesh:
        """The mesh itself, read and checked as for its Signature; a MeshError where it cannot be used."""
        if isinstance(self._loaded, CollectionFile):
            name, file = self.bodies.names[index], self._loaded.path
            raise MeshError(f"{name}: {file} holds signatures and no meshes. Make the dataset of the folder of meshes.")
        return self.pipeline.mesh(self.bodies[index])

    def key(self, index: int) -> str:
        """The name of a Signature in the cache, by all that it depends on; a MeshError if its file cannot be read."""
        hit = self._hits[index] if isinstance(self._loaded, CollectionFile) else None
        return self.pipeline.key(self.bodies[index]) if hit is None else hit.key

    def cached_keys(self) -> list[str | None]:
        """What in the cache serves each body, None where nothing does, or a change at each reading."""
        if self._functions or self.transform is not None:
            return [None] * len(self)
        return [None if hit is None else hit.whole_key for hit in self._found()]

    def notes(self, index: int) -> tuple[str, ...]:
        """What was done to a mesh on its way to its cached Signature, in words."""
        return self.subset([index]).all_notes()[0]

    def all_notes(self) -> list[tuple[str, ...]]:
        """The notes of all meshes; of files that are known from `precompute` without reading them again."""
        return [() if hit is None else hit.notes for hit in self._found()]

    def units(self) -> list[str | None]:
        """The unit of length of each body, as cached Signatures tell; None where its file tells none."""
        if self._loaded is not None:
            return [self._loaded[number].unit for number in self._numbers]
        cache = SignatureCache(self.pipeline.cache_dir)
        return [None if hit is None else cache.unit(hit.key) for hit in self._found()]

    def batch(self, indices: Sequence[int], meshes: bool = False) -> SignatureBatch:
        """Some of the items as a batch."""
        return collate([self[i] for i in indices], [self.mesh(i) for i in indices] if meshes else None)

    def subset(self, indices: Sequence[int]) -> Self:
        """The dataset of some of the bodies; `classes` keeps all names, so that labels keep their numbers."""
        chosen = copy.copy(self)
        chosen.bodies = self.bodies.subset(indices)
        chosen._hits = tuple(self._hits[i] for i in indices)
        chosen._numbers = tuple(self._numbers[i] for i in indices)
        if isinstance(self._loaded, list):  # no more goes to a worker than it needs
            chosen._loaded = [self._loaded[number] for number in chosen._numbers]
            chosen._numbers = tuple(range(len(chosen)))
        return chosen

    def usable(self, failures: Sequence[Failure]) -> Self:
        """The dataset without the bodies that failed."""
        failed = {failure.id for failure in failures}
        return self.subset([i for i, name in enumerate(self.bodies.names) if name not in failed])

    def to_memory(self, change: Callable[[Signature], Signature] | None = None) -> Self:
        """The same with all Signatures in memory, as they are before `transform`; those not cached are computed.

        Each is kept as `change` makes it, such as `FewerSamples`, of which more fit.
        """
        chosen = copy.copy(self)
        chosen._loaded = [copy.deepcopy(one if change is None else change(one)) for one in self.signatures()]
        if change is not None:  # no description of what is in the cache
            chosen._hits = (None,) * len(self)
        chosen._numbers = tuple(range(len(self)))
        return chosen

    def to_file(self, path: str | Path) -> None:
        """Write all Signatures, as they are before `transform`, to one file that `from_file` reads without the meshes.

        Names, classes and parameters go with them; paths do not. Those not cached are computed; a MeshError of a body
        that cannot be used, see `usable`.
        """
        whole = copy.copy(self)
        hits = [hit or self.pipeline.hit(body) for hit, body in zip(self._hits, self.bodies, strict=True)]
        whole._hits = tuple(hits)
        about = Contents(self.bodies, self.classes, tuple(hit.whole_key for hit in hits), self.reading, self.config)
        write_collection(Path(path), about, whole._signature)

    @classmethod
    def from_file(
        cls, path: str | Path, *, descriptor: AnyDescriptor | None = None, cache_dir: Path | None = None
    ) -> Self:
        """The Signatures of a file that `to_file` wrote; it is read by memory map, and runs no code.

        Descriptions are kept in `cache_dir`. For `descriptor` see `SignatureDataset`.

        Raises:
            FileNotFoundError: no such file.
            ValueError: it is no such file, or has less than the descriptor requires.
        """
        file = CollectionFile(path)
        about = file.about
        if descriptor is not None:
            file.check_serves(requirements_of(descriptor))
        dataset = cls.__new__(cls)
        SignatureDataset.__init__(dataset, about.bodies, about.config, cache_dir, reading=about.reading)
        dataset.classes, dataset._loaded = about.classes, file
        dataset._hits = tuple(CacheHit(key, 0, file.notes(i), (0, 0, 0)) for i, key in enumerate(about.keys))
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
        """Fill the cache, skipping what is there, and list the bodies that cannot be used.

        Afterwards this dataset, and those that are made from it, read Signatures from the cache without a look at the
        files: call it again if files have changed.

        Args:
            executor: any `concurrent.futures.Executor`, such as that of a cluster, whose workers must see the files and
                the cache by the same paths; `n_workers` processes of ours, or as many as cores, if None.
            strict: raise at the first bad body instead of listing it.
            limits: time and memory of one body; one that needs more is bad.

        Raises:
            MeshError: a bad body, if `strict`.
            MachineError: the disk is full, or the like; what is done is kept.
        """
        if self._loaded is not None:
            return []
        hits, failures = fill(self.pipeline, self.bodies, executor, n_workers, strict, progress, limits)
        self._hits = tuple(hits)
        return failures

    def _found(self) -> list[CacheHit | None]:
        """The cache entry of each body, None where there is none."""
        if self._loaded is not None or None not in self._hits:
            return list(self._hits)
        found = find_cached(self.pipeline, self.bodies)
        return [known or hit for known, hit in zip(self._hits, found, strict=True)]

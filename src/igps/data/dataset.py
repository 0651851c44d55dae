"""A torch Dataset of Signatures, computed on first touch and cached; batches of them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import Dataset
from tqdm import tqdm

from igps.data.cache import SignatureCache, default_cache_dir
from igps.data.sources import MeshFiles, find_meshes, mesh_files
from igps.geometry.mesh import Mesh, MeshError
from igps.geometry.reading import Component, MeshReading, load_mesh
from igps.geometry.signature import Samples, Signature, SignatureConfig, compute_signature

logger = logging.getLogger(__name__)

PointFunction = Callable[[NDArray[np.float64]], NDArray[np.floating]]

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, eq=False)
class LabelledSignature:
    """An item of a `SignatureDataset`: a Signature, the number of its class (−1 if unknown), and its name."""

    signature: Signature
    label: int
    id: str


@dataclass(frozen=True)
class Failure:
    """A mesh that could not be used, and why."""

    id: str
    path: Path
    error: str


@dataclass(frozen=True, eq=False)
class SampleBatch:
    """Samples of N shapes, padded to the longest.

    Args:
        points: (N, P, 3) float32, length, measured from the centre of each shape's own samples.
        eigenfunctions: (N, P, K) float32, 1/length; zero where padded.
        mask: (N, P) true where a sample is real.
        attributes: named scalars, each (N, P) float32, and directions, each (N, P, 3) float32.
    """

    points: Tensor
    eigenfunctions: Tensor
    mask: Tensor
    attributes: Mapping[str, Tensor]

    def to(self, device: torch.device | str) -> SampleBatch:
        """The same batch on another device."""
        attributes = {name: values.to(device) for name, values in self.attributes.items()}
        return SampleBatch(self.points.to(device), self.eigenfunctions.to(device), self.mask.to(device), attributes)

    def subset(self, n_samples: int, seed: int | None = None) -> SampleBatch:
        """A random subset of at most `n_samples` samples of each shape.

        Args:
            n_samples: how many; a shape with fewer keeps all of them.
            seed: makes the subset of a shape depend on its number of samples alone, not on its batch; torch's global
                generator draws if None.
        """
        n_kept = min(n_samples, self.mask.shape[1])
        index = torch.zeros(len(self.mask), n_kept, dtype=torch.long)
        kept = torch.zeros(len(self.mask), n_kept, dtype=torch.bool)
        for i, real in enumerate(self.mask.cpu()):
            present = real.nonzero().flatten()
            generator = None if seed is None else torch.Generator().manual_seed(seed)
            chosen = present[torch.randperm(len(present), generator=generator)[:n_samples]]
            index[i, : len(chosen)] = chosen
            kept[i, : len(chosen)] = True
        index, kept = index.to(self.mask.device), kept.to(self.mask.device)

        def take(values: Tensor) -> Tensor:
            over_rest = (..., *[None] * (values.ndim - 2))
            return values.gather(1, index[over_rest].expand(-1, -1, *values.shape[2:])) * kept[over_rest]

        attributes = {name: take(values) for name, values in self.attributes.items()}
        return SampleBatch(take(self.points), take(self.eigenfunctions), kept, attributes)


@dataclass(frozen=True, eq=False)
class SignatureBatch:
    """N Signatures, padded so that no descriptor changes by it.

    Args:
        eigenvalues: (N, K) float64, 1/length²; infinite where padded, so that every spectral weight is zero there.
        interior: interior samples.
        surface: surface samples.
        area: (N,) float64, length².
        volume: (N,) float64, length³.
        labels: (N,) int64, −1 where unknown.
        ids: N names.
    """

    eigenvalues: Tensor
    interior: SampleBatch
    surface: SampleBatch
    area: Tensor
    volume: Tensor
    labels: Tensor
    ids: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ids)

    def to(self, device: torch.device | str) -> SignatureBatch:
        """The same batch on another device."""
        return replace(
            self,
            eigenvalues=self.eigenvalues.to(device),
            interior=self.interior.to(device),
            surface=self.surface.to(device),
            area=self.area.to(device),
            volume=self.volume.to(device),
            labels=self.labels.to(device),
        )


def collate(items: Sequence[LabelledSignature | Signature]) -> SignatureBatch:
    """Pad Signatures to a batch: the `collate_fn` of a `DataLoader` over a `SignatureDataset`.

    Raises:
        ValueError: no items, or samples that carry different attributes.
    """
    if not items:
        raise ValueError("items: expected at least one signature, got none.")
    labelled = [
        item if isinstance(item, LabelledSignature) else LabelledSignature(item, -1, item.name) for item in items
    ]
    signatures = [item.signature for item in labelled]
    eigenvalues = [torch.from_numpy(np.asarray(s.eigenvalues, dtype=np.float64)) for s in signatures]
    return SignatureBatch(
        eigenvalues=pad_sequence(eigenvalues, batch_first=True, padding_value=float("inf")),
        interior=_pad_samples([s.interior for s in signatures]),
        surface=_pad_samples([s.surface for s in signatures]),
        area=torch.tensor([s.area for s in signatures], dtype=torch.float64),
        volume=torch.tensor([s.volume for s in signatures], dtype=torch.float64),
        labels=torch.tensor([item.label for item in labelled], dtype=torch.int64),
        ids=tuple(item.id for item in labelled),
    )


def _pad_samples(samples: Sequence[Samples]) -> SampleBatch:
    n_shapes, longest = len(samples), max(len(s) for s in samples)
    eigenfunctions = torch.zeros(n_shapes, longest, max(s.eigenfunctions.shape[1] for s in samples))
    points = torch.zeros(n_shapes, longest, 3)
    mask = torch.zeros(n_shapes, longest, dtype=torch.bool)
    names = set(samples[0].attributes)
    attributes = {
        name: torch.zeros(n_shapes, longest, *samples[0].attributes[name].shape[1:]) for name in sorted(names)
    }
    for i, s in enumerate(samples):
        if set(s.attributes) != names:
            raise ValueError(
                f"items: all must carry the same sample attributes, got {sorted(names)} and {sorted(s.attributes)}."
            )
        n_points, n_eigenpairs = s.eigenfunctions.shape
        eigenfunctions[i, :n_points, :n_eigenpairs] = torch.from_numpy(s.eigenfunctions)
        # Centred before the cast, or a shape far from the origin would lose its digits.
        points[i, :n_points] = torch.from_numpy(s.points - s.points.mean(axis=0)).float()
        mask[i, :n_points] = True
        for name, values in s.attributes.items():
            attributes[name][i, :n_points] = torch.from_numpy(values)
    return SampleBatch(points, eigenfunctions, mask, attributes)


class SignatureDataset(Dataset[LabelledSignature]):
    """Signatures of mesh files, computed on first touch and cached on disk.

    Args:
        root_or_paths: a folder (see `find_meshes`), mesh files, or a `MeshFiles`.
        config: parameters of the Signatures; `SignatureConfig()` if None.
        cache_dir: where Signatures are kept; the user's cache directory if None. The key of a file covers the mesh
            file's content, how it is read, every parameter, and the algorithm's version.
        labels: classes of the given paths, by name.
        attributes: further named scalars of the interior samples, each a function of their points, (P, 3) in the mesh
            file's coordinates, to (P,). They are evaluated at each reading, not cached.
        repair, component, allow_open: how meshes are read, see `load_mesh`.

    Raises:
        FileNotFoundError: no such folder, or no mesh in it.
    """

    def __init__(
        self,
        root_or_paths: str | Path | Sequence[str | Path] | MeshFiles,
        config: SignatureConfig | None = None,
        cache_dir: str | Path | None = None,
        *,
        labels: Sequence[str] | None = None,
        attributes: Mapping[str, PointFunction] | None = None,
        repair: bool = False,
        component: Component | None = None,
        allow_open: bool = False,
    ) -> None:
        if isinstance(root_or_paths, MeshFiles):
            self.files = root_or_paths
        elif isinstance(root_or_paths, str | Path) and Path(root_or_paths).is_dir():
            self.files = find_meshes(root_or_paths)
        elif isinstance(root_or_paths, str | Path):
            self.files = mesh_files([root_or_paths], labels)
        else:
            self.files = mesh_files(root_or_paths, labels)
        self._recipe = _Recipe(
            config or SignatureConfig(), Path(cache_dir or default_cache_dir()), repair, component, allow_open
        )
        self._attributes = dict(attributes or {})
        self.classes: tuple[str, ...] = tuple(sorted(set(self.files.labels or ())))

    @property
    def config(self) -> SignatureConfig:
        """Parameters of the Signatures."""
        return self._recipe.config

    @property
    def labels(self) -> Tensor:
        """(N,) int64 index of each mesh's class in `classes`, −1 where unknown."""
        index = {name: i for i, name in enumerate(self.classes)}
        names: Sequence[str | None] = self.files.labels or [None] * len(self.files)
        return torch.tensor([-1 if name is None else index[name] for name in names], dtype=torch.int64)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> LabelledSignature:
        path, name = self.files.paths[index], self.files.names[index]
        label = -1 if self.files.labels is None else self.classes.index(self.files.labels[index])
        signature = replace(self._recipe.signature(path), name=name)
        if self._attributes:
            signature = replace(signature, interior=_with_attributes(signature.interior, self._attributes, name))
        return LabelledSignature(signature, label, name)

    def mesh(self, index: int) -> Mesh:
        """The mesh itself, read and checked as for its Signature.

        Raises:
            MeshError: it cannot be used.
        """
        return self._recipe.mesh(self.files.paths[index])

    def subset(self, indices: Sequence[int]) -> SignatureDataset:
        """The dataset of some of the meshes; `classes` keeps all names, so that labels keep their numbers."""
        chosen = object.__new__(SignatureDataset)
        chosen.files = MeshFiles(
            tuple(self.files.paths[i] for i in indices),
            tuple(self.files.names[i] for i in indices),
            None if self.files.labels is None else tuple(self.files.labels[i] for i in indices),
        )
        chosen._recipe = self._recipe
        chosen._attributes = self._attributes
        chosen.classes = self.classes
        return chosen

    def precompute(
        self,
        executor: Executor | None = None,
        *,
        n_workers: int | None = None,
        strict: bool = False,
        progress: bool = True,
    ) -> list[Failure]:
        """Fill the cache, skipping what is there, and list the meshes that cannot be used.

        Args:
            executor: any `concurrent.futures.Executor`; a pool of spawned processes with one BLAS thread each if None.
            n_workers: processes of that pool; all cores if None.
            strict: raise at the first bad mesh instead of listing it.
            progress: show a bar.

        Raises:
            MeshError: a bad mesh, if `strict`.
        """
        missing = [i for i in range(len(self)) if not self._recipe.is_cached(self.files.paths[i])]
        failures: dict[int, Failure] = {}
        n_workers = min(n_workers or n_cores(), max(len(missing), 1))
        with contextlib.ExitStack() as stack:
            bar = stack.enter_context(
                tqdm(total=len(self), initial=len(self) - len(missing), desc="signatures", disable=not progress)
            )
            if executor is None and n_workers > 1:
                executor = stack.enter_context(process_pool(n_workers))
            results = _map(executor, self._recipe, {i: self.files.paths[i] for i in missing})
            for i, error in stack.enter_context(contextlib.closing(results)):
                bar.update()
                if error is None:
                    continue
                if strict:
                    raise MeshError(error)
                failures[i] = Failure(self.files.names[i], self.files.paths[i], error)
                logger.warning("skipped: %s", error)
        return [failures[i] for i in sorted(failures)]

    def usable(self, failures: Sequence[Failure]) -> SignatureDataset:
        """The dataset without the meshes that failed."""
        failed = {failure.id for failure in failures}
        return self.subset([i for i, name in enumerate(self.files.names) if name not in failed])


def _with_attributes(samples: Samples, functions: Mapping[str, PointFunction], name: str) -> Samples:
    found = dict(samples.attributes)
    for attribute, function in functions.items():
        values = np.asarray(function(samples.points), dtype=np.float32)
        if values.shape != (len(samples),) or not np.isfinite(values).all():
            raise ValueError(
                f"attributes: expected {attribute!r} to give {len(samples)} finite numbers for the points of {name}, "
                f"got an array of shape {values.shape} with {int((~np.isfinite(values)).sum())} not finite."
            )
        found[attribute] = values
    return replace(samples, attributes=found)


@dataclass(frozen=True)
class _Recipe:
    """How a file becomes a Signature; small and picklable, so that workers get no more than this."""

    config: SignatureConfig
    cache_dir: Path
    repair: bool
    component: Component | None
    allow_open: bool

    def mesh(self, path: Path) -> Mesh:
        return load_mesh(path, MeshReading(self.repair, self.component, self.allow_open))

    def signature(self, path: Path) -> Signature:
        cache, key = SignatureCache(self.cache_dir), self._key(path)
        signature = cache.get(key)
        if signature is None:
            signature = compute_signature(self.mesh(path), self.config)
            cache.put(key, signature)
        return signature

    def is_cached(self, path: Path) -> bool:
        try:
            key = self._key(path)
        except MeshError:
            return False
        return key in SignatureCache(self.cache_dir)

    def _key(self, path: Path) -> str:
        try:
            content = path.read_bytes()
        except OSError as error:
            raise MeshError(f"{path}: cannot be read ({error.strerror}). Check the path.") from error
        # The suffix chooses the reader, so the same bytes under another suffix are another mesh.
        reading = [path.suffix.lower(), self.repair, self.component, self.allow_open]
        parameters = json.dumps([reading, self.config.as_dict()], sort_keys=True)
        return hashlib.sha256(parameters.encode() + b"\0" + content).hexdigest()


def _compute(recipe: _Recipe, path: Path) -> str | None:
    """Put one Signature into the cache; the reason if that fails, because one bad mesh must not stop the others."""
    try:
        recipe.signature(path)
    except MeshError as error:
        return str(error)
    except Exception as error:
        return f"{path}: {type(error).__name__}: {error}"
    return None


def _map(
    executor: Executor | None, recipe: _Recipe, paths: Mapping[int, Path]
) -> Generator[tuple[int, str | None], None, None]:
    if executor is None:
        for i, path in paths.items():
            yield i, _compute(recipe, path)
        return
    futures: dict[Future[str | None], int] = {executor.submit(_compute, recipe, path): i for i, path in paths.items()}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        for future in futures:
            future.cancel()


@contextlib.contextmanager
def process_pool(n_workers: int) -> Iterator[Executor]:
    """A pool of spawned processes with one BLAS thread each, which end with this process."""
    # One BLAS thread a worker, or n workers on n cores run n² threads. The libraries read the variables when they are
    # first imported, which in a spawned process is before any initialiser runs.
    before: dict[str, Any] = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(n_workers, mp_context=context, initializer=_end_with_parent) as pool:
            yield pool
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """End this worker when its parent ends: after a kill it would wait for work for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

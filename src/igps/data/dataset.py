"""A torch Dataset of Signatures, computed on first touch and cached."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset
from tqdm import tqdm

from igps._parallel import Failed, Limits, MachineError, run
from igps.data.batch import LabelledSignature, SignatureBatch, collate
from igps.data.cache import SignatureCache, default_cache_dir
from igps.data.file_stat_cache import FileStatCache
from igps.data.pipeline import CacheHit, SignaturePipeline, fill_elsewhere, version
from igps.data.sources import Bodies, find_bodies, given_bodies
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import Samples, SignatureConfig

logger = logging.getLogger(__name__)

# Seconds until a file that another machine wrote is seen here, by a file system for many.
_SHARED_WITHIN = 60.0
_REMEMBERED_AT_ONCE = 1000

PointFunction = Callable[[NDArray[np.float64]], NDArray[np.floating]]


@dataclass(frozen=True)
class Failure:
    """A mesh that could not be used, and why."""

    id: str
    path: Path
    error: str


class SignatureDataset(Dataset[LabelledSignature]):
    """Signatures of mesh files, computed on first touch and cached on disk.

    Example:
        >>> import tempfile, trimesh
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = ball.export(f"{folder}/ball.off")
        ...     dataset = SignatureDataset(folder, SignatureConfig(n_eigenpairs=20), f"{folder}/cache")
        ...     item = dataset[0]
        >>> len(dataset), item.id, item.signature.eigenvalues.shape
        (1, 'ball.off', (20,))

    Args:
        root_or_paths: a folder (see `find_bodies`), mesh files, or a `Bodies`.
        config: parameters of the Signatures; `SignatureConfig()` if None, with 250 eigenpairs. For one descriptor
            alone, `descriptor.requirements.apply_to(SignatureConfig())` has as many as it needs.
        cache_dir: where Signatures are kept; the user's cache directory if None. The key of a file covers the mesh
            file's content, how it is read, every parameter, and the algorithm's version. A Signature with more
            eigenpairs or attributes serves too.
        labels: classes of the given paths, by name.
        reading: how mesh files are read.
        point_functions: attributes of your own of the interior samples, by name: functions of their points, (P, 3) in
            the mesh file's coordinates, to (P,). They are evaluated at each reading, not cached.

    Raises:
        FileNotFoundError: no such folder, or no mesh in it.
    """

    def __init__(
        self,
        root_or_paths: str | Path | Sequence[str | Path] | Bodies,
        config: SignatureConfig | None = None,
        cache_dir: str | Path | None = None,
        *,
        labels: Sequence[str] | None = None,
        reading: LoadOptions | None = None,
        point_functions: Mapping[str, PointFunction] | None = None,
    ) -> None:
        if isinstance(root_or_paths, Bodies):
            self.bodies = root_or_paths
        elif isinstance(root_or_paths, str | Path) and Path(root_or_paths).is_dir():
            self.bodies = find_bodies(root_or_paths)
        elif isinstance(root_or_paths, str | Path):
            self.bodies = given_bodies([root_or_paths], labels)
        else:
            self.bodies = given_bodies(root_or_paths, labels)
        self._pipeline = SignaturePipeline(
            (config or SignatureConfig()).resolved(), reading or LoadOptions(), Path(cache_dir or default_cache_dir())
        )
        self._point_functions = dict(point_functions or {})
        self.classes: tuple[str, ...] = tuple(sorted(set(self.bodies.labels or ())))

    @property
    def config(self) -> SignatureConfig:
        """Parameters of the Signatures."""
        return self._pipeline.config

    @property
    def pipeline(self) -> SignaturePipeline:
        """How a file becomes a Signature."""
        return self._pipeline

    @property
    def reading(self) -> LoadOptions:
        """How the mesh files are read."""
        return self._pipeline.reading

    @property
    def labels(self) -> Tensor:
        """(N,) int64 index of each mesh's class in `classes`, −1 where unknown."""
        index = {name: i for i, name in enumerate(self.classes)}
        names: Sequence[str | None] = self.bodies.labels or [None] * len(self.bodies)
        return torch.tensor([-1 if name is None else index[name] for name in names], dtype=torch.int64)

    def __len__(self) -> int:
        return len(self.bodies)

    def __getitem__(self, index: int) -> LabelledSignature:
        path, name = self.bodies.paths[index], self.bodies.names[index]
        label = -1 if self.bodies.labels is None else self.classes.index(self.bodies.labels[index])
        signature = replace(self._pipeline.signature(path), name=name)
        if self._point_functions:
            signature = replace(signature, interior=_with_attributes(signature.interior, self._point_functions, name))
        return LabelledSignature(signature, label, name)

    def mesh(self, index: int) -> Mesh:
        """The mesh itself, read and checked as for its Signature.

        Raises:
            MeshError: it cannot be used.
        """
        return self._pipeline.mesh(self.bodies.paths[index])

    def key(self, index: int) -> str:
        """The name of a Signature in the cache, by the content of its file and everything that it depends on.

        Raises:
            MeshError: the file cannot be read.
        """
        return self._pipeline.key(self.bodies.paths[index])

    def cached_keys(self) -> list[str | None]:
        """What in the cache serves each mesh, None where nothing does; of files that are known, without reading them.

        None as well of those with point functions, which no key covers.
        """
        if self._point_functions:
            return [None] * len(self)
        ready = FileStatCache(self._pipeline).ready(self.bodies.paths)
        served = (self._served(i) if path not in ready else ready[path] for i, path in enumerate(self.bodies.paths))
        return [None if one is None else one.key for one in served]

    def notes(self, index: int) -> tuple[str, ...]:
        """What was done to a mesh on its way to its cached Signature, in words."""
        return self._pipeline.notes(self.bodies.paths[index])

    def all_notes(self) -> list[tuple[str, ...]]:
        """The notes of all meshes; of files that are known from `precompute` without reading them again."""
        ready = FileStatCache(self._pipeline).ready(self.bodies.paths)
        return [ready[path].notes if path in ready else self.notes(i) for i, path in enumerate(self.bodies.paths)]

    def batch(self, indices: Sequence[int], meshes: bool = False) -> SignatureBatch:
        """Some of the items as a batch, with or without their meshes."""
        return collate([self[i] for i in indices], [self.mesh(i) for i in indices] if meshes else None)

    def subset(self, indices: Sequence[int]) -> SignatureDataset:
        """The dataset of some of the meshes; `classes` keeps all names, so that labels keep their numbers."""
        chosen = object.__new__(SignatureDataset)
        chosen.bodies = self.bodies.subset(indices)
        chosen._pipeline = self._pipeline
        chosen._point_functions = self._point_functions
        chosen.classes = self.classes
        return chosen

    def precompute(
        self,
        executor: Executor | None = None,
        *,
        n_workers: int | None = None,
        strict: bool = False,
        progress: bool = True,
        limits: Limits | None = None,
    ) -> list[Failure]:
        """Fill the cache, skipping what is there, and list the meshes that cannot be used.

        Args:
            executor: any `concurrent.futures.Executor`, such as that of a cluster, whose workers must see the files and
                the cache by the same paths; processes of ours with one BLAS thread each if None.
            n_workers: of those processes; all cores if None.
            strict: raise at the first bad mesh instead of listing it.
            progress: show a bar.
            limits: time and memory of one mesh; one that needs more is bad.

        Raises:
            MeshError: a bad mesh, if `strict`.
            MachineError: the disk is full, or the like; what is done is kept.
        """
        SignatureCache(self._pipeline.cache_dir).remove_abandoned()
        known = FileStatCache(self._pipeline)
        ready = known.ready(self.bodies.paths)
        missing = [i for i, path in enumerate(self.bodies.paths) if path not in ready]
        fill: Callable[[Path], CacheHit] = self._pipeline.fill
        if executor is None:
            served = {i: self._served(i) for i in missing}
            known.remember({self.bodies.paths[i]: one for i, one in served.items() if one is not None})
            missing = [i for i, one in served.items() if one is None]
            paths = [self.bodies.paths[i] for i in missing]
        else:
            # Elsewhere, and from another folder: the workers look for themselves what there is.
            pipeline = replace(self._pipeline, cache_dir=self._pipeline.cache_dir.absolute())
            fill = partial(fill_elsewhere, pipeline, version())
            paths = [self.bodies.paths[i].absolute() for i in missing]
        failures: dict[int, Failure] = {}
        new: dict[Path, CacheHit] = {}
        results = run(fill, paths, n_workers=n_workers, executor=executor, limits=limits)
        with (
            tqdm(total=len(self), initial=len(self) - len(missing), desc="signatures", disable=not progress) as bar,
            contextlib.closing(results),
            contextlib.ExitStack() as at_the_end,
        ):
            at_the_end.callback(lambda: known.remember(new))
            for number, outcome in results:
                bar.update()
                if not isinstance(outcome, Failed):
                    self._check_visible(outcome, first=not new)
                    new[self.bodies.paths[missing[number]]] = outcome
                    if len(new) >= _REMEMBERED_AT_ONCE:
                        known.remember(new)
                        new.clear()
                    continue
                failure = self.failure(missing[number], outcome)
                if strict:
                    raise MeshError(failure.error)
                failures[missing[number]] = failure
                logger.warning("skipped: %s", failure.error)
        return [failures[i] for i in sorted(failures)]

    def _served(self, index: int) -> CacheHit | None:
        try:
            return self._pipeline.served(self.bodies.paths[index])
        except MeshError:  # computing it will say why
            return None

    def _check_visible(self, served: CacheHit, first: bool) -> None:
        """Raise a MachineError if what a worker put into its cache does not come to this one, asked at the first."""
        path = SignatureCache(self._pipeline.cache_dir).path(served.key)
        deadline = time.monotonic() + _SHARED_WITHIN
        while first and not path.exists():
            if time.monotonic() > deadline:
                raise MachineError(
                    f"{self._pipeline.cache_dir}: the workers' signatures do not appear there. Choose a cache_dir that "
                    "this machine and all workers share, by the same path."
                )
            time.sleep(0.1)

    def failure(self, index: int, failed: Failed) -> Failure:
        """What failed of a mesh, in a sentence that names its file."""
        path, reason = self.bodies.paths[index], failed.reason
        named = reason if reason.startswith(str(path)) else f"{path}: {reason}"
        return Failure(self.bodies.names[index], path, named)

    def usable(self, failures: Sequence[Failure]) -> SignatureDataset:
        """The dataset without the meshes that failed."""
        failed = {failure.id for failure in failures}
        return self.subset([i for i, name in enumerate(self.bodies.names) if name not in failed])


def _with_attributes(samples: Samples, functions: Mapping[str, PointFunction], name: str) -> Samples:
    found = dict(samples.attributes)
    for attribute, function in functions.items():
        values = np.asarray(function(samples.points), dtype=np.float32)
        if values.shape != (len(samples),) or not np.isfinite(values).all():
            raise ValueError(
                f"point_functions: expected {attribute!r} to give {len(samples)} finite numbers for the points of "
                f"{name}, got an array of shape {values.shape} with {int((~np.isfinite(values)).sum())} not finite."
            )
        found[attribute] = values
    return replace(samples, attributes=found)

"""Descriptions of a whole dataset."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from igps._parallel import Failed, n_cores, on_threads, one_thread, run
from igps.data.cache import DescriptionCache
from igps.data.dataset import Failure, SignatureDataset
from igps.mesh.mesh import MeshError
from igps.nn.descriptor import BodyDescriptor, Descriptor

logger = logging.getLogger(__name__)


def describe(
    dataset: SignatureDataset,
    descriptor: nn.Module,
    *,
    batch_size: int = 1,
    n_workers: int | None = None,
    progress: bool = False,
) -> Tensor:
    """Descriptions of all meshes of a dataset, in evaluation mode, without gradients, on the descriptor's device.

    Signatures that are not cached are computed on the way; `dataset.precompute()` does that on all cores.

    Example:
        >>> import tempfile, trimesh
        >>> from igps import SignatureConfig, descriptor
        >>> interior = descriptor("interior")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.icosphere(subdivisions=2).export(f"{folder}/ball.off")
        ...     _ = trimesh.creation.capsule(height=3.0, radius=0.5).export(f"{folder}/pill.off")
        ...     config = interior.requirements.apply_to(SignatureConfig())
        ...     histograms = describe(SignatureDataset(folder, config, f"{folder}/cache"), interior)
        >>> len(histograms), interior.distances(histograms, histograms).argmin(dim=1).tolist()
        (2, [0, 1])

    Args:
        dataset: N meshes.
        descriptor: a `Descriptor`, or any module from `SignatureBatch` to (N, ...).
        batch_size: shapes at a time.
        n_workers: threads, or for descriptors that work in NumPy processes; all cores if None.
        progress: show a bar.

    Returns:
        (N, ...) on the CPU.

    Raises:
        MeshError: a mesh that cannot be described.
        ValueError: the signatures lack what the descriptor needs.
    """
    if isinstance(descriptor, BodyDescriptor):
        values, failures = describe_usable(dataset, descriptor, n_workers=n_workers, progress=progress)
        if failures:
            raise MeshError(failures[0].error)
        return values
    _check(descriptor, dataset)
    device = next(descriptor.parameters(), next(descriptor.buffers(), torch.empty(0))).device
    batches = [range(i, min(i + batch_size, len(dataset))) for i in range(0, len(dataset), batch_size)]
    one = partial(_describe_batch, dataset, descriptor, device)
    with evaluation_mode(descriptor), tqdm(desc="descriptions", total=len(dataset), disable=not progress) as bar:
        parts = []
        for part in on_threads(one, batches, n_workers or n_cores()) if device.type == "cpu" else map(one, batches):
            parts.append(part)
            bar.update(len(part))
    return torch.cat(parts)


def describe_usable(
    dataset: SignatureDataset,
    descriptor: Descriptor,
    *,
    cache_tag: str | None = None,
    n_workers: int | None = None,
    strict: bool = False,
    progress: bool = False,
) -> tuple[Tensor, list[Failure]]:
    """Descriptions (M, ...) of the meshes that can be described, in order, and the failures of the others.

    Args:
        dataset: N meshes.
        descriptor: what describes them.
        cache_tag: all that descriptions depend on beside Signatures, in words. What has been described under the same
            words is read from the cache, and all else kept there whose Signature is there before. None to describe all.
        n_workers: see `describe`.
        strict: raise at the first mesh that cannot be described.
        progress: show a bar.

    Raises:
        MeshError: a mesh that cannot be described, if `strict`; or all of them.
        ValueError: the signatures lack what the descriptor needs.
    """
    _check(descriptor, dataset)
    kept = None if cache_tag is None else _Kept(dataset, cache_tag)
    found = {} if kept is None else kept.found()
    failures: dict[int, Failure] = {}
    missing = [i for i in range(len(dataset)) if i not in found]
    if isinstance(descriptor, BodyDescriptor):
        outcomes = describe_each([(descriptor, dataset, i) for i in missing], n_workers)
    else:
        outcomes = _each_on_threads(dataset.subset(missing), descriptor, n_workers)
    with (
        evaluation_mode(descriptor),
        tqdm(desc="descriptions", total=len(dataset), initial=len(found), disable=not progress) as bar,
        contextlib.closing(outcomes),
    ):
        for number, outcome in outcomes:
            bar.update()
            i = missing[number]
            if isinstance(outcome, Description):
                found[i] = outcome.values
                if kept is not None:
                    kept.keep(i, outcome.values)
                continue
            if strict or len(failures) + 1 == len(dataset):
                raise MeshError(outcome.error)
            failures[i] = outcome
    values = torch.from_numpy(np.stack([found[i] for i in sorted(found)]))
    return values, [failures[i] for i in sorted(failures)]


class _Kept:
    """The descriptions of a dataset that are in its cache; done without where the cache cannot be written."""

    def __init__(self, dataset: SignatureDataset, cache_tag: str) -> None:
        self._dataset, self._kept_as = dataset, cache_tag
        self._served = dataset.cached_keys()
        self._cache = DescriptionCache(dataset.pipeline.cache_dir)
        self._cache.remove_abandoned()
        self._is_writable = True

    def found(self) -> dict[int, NDArray[np.float32]]:
        values = {i: self._cache.get(self._key(one)) for i, one in enumerate(self._served) if one is not None}
        return {i: one for i, one in values.items() if one is not None}

    def keep(self, i: int, values: NDArray[np.float32]) -> None:
        """Keep a description, if the file is the one that it was before it was described."""
        served = self._served[i]
        if served is None or not self._is_writable or self._dataset.subset([i]).cached_keys() != [served]:
            return
        try:
            self._cache.put(self._key(served), values)
        except OSError as error:
            logger.warning("%s: descriptions are not kept (%s)", self._cache.directory, error)
            self._is_writable = False

    def _key(self, served: str) -> str:
        config = json.dumps(self._dataset.config.as_dict(), sort_keys=True)
        return hashlib.sha256(f"{self._kept_as}\0{served}\0{config}".encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Description:
    """What a descriptor says of one mesh.

    Args:
        values: (...) float32.
        seconds: of processor time, from the cached signature on, with the reading of the mesh where it is needed.
    """

    values: NDArray[np.float32]
    seconds: float


def describe_each(
    jobs: Sequence[tuple[Descriptor, SignatureDataset, int]], n_workers: int | None = None
) -> Generator[tuple[int, Description | Failure], None, None]:
    """What each descriptor says of a mesh of a dataset, on several processes, with the number of the job, as it comes.

    A mesh that cannot be described, or that kills its process, is a `Failure` and costs no other its description.

    Args:
        jobs: descriptors, datasets, and which of the meshes.
        n_workers: processes; all cores if None.

    Raises:
        MachineError: see `igps._parallel.run`.
    """
    small = [(descriptor, dataset.subset([i])) for descriptor, dataset, i in jobs]
    for number, outcome in run(_describe_one, small, n_workers=n_workers):
        if isinstance(outcome, Failed):
            _, dataset, i = jobs[number]
            yield number, dataset.failure(i, outcome)
        else:
            yield number, outcome


@contextlib.contextmanager
def evaluation_mode(module: nn.Module) -> Iterator[None]:
    """The module and all in it in evaluation mode; afterwards each in the mode in which it was."""
    modes = [(one, one.training) for one in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for one, training in modes:
            one.training = training


def _describe_one(job: tuple[Descriptor, SignatureDataset]) -> Description:
    descriptor, dataset = job
    with one_thread(), torch.inference_mode():
        batch = dataset.batch([0])
        start = time.process_time()
        if descriptor.requirements.mesh:
            batch = dataset.batch([0], meshes=True)
        values = descriptor(batch)[0].cpu().numpy()
        seconds = time.process_time() - start
    if not np.isfinite(values).all():
        raise MeshError(f"{dataset.bodies.paths[0]}: the description has entries that are not finite.")
    return Description(values, seconds)


def _check(descriptor: nn.Module, dataset: SignatureDataset) -> None:
    if isinstance(descriptor, Descriptor):
        descriptor.requirements.check_config(dataset.config)


def _describe_batch(
    dataset: SignatureDataset, descriptor: nn.Module, device: torch.device, indices: Sequence[int]
) -> Tensor:
    meshes = isinstance(descriptor, Descriptor) and descriptor.requirements.mesh
    with torch.inference_mode():  # holds for the thread that enters it
        values: Tensor = descriptor(dataset.batch(indices, meshes).to(device)).cpu()
    return values


def _each_on_threads(
    dataset: SignatureDataset, descriptor: Descriptor, n_workers: int | None
) -> Generator[tuple[int, Description | Failure], None, None]:
    def one(i: int) -> Description | Failure:
        try:
            return _describe_one((descriptor, dataset.subset([i])))
        except ValueError as error:
            return dataset.failure(i, Failed(str(error)))

    yield from enumerate(on_threads(one, range(len(dataset)), n_workers or n_cores()))

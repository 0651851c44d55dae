"""Descriptions of a whole dataset."""

import contextlib
import hashlib
import json
import logging
import time
from collections.abc import Collection, Generator, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from igps._arrays import Singles
from igps._parallel import Failed, n_cores, on_threads, one_thread, run
from igps.data.cache import DescriptionCache
from igps.data.dataset import Failure, SignatureDataset
from igps.mesh.mesh import MeshError
from igps.nn.axes import Attribute
from igps.nn.descriptor import BodyDescriptor, Descriptor

logger = logging.getLogger(__name__)

_Described = Generator[tuple[Sequence[int], Sequence[Singles | Failure]], None, None]


def describe(
    dataset: SignatureDataset,
    descriptor: nn.Module,
    *,
    failures: list[Failure] | None = None,
    cache_tag: str | None = None,
    batch_size: int = 1,
    n_workers: int | None = None,
    progress: bool = False,
) -> Tensor:
    """Descriptions of the meshes of a dataset, in evaluation mode, without gradients, on the descriptor's device.

    Signatures that are not cached are computed on the way; `dataset.precompute()` does that on all cores.

    Example:
        >>> import tempfile, trimesh
        >>> from igps import descriptor
        >>> interior = descriptor("interior")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.icosphere(subdivisions=2).export(f"{folder}/ball.off")
        ...     _ = trimesh.creation.capsule(height=3.0, radius=0.5).export(f"{folder}/pill.off")
        ...     dataset = SignatureDataset(folder, descriptor=interior, cache_dir=f"{folder}/cache")
        ...     histograms = describe(dataset, interior)
        >>> len(histograms), interior.distances(histograms, histograms).argmin(dim=1).tolist()
        (2, [0, 1])

    Args:
        dataset: N meshes.
        descriptor: a `Descriptor`, or any module from `SignatureBatch` to (N, ...).
        failures: a list, to which meshes that cannot be described are added, in order; they have no row in the result,
            see `SignatureDataset.usable`. None to raise at the first.
        cache_tag: all that descriptions depend on beside Signatures, see `igps.descriptors.fingerprint.cache_tag`. What
            has been described under the same tag is read from the cache, and what is described now is kept there. None
            to describe all.
        batch_size: shapes at a time.
        n_workers: threads, or processes for descriptors that work in NumPy; all cores if None.
        progress: show a bar.

    Returns:
        (N, ...) on the CPU.

    Raises:
        MeshError: a mesh that cannot be described, if `failures` is None; or none that can.
        ValueError: the Signatures lack what the descriptor needs, or there is no mesh.
    """
    if isinstance(descriptor, Descriptor):
        descriptor.requirements.check_config(dataset.config)
    if not isinstance(descriptor, nn.Module):
        given = f"igps.descriptor({descriptor!r})" if isinstance(descriptor, str) else "a Descriptor"
        raise TypeError(f"descriptor: expected a module, got {descriptor!r}. Give {given}.")
    if not len(dataset):
        raise ValueError("dataset: expected at least one mesh to describe, got none.")
    kept = None if cache_tag is None else _DescriptionStore(dataset, cache_tag)
    found = {} if kept is None else kept.found()
    failed: dict[int, Failure] = {}
    missing = [i for i in range(len(dataset)) if i not in found]
    if isinstance(descriptor, BodyDescriptor):
        described = _on_processes(dataset, descriptor, missing, n_workers)
    else:
        chunks = [missing[i : i + batch_size] for i in range(0, len(missing), batch_size)]
        described = _on_threads(dataset, descriptor, chunks, n_workers)
    with (
        evaluation_mode(descriptor),
        tqdm(desc="descriptions", total=len(dataset), initial=len(found), disable=not progress) as bar,
        contextlib.closing(described),
    ):
        for indices, outcomes in described:
            bar.update(len(indices))
            for i, outcome in zip(indices, outcomes, strict=True):
                if not isinstance(outcome, Failure):
                    found[i] = outcome
                    if kept is not None:
                        kept.keep(i, outcome)
                elif failures is None:
                    raise MeshError(outcome.error)
                else:
                    failed[i] = outcome
    if failures is not None:
        failures += [failed[i] for i in sorted(failed)]
    if not found:
        raise MeshError(failed[0].error)
    return torch.from_numpy(np.stack([found[i] for i in sorted(found)]))


def fit_centres(descriptor: nn.Module, dataset: SignatureDataset) -> bool:
    """Fit the centres of axes by quantiles to the samples of a collection; whether there were such axes.

    What has its centres keeps them. Of each body as many samples count, the first 500. A ValueError where the samples
    have no such attribute.
    """
    axes = [one for one in descriptor.modules() if isinstance(one, Attribute) and not one.is_fitted]
    values: list[list[Singles]] = [[] for _ in axes]
    for signature in dataset.signatures() if axes else ():
        check_attributes(descriptor, signature.interior.attributes)
        for axis, found in zip(axes, values, strict=True):
            found.append(signature.interior.attributes[axis.name][:500])
    for axis, found in zip(axes, values, strict=True):
        axis.fit(torch.from_numpy(np.concatenate(found)))
    return bool(axes)


def check_attributes(descriptor: nn.Module, names: Collection[str]) -> None:
    """Raise a ValueError where an axis needs an attribute that is not among these names."""
    for one in descriptor.modules():
        if isinstance(one, Attribute) and one.name not in names:
            raise ValueError(
                f"attributes: expected {one.name!r} of each body, got {sorted(names)}. Give it as --attribute "
                f"{one.name}=..., or as SignatureDataset(attributes=...)."
            )


def check_centres(descriptor: nn.Module) -> None:
    """Raise a ValueError where an axis waits for `fit_centres`."""
    for one in descriptor.modules():
        if isinstance(one, Attribute):
            one.check_fitted()


@contextlib.contextmanager
def evaluation_mode(module: nn.Module) -> Iterator[None]:
    """Put a module, and all in it, into evaluation mode, and afterwards back into the mode of before."""
    modes = [(one, one.training) for one in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for one, training in modes:
            one.training = training


def _on_threads(
    dataset: SignatureDataset, descriptor: nn.Module, chunks: Sequence[Sequence[int]], n_workers: int | None
) -> _Described:
    """Chunks of the meshes with the description of each, on threads; one by one on a device."""
    device = next(descriptor.parameters(), next(descriptor.buffers(), torch.empty(0))).device

    def outcomes(indices: Sequence[int]) -> Sequence[Singles | Failure]:
        try:
            return list(describe_timed((descriptor, dataset.subset(indices), device))[0])
        except ValueError as error:
            if len(indices) == 1:
                return [Failure.of(dataset.bodies, indices[0], str(error))]
            return [outcome for i in indices for outcome in outcomes([i])]

    n_threads = (n_workers or n_cores()) if device.type == "cpu" else 1
    yield from zip(chunks, on_threads(outcomes, chunks, n_threads), strict=True)


def _on_processes(
    dataset: SignatureDataset, descriptor: nn.Module, indices: Sequence[int], n_workers: int | None
) -> _Described:
    """The same one by one on processes: a mesh that kills its process costs no other its description."""
    jobs = [(descriptor, dataset.subset([i]), torch.device("cpu")) for i in indices]
    for number, outcome in run(describe_timed, jobs, n_workers=n_workers):
        i = indices[number]
        one = Failure.of(dataset.bodies, i, outcome.reason) if isinstance(outcome, Failed) else outcome[0][0]
        yield [i], [one]


def describe_timed(job: tuple[nn.Module, SignatureDataset, torch.device]) -> tuple[Singles, float]:
    """(N, ...) descriptions of all meshes of a dataset at once, and the seconds of processor time that they took.

    The time includes reading the meshes, where the descriptor needs them, but not the Signatures.
    """
    descriptor, dataset, device = job
    with one_thread(), torch.inference_mode():  # hold for the thread that enters them
        batch = dataset.batch(range(len(dataset)))
        start = time.process_time()
        if isinstance(descriptor, Descriptor) and descriptor.requirements.mesh:
            batch = replace(batch, meshes=tuple(dataset.mesh(i) for i in range(len(dataset))))
        values: Singles = descriptor(batch.to(device)).cpu().numpy()
        seconds = time.process_time() - start
    if not np.isfinite(values).all():
        raise MeshError(f"{dataset.bodies.paths[0]}: the description has entries that are not finite.")
    return values, seconds


class _DescriptionStore:
    """The descriptions of a dataset in its cache; a cache that cannot be written is no error."""

    def __init__(self, dataset: SignatureDataset, cache_tag: str) -> None:
        self._dataset, self._tag = dataset, cache_tag
        self._keys = dataset.cached_keys()
        self._cache = DescriptionCache(dataset.pipeline.cache_dir)
        self._cache.remove_abandoned()
        self._is_writable = True

    def found(self) -> dict[int, Singles]:
        values = {i: self._cache.get(self._key(one)) for i, one in enumerate(self._keys) if one is not None}
        return {i: one for i, one in values.items() if one is not None}

    def keep(self, i: int, values: Singles) -> None:
        """Keep a description, unless its file has changed meanwhile."""
        key = self._keys[i]
        if key is None or not self._is_writable or self._dataset.subset([i]).cached_keys() != [key]:
            return
        try:
            self._cache.put(self._key(key), values)
        except OSError as error:
            logger.warning("%s: descriptions are not kept (%s)", self._cache.directory, error)
            self._is_writable = False

    def _key(self, key: str) -> str:
        config = json.dumps(self._dataset.config.as_dict(), sort_keys=True)
        return hashlib.sha256(f"{self._tag}\0{key}\0{config}".encode()).hexdigest()

"""Descriptions of a whole dataset."""

import contextlib
import logging
import time
from collections.abc import Collection, Generator, Iterator, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
from torch import Tensor, nn

from igps._arrays import Singles
from igps._parallel import on_threads, run
from igps._progress import Progress
from igps._threads import n_cores, one_thread
from igps.data.attribute_sources import attribute_names
from igps.data.cache import Record
from igps.data.collation import collate
from igps.data.dataset import Failure, SignatureDataset
from igps.data.keys import derived_key
from igps.data.requirements import Requirements
from igps.failures import Failed
from igps.mesh.errors import MeshError
from igps.nn.axes import Attribute
from igps.nn.descriptor import BodyDescriptor, Descriptor
from igps.signature.config import AttributeName

logger = logging.getLogger(__name__)

_Outcomes = Generator[tuple[Sequence[int], Sequence[Singles | Failure]], None, None]


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
    """Describe the meshes of a dataset on the descriptor's device, in evaluation mode, without gradients.

    Signatures that are not cached are computed first; `dataset.precompute()` does this on all cores.

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
        failures: a list that receives the meshes that cannot be described, in order; they have no row in the result,
            see `SignatureDataset.usable`. If None, the first failure raises an error.
        cache_tag: identifies everything but the Signatures that descriptions depend on, see
            `igps.descriptors.fingerprint.cache_tag`. Descriptions are cached under this tag; None disables the cache.
        batch_size: number of shapes that are described at once.
        n_workers: number of threads, or of processes for a `BodyDescriptor`; all cores if None.
        progress: show a progress bar.

    Returns:
        (N, ...) on the CPU.

    Raises:
        MeshError: a mesh cannot be described and `failures` is None, or no mesh can be described.
        ValueError: the Signatures lack what the descriptor needs, or there is no mesh.
    """
    dataset = _with_required(dataset, descriptor, n_workers)
    if not isinstance(descriptor, nn.Module):
        is_name = isinstance(descriptor, str)
        remedy = f"igps.descriptor({descriptor!r})" if is_name else "a Descriptor"
        raise TypeError(f"descriptor: expected a module, got {descriptor!r}. Give {remedy}.")
    if not len(dataset):
        raise ValueError("dataset: expected at least one mesh to describe, got none.")
    cache = None if cache_tag is None else _DescriptionStore(dataset, cache_tag)
    descriptions = {} if cache is None else cache.read()
    failed: dict[int, Failure] = {}
    missing = [i for i in range(len(dataset)) if i not in descriptions]
    if isinstance(descriptor, BodyDescriptor):
        results = _on_processes(dataset, descriptor, missing, n_workers)
    else:
        chunks = [missing[i : i + batch_size] for i in range(0, len(missing), batch_size)]
        results = _on_threads(dataset, descriptor, chunks, n_workers)
    n_known = len(descriptions)
    bar = Progress(desc="descriptions", total=len(dataset), initial=n_known, disable=not progress)
    with evaluation_mode(descriptor), bar, contextlib.closing(results):
        for indices, outcomes in results:
            bar.update(len(indices))
            for i, outcome in zip(indices, outcomes, strict=True):
                if not isinstance(outcome, Failure):
                    descriptions[i] = outcome
                    if cache is not None:
                        cache.write(i, outcome)
                elif failures is None:
                    raise MeshError(outcome.error)
                else:
                    failed[i] = outcome
    if failures is not None:
        failures += [failed[i] for i in sorted(failed)]
    if not descriptions:
        raise MeshError(failed[0].error)
    rows = np.stack([descriptions[i] for i in sorted(descriptions)])
    return torch.from_numpy(rows)


def _with_required(
    dataset: SignatureDataset, descriptor: nn.Module, n_workers: int | None
) -> SignatureDataset:
    """Return the dataset with plain numbers if the descriptor needs them; raise a ValueError if it lacks the rest."""
    if not isinstance(descriptor, Descriptor):
        return dataset
    descriptor.requirements.check_config(dataset.config)
    return dataset.measured(n_workers) if descriptor.requirements.measures else dataset


def fit_centres(descriptor: nn.Module, dataset: SignatureDataset) -> bool:
    """Fit the centres of quantile axes to the samples of a collection, and return whether anything was fitted.

    The descriptor `measures` is fitted to the spread of its columns. Axes that are fitted already stay unchanged. Each
    body contributes its first 500 interior samples. Raises a ValueError if a body does not have the attribute of an
    axis.
    """
    attribute_axes = [axis for axis in descriptor.modules() if isinstance(axis, Attribute)]
    axes = [axis for axis in attribute_axes if not axis.is_fitted]
    values: list[list[Singles]] = [[] for _ in axes]
    for signature in dataset.signatures() if axes else ():
        attributes = signature.interior.attributes
        check_attributes(descriptor, attributes)
        for axis, samples in zip(axes, values, strict=True):
            samples.append(attributes[axis.name][:500])
    for axis, samples in zip(axes, values, strict=True):
        axis.fit(torch.from_numpy(np.concatenate(samples)))
    is_fitted = False
    if isinstance(descriptor, Descriptor) and descriptor.requirements.measures:
        numbers = dataset.measured().measures()
        is_fitted = descriptor.fit_collection(numbers, dataset.units())
    return bool(axes) or is_fitted


def check_attributes(descriptor: nn.Module, names: Collection[str]) -> None:
    """Raise a ValueError if an axis needs an attribute that is not among the names."""
    for axis in descriptor.modules():
        if isinstance(axis, Attribute) and axis.name not in names:
            known = ", ".join((*get_args(AttributeName), *attribute_names()))
            raise ValueError(
                f"attributes: expected {axis.name!r} of each body, got {sorted(names)}. Give it as "
                f"--attribute {axis.name}=..., or as SignatureDataset(attributes=...). "
                f"Known without a file: {known}."
            )


def check_centres(descriptor: nn.Module) -> None:
    """Raise a ValueError if an axis has not been fitted by `fit_centres`."""
    for axis in descriptor.modules():
        if isinstance(axis, Attribute):
            axis.check_fitted()


@contextlib.contextmanager
def evaluation_mode(module: nn.Module) -> Iterator[None]:
    """Put a module and its submodules into evaluation mode, and restore the mode of each afterwards."""
    modes = [(submodule, submodule.training) for submodule in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for submodule, training in modes:
            submodule.training = training


def _on_threads(
    dataset: SignatureDataset,
    descriptor: nn.Module,
    chunks: Sequence[Sequence[int]],
    n_workers: int | None,
) -> _Outcomes:
    """Yield chunks of indices and the outcomes of their meshes, from several threads; on a GPU, from one."""
    tensors = [*descriptor.parameters(), *descriptor.buffers()]
    device = tensors[0].device if tensors else torch.device("cpu")

    def outcomes(indices: Sequence[int]) -> Sequence[Singles | Failure]:
        try:
            descriptions, _ = describe_timed((descriptor, dataset.subset(indices), device))
            return list(descriptions)
        except ValueError as error:
            if len(indices) == 1:
                return [Failure.of(dataset.bodies, indices[0], str(error))]
            return [outcome for i in indices for outcome in outcomes([i])]

    n_threads = (n_workers or n_cores()) if device.type == "cpu" else 1
    yield from zip(chunks, on_threads(outcomes, chunks, n_threads), strict=True)


def _on_processes(
    dataset: SignatureDataset, descriptor: nn.Module, indices: Sequence[int], n_workers: int | None
) -> _Outcomes:
    """Yield each index and its outcome; a process describes one mesh, so that a crash affects no other."""
    jobs = [(descriptor, dataset.subset([i]), torch.device("cpu")) for i in indices]
    for number, result in run(describe_timed, jobs, n_workers=n_workers):
        i = indices[number]
        if isinstance(result, Failed):
            yield [i], [Failure.of(dataset.bodies, i, result.reason)]
        else:
            descriptions, _ = result
            yield [i], list(descriptions)


def describe_timed(job: tuple[nn.Module, SignatureDataset, torch.device]) -> tuple[Singles, float]:
    """Describe all meshes of a dataset at once: return the descriptions (N, ...) and the processor time in seconds.

    The time includes reading the meshes, if the descriptor needs them, but not computing the Signatures.
    """
    descriptor, dataset, device = job
    with one_thread(), torch.inference_mode():  # both apply only to the current thread
        requirements = Requirements()
        if isinstance(descriptor, Descriptor):
            requirements = descriptor.requirements
        items = [replace(item, batched=requirements.samples) for item in dataset]
        batch = collate(items)
        start = time.process_time()
        if requirements.mesh:
            meshes = tuple(dataset.mesh(i) for i in range(len(dataset)))
            batch = replace(batch, meshes=meshes)
        values: Singles = descriptor(batch.to(device)).cpu().numpy()
        seconds = time.process_time() - start
    if not np.isfinite(values).all():
        raise MeshError(
            f"{dataset.bodies.paths[0]}: the description has entries that are not finite."
        )
    return values, seconds


class _DescriptionStore:
    """Access to the cached descriptions of a dataset; a cache that cannot be written only causes a warning."""

    def __init__(self, dataset: SignatureDataset, cache_tag: str) -> None:
        self._dataset = dataset
        self._tag = cache_tag
        self._keys = dataset.cached_keys()
        self._cache = dataset.pipeline.cache("description")
        self._is_writable = True

    def read(self) -> dict[int, Singles]:
        """Return the cached descriptions by the index of the mesh."""
        found = {}
        for i, key in enumerate(self._keys):
            if key is None:
                continue
            values = self._cache.get(self._key(key), lambda record: record.arrays["values"])
            if values is not None:
                found[i] = values
        return found

    def write(self, i: int, values: Singles) -> None:
        """Cache the description of mesh i, unless its file changed since the dataset was read."""
        key = self._keys[i]
        if key is None or not self._is_writable:
            return
        if self._dataset.subset([i]).cached_keys() != [key]:
            return
        try:
            self._cache.put(self._key(key), Record({"values": values}))
        except OSError as error:
            logger.warning("%s: descriptions are not cached (%s)", self._cache.directory, error)
            self._is_writable = False

    def _key(self, key: str) -> str:
        return derived_key("description", key, self._tag)

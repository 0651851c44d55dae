"""Descriptions of a whole dataset by a descriptor or its name."""

from pathlib import Path
from typing import Any

from torch import Tensor, nn

from igps.data.dataset import SignatureDataset
from igps.descriptors.registry import descriptor as descriptor_of
from igps.nn.description import describe as describe_by_module


def describe(
    dataset: SignatureDataset, descriptor: str | Path | nn.Module, **options: Any
) -> Tensor:
    """Describe the bodies of a dataset, in evaluation mode, without gradients.

    Example:
        >>> import tempfile, trimesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.icosphere(subdivisions=2).export(f"{folder}/ball.off")
        ...     dataset = SignatureDataset(folder, cache_dir=f"{folder}/cache")
        ...     histograms = describe(dataset, "interior")
        >>> tuple(histograms.shape)
        (1, 10, 64)

    Args:
        dataset: N bodies.
        descriptor: a name or file, see `igps.descriptor`; or any module from `SignatureBatch` to (N, ...).
        options: `failures`, `cache_tag`, `batch_size`, `n_workers` and `progress`, see `igps.nn.description.describe`.

    Returns:
        (N, ...) on the CPU.

    Raises:
        MeshError: a body cannot be described, and no list of `failures` is given.
        ValueError: the Signatures lack what the descriptor needs, or there is no body.
    """
    module = descriptor if isinstance(descriptor, nn.Module) else descriptor_of(descriptor)
    return describe_by_module(dataset, module, **options)

"""Datasets of generated shapes, for pretrain.py and calibrate.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

import igps
from igps.data.requirements import AnyDescriptor
from training.shapes import GradedShapes


def generated(
    shapes: GradedShapes,
    root: Path,
    descriptor: AnyDescriptor,
    cache_dir: Path | None = None,
    n_workers: int | None = None,
) -> igps.SignatureDataset:
    """Write generated shapes to a folder, unless they exist, and return their dataset; see `usable_shapes`."""
    try:
        shapes.write(root, progress=True, n_workers=n_workers)
    except ValueError as error:
        # No grid resolves the thin parts of a body; the other shapes were written.
        print(error)
    dataset = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=cache_dir)
    return usable_shapes(dataset, n_workers)


def usable_shapes(
    dataset: igps.SignatureDataset, n_workers: int | None = None
) -> igps.SignatureDataset:
    """Compute the signatures of a dataset, print failures, and return the dataset of the other meshes."""
    failures = dataset.precompute(n_workers=n_workers)
    for failure in failures:
        print(failure)
    return dataset.usable(failures)


def number_names(names: Sequence[str]) -> Tensor:
    """Number distinct names in sorted order; return the number (N,) of each name."""
    distinct = sorted(set(names))
    number = {name: i for i, name in enumerate(distinct)}
    return torch.tensor([number[name] for name in names])

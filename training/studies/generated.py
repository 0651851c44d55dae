"""Datasets of generated shapes, and their families."""

import random
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

import igps
from igps.nn.descriptor import Descriptor
from training.graded import GradedShapes

N_VERTICES = (2000, 3600)
"""Smallest and largest number of vertices of the generated individuals."""


def generated(
    shapes: GradedShapes,
    root: Path,
    descriptor: Descriptor,
    cache_dir: Path | None,
    n_workers: int | None,
) -> igps.SignatureDataset:
    """Write generated shapes to a folder, unless they exist, and return their dataset; see `usable_shapes`."""
    try:
        shapes.write(root, progress=True, n_workers=n_workers)
    except (
        ValueError
    ) as error:  # no grid resolves the thin parts of a body; the other shapes were written
        print(error)
    return usable_shapes(root, descriptor, cache_dir, n_workers)


def usable_shapes(
    root: Path,
    descriptor: Descriptor,
    cache_dir: Path | None,
    n_workers: int | None,
    names: list[str] | None = None,
) -> igps.SignatureDataset:
    """Return the dataset of the meshes (of `names`, if given) whose signatures can be computed; print failures."""
    data = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=cache_dir)
    if names is not None:
        data = data[names]
    failures = data.precompute(n_workers=n_workers)
    for failure in failures:
        print(failure)
    return data.usable(failures)


def deal_families(families: Iterable[str], n_parts: int, seed: int) -> dict[str, int]:
    """Deal families into parts at random; return the part of each family."""
    names = sorted(set(families))
    random.Random(seed).shuffle(names)
    return {name: place % n_parts for place, name in enumerate(names)}


def number_names(names: Sequence[str]) -> Tensor:
    """Number distinct names in sorted order; return the number (N,) of each name."""
    number = {name: i for i, name in enumerate(sorted(set(names)))}
    return torch.tensor([number[name] for name in names])

"""The level of individuals of the descriptor `pretrained`: its evaluation on held-out families, and its fit."""

import random
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

import igps
from igps.descriptors.pretrained.descriptor import pretrained_head
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, HistogramDescriptor
from igps.nn.heads.two_level import TwoLevelHead
from training.graded import GradedShapes, body_of, family_of, individual_of
from training.studies.transfer import level_scores

N_VERTICES = (2000, 3600)
"""Smallest and largest number of vertices of the generated individuals."""


def fit_individuals(
    head: TwoLevelHead,
    descriptor: HistogramDescriptor,
    counts: tuple[int, int, int, int],
    root: Path,
    n_parts: int,
    seed: int,
    plain: Sequence[str],
    cache_dir: Path | None,
    n_workers: int | None,
) -> TwoLevelHead:
    """Score a level of individuals on held-out families, fit it to all families, and return the head with it.

    Args:
        head: head with the levels of classes and bodies.
        descriptor: descriptor of the histograms.
        counts: numbers of classes, bodies of a class, individuals of a body, and poses of an individual.
        root: folder of the meshes.
        n_parts, seed, plain, cache_dir, n_workers: see `pretrain`.
    """
    n_classes, n_bodies, n_individuals, n_poses = counts
    shapes = GradedShapes(n_classes, n_bodies, n_poses, seed, n_vertices=N_VERTICES, n_individuals=n_individuals)
    data = generated(shapes, root, descriptor, cache_dir, n_workers)
    histograms = describe(data, descriptor, progress=True, n_workers=n_workers)
    individuals, bodies = (number_names([of(name) for name in data.bodies.names]) for of in (individual_of, body_of))

    def fitted(chosen: Tensor) -> TwoLevelHead:
        complete_head = pretrained_head()
        complete_head.load_state_dict({**complete_head.state_dict(), **head.state_dict()})
        return complete_head.fit_individuals(histograms[chosen], individuals[chosen], descriptor.part_cells)

    families = [family_of(name) for name in data.classes]
    parts = [torch.isin(data.labels, part) for part in deal_families(families, n_parts, seed)]

    def score(name: str, distances: Sequence[Tensor]) -> None:
        """Print the scores of the distances of each part."""
        levels = [(individuals[part], bodies[part], data.labels[part]) for part in parts]
        level_scores(name, [(matrix, *labels) for matrix, labels in zip(distances, levels, strict=True)])

    print(f"{n_parts} parts of the families, each scored by a level of individuals that was fitted to the others:")
    for name, heads in (("pretrained", [fitted(~part) for part in parts]), ("two levels", [head] * n_parts)):
        vectors = [fitted_head(histograms[part]) for fitted_head, part in zip(heads, parts, strict=True)]
        score(name, [fitted_head.distances(x, x) for fitted_head, x in zip(heads, vectors, strict=True)])
    for name in plain:
        other = igps.descriptor(name)
        described = describe(usable_shapes(root, other, cache_dir, n_workers), other, n_workers=n_workers)
        if len(described) == len(data):
            score(name, [other.distances(described[part], described[part]) for part in parts])
    return fitted(torch.ones(len(data), dtype=torch.bool))


def generated(
    shapes: GradedShapes, root: Path, descriptor: Descriptor, cache_dir: Path | None, n_workers: int | None
) -> igps.SignatureDataset:
    """Write generated shapes to a folder, unless they exist, and return their dataset; see `usable_shapes`."""
    try:
        shapes.write(root, progress=True, n_workers=n_workers)
    except ValueError as error:  # no grid resolves the thin parts of a body; the other shapes were written
        print(error)
    return usable_shapes(root, descriptor, cache_dir, n_workers)


def usable_shapes(
    root: Path, descriptor: Descriptor, cache_dir: Path | None, n_workers: int | None, indices: list[int] | None = None
) -> igps.SignatureDataset:
    """Return the dataset of the meshes (of `indices`, if given) whose signatures can be computed; print failures."""
    data = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=cache_dir)
    if indices is not None:
        data = data.subset(indices)
    failures = data.precompute(n_workers=n_workers)
    for failure in failures:
        print(failure)
    return data.usable(failures)


def deal_families(families: Sequence[str], n_parts: int, seed: int) -> list[Tensor]:
    """Deal whole families into parts at random; return the indices of the classes of each part."""
    names = sorted(set(families))
    random.Random(seed).shuffle(names)
    return [
        torch.tensor([i for i, family in enumerate(families) if family in names[k::n_parts]]) for k in range(n_parts)
    ]


def number_names(names: Sequence[str]) -> Tensor:
    """Number distinct names in sorted order; return the number of each name."""
    number = {name: i for i, name in enumerate(sorted(set(names)))}
    return torch.tensor([number[name] for name in names])

"""Measure the scale of a descriptor, for its distance with size: the median distance between bodies of one class.

    python -m training.scales interior rich
    python -m training.scales interior rich --n_individuals 3

The first command prints the median over generated bodies of the same class, the second over individuals of the same
body.
"""

from __future__ import annotations

import torch
from jsonargparse import auto_cli

import igps
from igps.cli import errors_as_messages
from igps.data.requirements import Requirements
from training.shapes import GradedShapes

N_CLASSES = 8
N_BODIES = 4
SEED = 77
N_VERTICES = (1800, 2600)


def scales(descriptors: list[str], n_individuals: int = 0) -> None:
    """Print the scales of descriptors.

    Args:
        descriptors: names of descriptors.
        n_individuals: number of individuals of each body; if positive, distances are measured between individuals of
            the same body.
    """
    shapes = GradedShapes(
        N_CLASSES, N_BODIES, 1, SEED, n_vertices=N_VERTICES, n_individuals=n_individuals
    )
    modules = [igps.descriptor(name) for name in descriptors]
    required = Requirements(n_eigenpairs=250)
    for module in modules:
        required |= module.requirements
    config = required.apply_to(igps.SignatureConfig())
    groups = []
    batches = []
    for number in range(len(shapes)):
        shape = shapes[number]
        groups.append(shape.body if n_individuals else shape.label)
        mesh = igps.Mesh(shape.vertices, shape.faces)
        batches.append(igps.collate([igps.compute_signature(mesh, config)], [mesh]))
    is_same = torch.tensor([[first == second for first in groups] for second in groups]).triu(1)
    for module in modules:
        with torch.inference_mode():
            descriptions = torch.cat([module(batch) for batch in batches])
            distances = module.distances(descriptions, descriptions)
        print(f'    "{module.name}": {float(distances[is_same].median()):.2g},', flush=True)


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(scales)

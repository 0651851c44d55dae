"""Scales of descriptors: the median distance between generated bodies of the same class."""

from functools import reduce
from operator import or_

import torch

from igps.data.collation import collate
from igps.descriptors import NAMES
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig, compute_signature
from training.graded import GradedShapes


def scales(
    descriptors: list[str] | None = None,
    n_classes: int = 8,
    n_bodies: int = 4,
    seed: int = 77,
    n_individuals: int = 0,
) -> None:
    """Print the scales of descriptors, for `igps.descriptors.size_and_side.SCALES`.

    Args:
        descriptors: names of descriptors; all of the library if not given.
        n_classes: number of classes of generated bodies.
        n_bodies: number of bodies of each class, in one pose.
        seed: seed of the bodies.
        n_individuals: number of individuals of each body; if positive, distances are measured between individuals of
            the same body.
    """
    generated = GradedShapes(
        n_classes, n_bodies, 1, seed=seed, n_vertices=(1800, 2600), n_individuals=n_individuals
    )
    shapes = [generated[i] for i in range(len(generated))]
    labels = [shape.body if n_individuals else shape.label for shape in shapes]
    same = torch.tensor([[first == second for first in labels] for second in labels]).triu(1)
    modules = [descriptor_of(name) for name in descriptors or NAMES]
    config = reduce(or_, (module.requirements for module in modules)).apply_to(
        SignatureConfig(n_eigenpairs=250)
    )
    meshes = [Mesh(shape.vertices, shape.faces) for shape in shapes]
    batches = [collate([compute_signature(mesh, config)], [mesh]) for mesh in meshes]
    for module in modules:
        with torch.inference_mode():
            descriptions = torch.cat([module(batch) for batch in batches])
            median = module.distances(descriptions, descriptions)[same].median()
        print(f'    "{module.name}": {float(median):.2g},', flush=True)

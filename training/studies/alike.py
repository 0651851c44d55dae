"""How often descriptors find the same individual among many that are nearly alike, like the bones of two sides."""

from collections.abc import Sequence
from pathlib import Path

import igps
from igps.nn.description import describe
from igps.retrieval import retrieval_scores
from training.graded import GradedShapes, body_of, individual_of
from training.studies.generated import N_VERTICES, generated, number_names

_ASYMMETRY = (
    0.003,
    0.012,
)  # displacements between the two sides of an individual, in units of √area


def alike(
    root: Path = Path("build/alike"),
    descriptors: Sequence[str] = ("pretrained", "shape_dna"),
    n_bodies: int = 16,
    n_individuals: int = 14,
    seed: int = 7,
    cache_dir: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Print the percentage of shapes whose nearest shape, among all individuals of a body, is the same individual.

    Each individual occurs twice, with two sides that differ by 0.3 to 1.2 % of √area, first rigid, then in poses.

    Args:
        root: folder of the generated meshes.
        descriptors: names of descriptors.
        n_bodies: number of bodies, each of another class.
        n_individuals: number of individuals of each body.
        seed: seed of the shapes.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        n_workers: processes; all cores if not given.
    """
    for folder, rigid in (("rigid", True), ("posed", False)):
        shapes = GradedShapes(
            n_bodies,
            1,
            2,
            seed,
            n_vertices=N_VERTICES,
            n_individuals=n_individuals,
            asymmetry=_ASYMMETRY,
            rigid=rigid,
        )
        for name in descriptors:
            descriptor = igps.descriptor(name)
            data = generated(shapes, root / folder, descriptor, cache_dir, n_workers)
            bodies, individuals = (
                number_names([of(x) for x in data.bodies.names]) for of in (body_of, individual_of)
            )
            descriptions = describe(data, descriptor, n_workers=n_workers)
            distances = descriptor.distances(descriptions, descriptions)
            distances[bodies[:, None] != bodies] = float("inf")
            nearest = retrieval_scores(distances, individuals).mean()["nn"]
            print(f"{folder} {name}: {100 * nearest:.1f} % of {len(data)}", flush=True)

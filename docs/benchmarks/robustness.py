"""How far descriptions move when a mesh is disturbed, or when a body takes another pose: the table of robustness.md.

python -m docs.benchmarks.robustness MESHES ROOT --poses POSES
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import or_
from pathlib import Path

import numpy as np
import torch
from docs.benchmarks.weld import weld_gap
from jsonargparse import auto_cli
from tqdm import tqdm
from training.disturbances import clip, hole, move, noise, remesh, scale, simplified
from training.generated import usable_shapes

import igps
from igps._arrays import Floats
from igps._parallel import run
from igps._threads import one_thread
from igps.cli import errors_as_messages
from igps.failures import Failed
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor

DESCRIPTORS = (
    "interior",
    "gps",
    "multiscale",
    "rich",
    "pretrained",
    "d2",
    "shape_dna",
    "canonical_form",
)


@dataclass(frozen=True)
class Disturbance:
    """A change of the mesh that should change a description little."""

    description: str  # kind and strength of the change
    apply: Callable[[igps.Mesh], igps.Mesh]


DISTURBANCES: Mapping[str, Disturbance] = {
    "noise": Disturbance(
        "vertices moved along their normals, standard deviation 0.5 % of the diagonal", noise
    ),
    "half": Disturbance("simplified to 50 % of the vertices", partial(simplified, share=0.5)),
    "tenth": Disturbance("simplified to 10 % of the vertices", partial(simplified, share=0.1)),
    "remesh": Disturbance(
        "each face cut into four, then the shortest edges collapsed to the old number", remesh
    ),
    "weld": Disturbance("two places that face each other joined by a triangular tube", weld_gap),
    "hole": Disturbance("a patch of 1 % of the area removed", hole),
    "limb": Disturbance("the farthest 10 % of the extent cut off and capped, by manifold3d", clip),
    "scale": Disturbance("scaled by 7", partial(scale, factor=7.0)),
    "motion": Disturbance("a random rotation, and a move by twice the diagonal", move),
}
"""The disturbances by name."""

Answer = torch.Tensor | str
"""The description (1, ...) of a body, or the reason why there is none."""


def robustness(
    meshes: list[Path],
    gallery: Path,
    poses: Path | None = None,
    descriptors: Sequence[str] = DESCRIPTORS,
    cache_dir: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Print how far the descriptions of meshes move, in percent of the median distance between classes.

    A movement is the distance between the descriptions of a mesh before and after a disturbance.

    Args:
        meshes: the mesh files to disturb.
        gallery: labelled folder by which the distance between classes is measured.
        poses: folder with meshes of one body in several poses.
        descriptors: names of descriptors.
        cache_dir: folder of cached signatures; by default the user's cache directory.
        n_workers: processes; by default all cores.
    """
    chosen = [igps.descriptor(name) for name in descriptors]
    answers = describe_disturbed(meshes, chosen, n_workers)
    columns = [*DISTURBANCES, "pose"] if poses else [*DISTURBANCES]
    width = max(len(name) for name in descriptors)
    print(" " * width + "".join(f"{column:>9}" for column in columns))
    notes = []
    for descriptor in chosen:
        name = descriptor.name
        unit = median_between_classes(gallery, descriptor, cache_dir, n_workers)
        rows = [answer[name] for answer in answers]
        means = []
        for column in DISTURBANCES:
            lengths, missing = movements(descriptor, rows, column)
            means.append(np.mean(lengths) / unit if lengths else np.nan)
            if missing:
                notes.append(f"{name}, {column}: {len(missing)} missing; {missing[0]}")
        if poses is not None:
            matrix, _ = all_distances(poses, descriptor, cache_dir, n_workers)
            means.append(matrix[np.triu_indices(len(matrix), 1)].mean() / unit)
        print(f"{name:<{width}}" + "".join(f"{100 * value:>9.1f}" for value in means), flush=True)
    print("mean movement in percent of the median distance between classes")
    for column, disturbance in DISTURBANCES.items():
        print(f"  {column}: {disturbance.description}")
    print("\n".join(notes))


def describe_disturbed(
    meshes: Sequence[Path], descriptors: Sequence[Descriptor], n_workers: int | None = None
) -> list[dict[str, dict[str, Answer]]]:
    """Describe each mesh as it is and after each disturbance.

    Returns:
        For each mesh, by the name of the descriptor and then by disturbance, its description or the reason why there is
        none. The mesh as it is has the name "".
    """
    columns = ["", *DISTURBANCES]
    jobs = [(mesh, column, descriptors) for mesh in meshes for column in columns]
    answers: list[dict[str, dict[str, Answer]]] = [
        {descriptor.name: {} for descriptor in descriptors} for _ in meshes
    ]
    outcomes = run(describe_one, jobs, n_workers=n_workers)
    with tqdm(total=len(jobs), desc="disturbed meshes") as bar, contextlib.closing(outcomes):
        for number, outcome in outcomes:
            bar.update()
            row = answers[number // len(columns)]
            column = jobs[number][1]
            for name, of_columns in row.items():
                of_columns[column] = (
                    outcome.reason if isinstance(outcome, Failed) else outcome[name]
                )
    return answers


def describe_one(job: tuple[Path, str, Sequence[Descriptor]]) -> dict[str, Answer]:
    """Describe a mesh after a disturbance by each descriptor."""
    path, column, descriptors = job
    requirements = reduce(or_, [descriptor.requirements for descriptor in descriptors])
    config = requirements.apply_to(igps.SignatureConfig())
    mesh = igps.load_mesh(path)
    if column:
        mesh = DISTURBANCES[column].apply(mesh)
    batch = igps.collate([igps.compute_signature(mesh, config)], [mesh])
    answers: dict[str, Answer] = {}
    for descriptor in descriptors:
        try:
            with one_thread(), torch.inference_mode():
                description = descriptor(batch)
        except Exception as error:  # one descriptor must not stop the others
            answers[descriptor.name] = str(error)
            continue
        is_finite = bool(torch.isfinite(description).all())
        answers[descriptor.name] = description if is_finite else "the description is not finite."
    return answers


def movements(
    descriptor: Descriptor, answers: Sequence[Mapping[str, Answer]], column: str
) -> tuple[list[float], list[str]]:
    """Return the distances between meshes before and after a disturbance, and why others are missing."""
    lengths = []
    missing = []
    for answer in answers:
        before = answer[""]
        after = answer[column]
        if isinstance(before, str):
            missing.append(before)
        elif isinstance(after, str):
            missing.append(after)
        else:
            with torch.inference_mode():
                lengths.append(float(descriptor.distances(before, after)))
    return lengths, missing


def median_between_classes(
    gallery: Path, descriptor: Descriptor, cache_dir: Path | None, n_workers: int | None
) -> float:
    """Return the median distance between meshes of different classes."""
    distances, labels = all_distances(gallery, descriptor, cache_dir, n_workers)
    differs = labels[:, None] != labels
    if not differs.any():
        raise ValueError(f"gallery: expected two classes in {gallery}, got one. Take another.")
    return float(np.median(distances[differs]))


def all_distances(
    root: Path, descriptor: Descriptor, cache_dir: Path | None, n_workers: int | None
) -> tuple[Floats, Floats]:
    """Return the distances (N, N) between the meshes of a folder, and their labels (N,); 0 without classes."""
    dataset = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=cache_dir)
    dataset = usable_shapes(dataset, n_workers)
    described = describe(dataset, descriptor, n_workers=n_workers)
    labels = dataset.labels.numpy() if dataset.bodies.labels else np.zeros(len(dataset))
    with torch.inference_mode():
        return descriptor.distances(described, described).double().numpy(), labels


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(robustness)

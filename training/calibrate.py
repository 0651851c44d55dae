"""Measure what the distances of `pretrained` mean, on generated bodies that it was not fitted to.

    python -m training.calibrate --config configs/calibrate.yaml

makes the calibration that the package ships: the distances between copies of a body (remeshed, simplified to half,
scaled, mirrored and moved, in another file format, and all of these at once), between poses of a body, between bodies
of a class and between classes, and the thresholds up to which two files are the same. Copies lengthened by 2 % of √area
count as different, so that the thresholds separate parts of slightly different lengths. The seed of the bodies differs
from that of pretrain.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jsonargparse import auto_cli
from numpy.typing import ArrayLike

import igps
from igps._arrays import Booleans, Floats
from igps._parallel import on_threads
from igps.cli import errors_as_messages
from igps.descriptors.fingerprint import fingerprint
from igps.descriptors.pretrained.descriptor import PRETRAINED, pretrained
from igps.duplicates.calibration import (
    CALIBRATION,
    FINEST,
    KINDS,
    LEVELS,
    Calibration,
    Threshold,
    calibration_params,
)
from igps.duplicates.compared_surfaces import Surfaces, distance_if_alike
from igps.mesh.mesh import Mesh
from igps.nn.description import describe
from training.disturbances import move, remesh, scale, simplified
from training.generated import generated
from training.shapes import GradedShapes, body_of

N_BODIES = 4  # of a class
N_POSES = 4  # of a body
LONGER = "longer"  # the alteration that makes another body

SUFFIXES = {
    "triangles": ".off",
    "half": ".off",
    "motion": ".ply",
    "format": ".stl",
    "all": ".obj",
    LONGER: ".off",
}
"""Suffixes of the files by alteration."""

LENGTHENED = 0.02
"""Length by which bodies are lengthened, as a share of √area."""


@dataclass(frozen=True)
class Settings:
    """The values of configs/calibrate.yaml.

    Args:
        root: folder of the generated meshes.
        copies: folder of their copies; existing files are kept.
        n_classes, seed: arguments of `GradedShapes`, with four bodies of a class and four poses of a body.
        n_copied: bodies of each class to copy.
        rate: largest rate of false pairs among poses of bending bodies and bodies of one class.
        model: file with the parameters of `pretrained`.
        out: file of the calibration.
        cache_dir: folder of cached signatures; by default the user's cache directory.
        n_workers: processes; by default all cores.
    """

    root: Path
    copies: Path
    n_classes: int
    seed: int
    n_copied: int
    rate: float
    model: Path = PRETRAINED
    out: Path = CALIBRATION
    cache_dir: Path | None = None
    n_workers: int | None = None


@dataclass(frozen=True)
class Copy:
    """A copy of a generated shape."""

    original: int  # index of the shape
    alteration: str
    path: Path


def calibrate(settings: Settings) -> None:
    """Make copies, measure all pairs, save the calibration, and print it."""
    n_workers = settings.n_workers
    descriptor = pretrained(settings.model)
    in_poses = GradedShapes(settings.n_classes, N_BODIES, N_POSES, settings.seed)
    shapes = generated(in_poses, settings.root, descriptor, settings.cache_dir, n_workers)
    copies, copied = make_copies(shapes, settings)
    originals = [copy.original for copy in copies]
    is_copy = np.array([copy.alteration != LONGER for copy in copies])

    described = describe(shapes, descriptor, n_workers=n_workers)
    of_copies = describe(copied, descriptor, n_workers=n_workers)
    with torch.inference_mode():
        distances = descriptor.distances(described, described).numpy()
        to_all_copies = descriptor.distances(described[originals], of_copies).diagonal()
    to_copies = to_all_copies.numpy()[is_copy]

    bodies = np.array([body_of(name) for name in shapes.bodies.names])
    classes = np.array(shapes.bodies.labels)
    is_rigid = np.isin(classes, rigid_classes(in_poses))
    i, j = np.triu_indices(len(shapes), 1)
    distances = distances[i, j]
    of_body = bodies[i] == bodies[j]
    of_class = classes[i] == classes[j]
    rigid_poses = of_body & is_rigid[i]
    bent_poses = of_body & ~is_rigid[i]
    other_bodies = of_class & ~of_body
    by_kind = {
        "copies": np.concatenate([to_copies, distances[rigid_poses]]),
        "poses": distances[bent_poses],
        "bodies": distances[other_bodies],
        "classes": distances[~of_class],
    }

    surfaces = MeasuredSurfaces(shapes, n_workers)
    surfaces_of_copies = MeasuredSurfaces(copied, n_workers)

    def between_shapes(chosen: Booleans) -> list[Pair]:
        return [(surfaces, i[k], surfaces, j[k]) for k in np.flatnonzero(chosen)]

    def to_their_copies(chosen: Booleans) -> list[Pair]:
        numbers = np.flatnonzero(chosen).tolist()
        return [(surfaces, originals[n], surfaces_of_copies, n) for n in numbers]

    # The rate of false pairs is that of the hard ones: other poses of bending bodies, and other bodies of the class.
    same = surface_distances(to_their_copies(is_copy) + between_shapes(rigid_poses), n_workers)
    others = surface_distances(between_shapes(bent_poses | other_bodies), n_workers)
    longer = surface_distances(to_their_copies(~is_copy), n_workers)
    different = np.concatenate([others, longer])
    made_of = (
        f"{len(set(classes))} classes of GradedShapes({settings.n_classes}, seed={settings.seed}), "
        f"{len(set(bodies))} bodies, {len(shapes)} poses, {is_copy.sum()} copies, "
        f"{len(longer)} that are longer"
    )
    calibration = Calibration(
        descriptor="pretrained",
        model=fingerprint(descriptor),
        signatures=calibration_params(shapes.config),
        made_of=made_of,
        distances={kind: quantiles(by_kind[kind]) for kind in KINDS},
        n_pairs={kind: len(by_kind[kind]) for kind in KINDS},
        same=threshold_between(same[:, 0], different[:, 0], settings.rate),
        detail=threshold_at(same[:, 1], different[:, 1], settings.rate),
    )
    calibration.save(settings.out)
    print(made_of)
    for kind in KINDS:
        median = np.median(by_kind[kind])
        print(f"{kind}: {len(by_kind[kind])} pairs, median distance {median:.4f}")
    for name, measured in (("same", same), ("others", others), ("longer", longer)):
        largest = measured.max(axis=0)
        smallest = measured.min(axis=0)
        print(
            f"{name}: {len(measured)} pairs, surfaces {smallest[0]:.4g} to {largest[0]:.4g} of √area, "
            f"{smallest[1]:.4g} to {largest[1]:.4g} times coarseness"
        )
    for name in ("same", "detail"):
        print(f"{name}: {getattr(calibration, name)}")


def rigid_classes(shapes: GradedShapes) -> list[str]:
    """Return the classes whose bodies do not bend: the first pose of the first body is its shape at rest."""
    rigid = []
    for number, name in enumerate(shapes.class_names):
        pose = shapes.pose(number * shapes.n_bodies * shapes.n_poses)
        moved = np.abs(pose.bent - pose.rest).max()
        if moved < 1e-6 * np.ptp(pose.rest, axis=0).max():
            rigid.append(name)
    return rigid


def make_copies(
    shapes: igps.SignatureDataset, settings: Settings
) -> tuple[list[Copy], igps.SignatureDataset]:
    """Copy the first pose of bodies: by all alterations at once, by one of them, and lengthened.

    Returns:
        The copies whose signatures can be computed, and their dataset.
    """
    first: dict[str, int] = {}
    for i, name in enumerate(shapes.bodies.names):
        first.setdefault(body_of(name), i)
    chosen = [body for body in sorted(first) if int(body.rsplit("/", 1)[1]) < settings.n_copied]
    copies = []
    for number, body in enumerate(chosen):
        for alteration in ("all", tuple(SUFFIXES)[number % 4], LONGER):
            name = body.replace("/", "-") + SUFFIXES[alteration]
            path = settings.copies / alteration / name
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                mesh = altered(shapes.mesh(first[body]), alteration, settings.seed + number)
                trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
            copies.append(Copy(first[body], alteration, path))
    paths = [copy.path for copy in copies]
    dataset = igps.SignatureDataset(paths, shapes.config, settings.cache_dir)
    failures = dataset.precompute(n_workers=settings.n_workers)
    for failure in failures:
        print(failure.error)
    failed = {failure.path for failure in failures}
    return [copy for copy in copies if copy.path not in failed], dataset.usable(failures)


def altered(mesh: Mesh, alteration: str, seed: int) -> Mesh:
    """Return a mesh after one of the alterations of `SUFFIXES`."""
    if alteration == LONGER:
        mesh = lengthened(mesh, seed)
    if alteration in ("triangles", "all", LONGER):
        mesh = remesh(mesh)
    if alteration in ("half", "all"):
        mesh = simplified(mesh, 0.5)
    if alteration in ("motion", "all"):
        mirrored = replace(
            mesh, vertices=mesh.vertices * [-1.0, 1.0, 1.0], faces=mesh.faces[:, ::-1]
        )
        factor = math.exp(np.random.default_rng(seed).uniform(-3, 3))
        mesh = move(scale(mirrored, factor), seed)
    return mesh


def lengthened(mesh: Mesh, seed: int) -> Mesh:
    """Move the part beyond a random plane away from it; triangles that the plane cuts are stretched."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    height = mesh.vertices @ normal
    beyond = height > np.quantile(height, random.uniform(0.3, 0.7))
    step = LENGTHENED * math.sqrt(mesh.area)
    return replace(mesh, vertices=mesh.vertices + np.outer(beyond * step, normal))


class MeasuredSurfaces:
    """Samples and coarseness of the surfaces of a dataset, computed once."""

    def __init__(self, dataset: igps.SignatureDataset, n_workers: int | None) -> None:
        surfaces = Surfaces(dataset)
        numbers = range(len(dataset))
        self.samples = [surfaces.samples(k) for k in numbers]
        self.coarseness = list(on_threads(surfaces.coarseness, numbers, n_workers))


Pair = tuple[MeasuredSurfaces, int, MeasuredSurfaces, int]


def surface_distances(pairs: list[Pair], n_workers: int | None) -> Floats:
    """Return distances between the surfaces of pairs, and the same over the larger coarseness, (N, 2)."""

    def measure(pair: Pair) -> tuple[float, float]:
        first, i, second, j = pair
        distance = distance_if_alike(first.samples[i], second.samples[j])
        return distance, distance / max(first.coarseness[i], second.coarseness[j], FINEST)

    return np.array(list(on_threads(measure, pairs, n_workers)))


def quantiles(distances: ArrayLike) -> list[float]:
    """Return the quantiles of distances at `LEVELS`, with five digits."""
    values = np.quantile(np.asarray(distances, dtype=np.float64), LEVELS)
    return [float(f"{value:.5g}") for value in values]


def threshold_between(same: ArrayLike, other: ArrayLike, rate: float) -> Threshold:
    """Return the threshold between distances of same pairs and of other pairs.

    If the distances do not overlap, the threshold is the geometric mean of the largest distance of same pairs and the
    smallest of other pairs. Otherwise it is as large as the rate of false pairs allows.
    """
    largest = float(np.max(same))
    rejected = smallest_rejected(other, rate)
    if largest < rejected:
        return counted(math.sqrt(largest * rejected), same, other)
    return threshold_at(same, other, rate)


def threshold_at(same: ArrayLike, other: ArrayLike, rate: float) -> Threshold:
    """Return the largest threshold that the rate of false pairs allows."""
    return counted(math.nextafter(smallest_rejected(other, rate), 0), same, other)


def smallest_rejected(other: ArrayLike, rate: float) -> float:
    """Return the smallest distance of other pairs that is not among the allowed false ones."""
    ascending = np.sort(np.asarray(other, dtype=np.float64))
    return float(ascending[int(rate * len(ascending))])


def counted(distance: float, same: ArrayLike, other: ArrayLike) -> Threshold:
    """Return a threshold with the counts of pairs within its distance."""
    same = np.asarray(same)
    other = np.asarray(other)
    n_false = int((other <= distance).sum())
    n_found = int((same <= distance).sum())
    return Threshold(distance, len(other), n_false, len(same), n_found)


if __name__ == "__main__":
    with errors_as_messages():
        calibrate(auto_cli(Settings, as_positional=False))

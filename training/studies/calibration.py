"""Calibrate the distances of `pretrained` on generated bodies to which it was not fitted."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh

import igps
from igps._arrays import Booleans, Floats
from igps._parallel import on_threads
from igps.descriptors.fingerprint import fingerprint
from igps.descriptors.pretrained.descriptor import PRETRAINED, pretrained
from igps.duplicates.calibration import (
    CALIBRATION,
    FINEST,
    KINDS,
    Calibration,
    calibration_params,
)
from igps.duplicates.surfaces import Surfaces, distance_if_alike
from igps.mesh.mesh import Mesh
from igps.nn.description import describe
from training.graded import GradedShapes, body_of
from training.studies.disturbances import move, remesh, scale, simplified
from training.studies.generated import generated
from training.studies.thresholds import quantiles, threshold_at, threshold_between

SUFFIXES = {
    "triangles": ".off",
    "half": ".off",
    "motion": ".ply",
    "format": ".stl",
    "all": ".obj",
    "longer": ".off",
}
"""Suffixes of the files by alteration. Lengthened bodies are not copies."""

LENGTHENED = 0.02
"""Length by which bodies are lengthened, as a share of √area."""


def calibrate(
    root: Path = Path("build/calibration"),
    copies: Path = Path("build/copies"),
    n_classes: int = 40,
    seed: int = 1,
    n_copied: int = 2,
    rate: float = 0.001,
    pose_rate: float = 0.01,
    model: Path = PRETRAINED,
    out: Path = CALIBRATION,
    cache_dir: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Make copies, measure all pairs, save the calibration, and print it.

    Args:
        root: folder of the generated meshes.
        copies: folder of their copies; existing files are kept.
        n_classes, seed: arguments of `GradedShapes`, with four bodies of a class and four poses of a body.
        n_copied: bodies of each class to copy.
        rate: largest rate of false pairs among poses of bending bodies and bodies of one class.
        pose_rate: largest rate of false pairs among bodies of one class if poses count as the same.
        model: file with the parameters of `pretrained`.
        out: file of the calibration.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        n_workers: processes; all cores if not given.
    """
    descriptor = pretrained(model)
    bodies_in_poses = GradedShapes(n_classes, 4, 4, seed)
    shapes = generated(bodies_in_poses, root, descriptor, cache_dir, n_workers)
    bodies = np.array([body_of(name) for name in shapes.bodies.names])
    classes = np.array(shapes.bodies.labels)
    is_rigid = np.isin(classes, _rigid_classes(bodies_in_poses))

    made = _copies(shapes, copies, n_copied, seed)
    copied = igps.SignatureDataset([path for _, _, path in made], shapes.config, cache_dir)
    failures = copied.precompute(n_workers=n_workers)
    for failure in failures:
        print(failure.error)
    failed = {failure.path for failure in failures}
    made = [copy for copy in made if copy[2] not in failed]
    copied, originals = copied.usable(failures), [i for i, _, _ in made]
    alterations = [alteration for _, alteration, _ in made]
    is_copy = np.array([x != "longer" for x in alterations])

    described, of_copies = (
        describe(data, descriptor, n_workers=n_workers) for data in (shapes, copied)
    )
    with torch.inference_mode():
        distances = descriptor.distances(described, described).numpy()
        to_copies = (
            descriptor.distances(described[originals], of_copies).diagonal().numpy()[is_copy]
        )
    i, j = np.triu_indices(len(shapes), 1)
    distances = distances[i, j]
    of_body, of_class = bodies[i] == bodies[j], classes[i] == classes[j]
    rigid_poses = of_body & is_rigid[i]
    of_kind = {"poses": of_body & ~is_rigid[i], "bodies": of_class & ~of_body, "classes": ~of_class}
    by_kind = {"copies": np.concatenate([to_copies, distances[rigid_poses]])}
    by_kind |= {kind: distances[pairs] for kind, pairs in of_kind.items()}
    near = 2 * float(by_kind["copies"].max())

    surfaces, surfaces_of_copies = (_Measured(data, n_workers) for data in (shapes, copied))

    def pairs_of_shapes(chosen: Booleans) -> list[_Pair]:
        return [(surfaces, i[k], surfaces, j[k]) for k in np.flatnonzero(chosen)]

    def pairs_with_copies(chosen: Booleans) -> list[_Pair]:
        return [
            (surfaces, originals[n], surfaces_of_copies, n) for n in np.flatnonzero(chosen).tolist()
        ]

    # The rate of false pairs is that of the hard ones: other poses of bending bodies, and other bodies of the class
    same = pairs_with_copies(is_copy) + pairs_of_shapes(rigid_poses)
    others = pairs_of_shapes(of_kind["poses"] | of_kind["bodies"])
    longer = pairs_with_copies(~is_copy)
    of_same, of_others, of_longer = (
        _surface_distances(pairs, n_workers) for pairs in (same, others, longer)
    )
    of_different = np.concatenate([of_others, of_longer])

    calibration = Calibration(
        "pretrained",
        fingerprint(descriptor),
        calibration_params(shapes.config),
        f"{len(set(classes))} classes of GradedShapes({n_classes}, seed={seed}), {len(set(bodies))} bodies, "
        f"{len(shapes)} poses, {is_copy.sum()} copies, {len(of_longer)} that are longer",
        {kind: quantiles(by_kind[kind]) for kind in KINDS},
        {kind: len(by_kind[kind]) for kind in KINDS},
        near,
        threshold_between(of_same[:, 0], of_different[:, 0], rate),
        threshold_at(of_same[:, 1], of_different[:, 1], rate),
        threshold_between(
            np.concatenate([by_kind["copies"], by_kind["poses"]]), by_kind["bodies"], pose_rate
        ),
    )
    calibration.save(out)
    _print(
        calibration,
        of_same,
        of_others,
        of_longer,
        [x for x in alterations if x != "longer"],
        to_copies,
    )


def _rigid_classes(shapes: GradedShapes) -> list[str]:
    """Return the classes whose bodies do not bend: the first pose of the first body is its shape at rest."""
    rigid = []
    for number, name in enumerate(shapes.class_names):
        pose = shapes.pose(number * shapes.n_bodies * shapes.n_poses)
        if np.abs(pose.bent - pose.rest).max() < 1e-6 * np.ptp(pose.rest, axis=0).max():
            rigid.append(name)
    return rigid


def _copies(
    shapes: igps.SignatureDataset, folder: Path, n_bodies: int, seed: int
) -> list[tuple[int, str, Path]]:
    """Copy the first pose of bodies: by all alterations at once, by one of them, and lengthened.

    Returns:
        The index of the shape, the alteration and the file of each copy.
    """
    first: dict[str, int] = {}
    for i, name in enumerate(shapes.bodies.names):
        first.setdefault(body_of(name), i)
    chosen = [
        (body, i) for body, i in sorted(first.items()) if int(body.rsplit("/", 1)[1]) < n_bodies
    ]
    made = []
    for number, (body, i) in enumerate(chosen):
        for alteration in ("all", tuple(SUFFIXES)[number % 4], "longer"):
            path = folder / alteration / f"{body.replace('/', '-')}{SUFFIXES[alteration]}"
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                copy = _copy(shapes.mesh(i), alteration, seed + number)
                trimesh.Trimesh(copy.vertices, copy.faces, process=False).export(path)
            made.append((i, alteration, path))
    return made


def _copy(mesh: Mesh, alteration: str, seed: int) -> Mesh:
    if alteration == "longer":
        mesh = _lengthened(mesh, seed)
    if alteration in ("triangles", "all", "longer"):
        mesh = remesh(mesh)
    if alteration in ("half", "all"):
        mesh = simplified(mesh, 0.5)
    if alteration in ("motion", "all"):
        mirrored = replace(
            mesh, vertices=mesh.vertices * [-1.0, 1.0, 1.0], faces=mesh.faces[:, ::-1]
        )
        mesh = move(scale(mirrored, math.exp(np.random.default_rng(seed).uniform(-3, 3))), seed)
    return mesh


def _lengthened(mesh: Mesh, seed: int) -> Mesh:
    """Move the part beyond a random plane away from it; triangles that the plane cuts are stretched."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    height = mesh.vertices @ normal
    beyond = height > np.quantile(height, random.uniform(0.3, 0.7))
    return replace(
        mesh, vertices=mesh.vertices + np.outer(beyond * LENGTHENED * math.sqrt(mesh.area), normal)
    )


class _Measured:
    """Samples and coarseness of surfaces, computed once."""

    def __init__(self, dataset: igps.SignatureDataset, n_workers: int | None) -> None:
        surfaces = Surfaces(dataset)
        self.samples = [surfaces.samples(k) for k in range(len(dataset))]
        self.coarseness = list(on_threads(surfaces.coarseness, range(len(dataset)), n_workers))


_Pair = tuple[_Measured, int, _Measured, int]


def _surface_distances(pairs: list[_Pair], n_workers: int | None) -> Floats:
    """Return distances between the surfaces of pairs, and the same over the larger coarseness, (N, 2)."""

    def measure(pair: _Pair) -> tuple[float, float]:
        first, i, second, j = pair
        distance = distance_if_alike(first.samples[i], second.samples[j])
        return distance, distance / max(first.coarseness[i], second.coarseness[j], FINEST)

    return np.array(list(on_threads(measure, pairs, n_workers)))


def _print(
    calibration: Calibration,
    same: Floats,
    others: Floats,
    longer: Floats,
    alterations: list[str],
    to_copies: Floats,
) -> None:
    print(calibration.made_of)
    for alteration in SUFFIXES:
        rows = np.array(
            [k for k, name in enumerate(alterations) if name == alteration], dtype=np.int64
        )
        if len(rows):
            surfaces, detail = same[rows].max(axis=0)
            nearest = f"distance ≤ {to_copies[rows].max():.4f}"
            finest = f"surfaces ≤ {surfaces:.2%}, {detail:.1f} times coarseness"
            print(f"{alteration:>10}: {len(rows)} copies, {nearest}, {finest}")
    rigid = same[len(alterations) :]
    for name, distances in (
        ("poses of rigid bodies", rigid),
        ("others", others),
        ("longer", longer),
    ):
        for column, unit in enumerate(("of √area", "times coarseness")):
            levels = 0, 0.001, 0.01, 0.1, 0.5, 0.99, 1
            row = ", ".join(
                f"{x:.4g}" for x in np.quantile(distances[:, column], levels, method="higher")
            )
            print(
                f"{name}: {len(distances)}, {unit}: smallest, 0.1 %, 1 %, 10 %, 50 %, 99 %, largest: {row}"
            )
    for kind in KINDS:
        print(
            f"{kind:>10}: {calibration.n_pairs[kind]} pairs, median {calibration.distances[kind][11]:.4f}"
        )
    print(
        f"near {calibration.near:.4f}\nsame {calibration.same}\ndetail {calibration.detail}\npose {calibration.pose}"
    )

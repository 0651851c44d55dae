"""Measure what the distances of `pretrained` mean, on generated bodies that it was not fitted to.

    python training/calibrate.py

makes the calibration that the package ships: how far apart copies of a body are (other triangles, half of them, scaled,
mirrored and turned, another file format, and all of that), poses of a body, bodies of a class, and classes; and from
which distance on two files are not the same. The bodies are those of another seed than pretrain.py's.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jsonargparse import auto_cli
from numpy.typing import NDArray

import igps
from igps.descriptors.pretrained import PRETRAINED, pretrained
from igps.gallery.calibration import CALIBRATION, KINDS, Calibration, quantiles, threshold_between, told_of
from igps.gallery.duplicates import Surfaces, distance_if_alike
from igps.gallery.gallery import fingerprint
from igps.geometry.alignment import SurfaceSamples
from igps.geometry.disturbances import move, remesh, scale, simplified
from igps.geometry.mesh import Mesh
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor
from igps.parallel import on_threads
from igps.shapes import GradedShapes, body_of

SUFFIXES = {"triangles": ".off", "half": ".off", "motion": ".ply", "format": ".stl", "all": ".obj"}


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
        copies: folder of the copies that are made of them; those that are there stay.
        n_classes, seed: of `GradedShapes`, four bodies of a class and four poses of a body.
        n_copied: bodies of each class to copy.
        rate: of false pairs among poses of bending bodies and bodies of one class, at most.
        pose_rate: of false pairs among bodies of one class where poses are the same, at most.
        model: the parameters of `pretrained`.
        out: the calibration.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        n_workers: processes; all cores if not given.
    """
    descriptor = pretrained(model)
    shapes = _generated(root, descriptor, n_classes, seed, cache_dir, n_workers)
    bodies = np.array([body_of(name) for name in shapes.files.names])
    classes = np.array(shapes.files.labels)
    is_rigid = np.isin(classes, _still(GradedShapes(n_classes, 4, 4, seed)))

    made = _copies(shapes, copies, n_copied, seed)
    copied = igps.SignatureDataset([path for _, _, path in made], shapes.config, cache_dir)
    failures = copied.precompute(n_workers=n_workers)
    for failure in failures:
        print(failure.error)
    failed = {failure.path for failure in failures}
    made = [one for one in made if one[2] not in failed]
    copied, originals = copied.usable(failures), [i for i, _, _ in made]

    described, of_copies = (describe(one, descriptor, n_workers=n_workers) for one in (shapes, copied))
    with torch.inference_mode():
        distances = descriptor.distances(described, described).numpy()
        to_copies = descriptor.distances(described[originals], of_copies).diagonal().numpy()
    i, j = np.triu_indices(len(shapes), 1)
    distances = distances[i, j]
    of_body, of_class = bodies[i] == bodies[j], classes[i] == classes[j]
    rigid_poses = of_body & is_rigid[i]
    of_kind = {"poses": of_body & ~is_rigid[i], "bodies": of_class & ~of_body, "classes": ~of_class}
    by_kind = {"copies": np.concatenate([to_copies, distances[rigid_poses]])}
    by_kind |= {kind: distances[pairs] for kind, pairs in of_kind.items()}
    near = 2 * float(by_kind["copies"].max())

    surfaces, surfaces_of_copies = Surfaces(shapes), Surfaces(copied)
    samples = [surfaces.samples(k) for k in range(len(shapes))]
    same = [(samples[k], surfaces_of_copies.samples(n)) for n, k in enumerate(originals)]
    same += [(samples[a], samples[b]) for a, b in zip(i[rigid_poses], j[rigid_poses], strict=True)]
    # The hard ones tell the rate: other poses of bodies that bend, and other bodies of the class.
    others = np.flatnonzero(of_kind["poses"] | of_kind["bodies"])
    of_same = np.array(list(on_threads(_apart, same, n_workers)))
    of_others = np.array(list(on_threads(_apart, [(samples[i[k]], samples[j[k]]) for k in others], n_workers)))

    calibration = Calibration(
        "pretrained",
        fingerprint(descriptor),
        told_of(shapes.config),
        f"{len(set(classes))} classes of GradedShapes({n_classes}, seed={seed}), {len(set(bodies))} bodies, "
        f"{len(shapes)} poses, {len(copied)} copies",
        {kind: quantiles(by_kind[kind]) for kind in KINDS},
        {kind: len(by_kind[kind]) for kind in KINDS},
        near,
        threshold_between(of_same, of_others, rate),
        threshold_between(np.concatenate([by_kind["copies"], by_kind["poses"]]), by_kind["bodies"], pose_rate),
    )
    calibration.save(out)
    _print(calibration, of_same, of_others, made, to_copies)


def _still(shapes: GradedShapes) -> list[str]:
    """The classes whose bodies do not bend: in the first pose of the first nothing has moved."""
    found = []
    for number, name in enumerate(shapes.class_names):
        pose = shapes.pose(number * shapes.n_bodies * shapes.n_poses)
        if np.abs(pose.bent - pose.rest).max() < 1e-6 * np.ptp(pose.rest, axis=0).max():
            found.append(name)
    return found


def _generated(
    root: Path, descriptor: Descriptor, n_classes: int, seed: int, cache_dir: Path | None, n_workers: int | None
) -> igps.SignatureDataset:
    """The shapes, those that are not there yet written first."""
    try:
        GradedShapes(n_classes, 4, 4, seed).write(root, progress=True, n_workers=n_workers)
    except ValueError as error:  # a body whose thin parts no grid resolves: the others are there
        print(error)
    shapes = igps.SignatureDataset(root, descriptor.needs.completed(igps.SignatureConfig()), cache_dir)
    return shapes.usable(shapes.precompute(n_workers=n_workers))


def _copies(shapes: igps.SignatureDataset, folder: Path, n_bodies: int, seed: int) -> list[tuple[int, str, Path]]:
    """Of the first pose of bodies, one copy by all ways at once and one by one of them: which shape, way and file."""
    first: dict[str, int] = {}
    for i, name in enumerate(shapes.files.names):
        first.setdefault(body_of(name), i)
    chosen = [(body, i) for body, i in sorted(first.items()) if int(body.rsplit("/", 1)[1]) < n_bodies]
    made = []
    for number, (body, i) in enumerate(chosen):
        for way in ("all", tuple(SUFFIXES)[number % 4]):
            path = folder / way / f"{body.replace('/', '-')}{SUFFIXES[way]}"
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                copy = _copy(shapes.mesh(i), way, seed + number)
                trimesh.Trimesh(copy.vertices, copy.faces, process=False).export(path)
            made.append((i, way, path))
    return made


def _copy(mesh: Mesh, way: str, seed: int) -> Mesh:
    if way in ("triangles", "all"):
        mesh = remesh(mesh)
    if way in ("half", "all"):
        mesh = simplified(mesh, 0.5)
    if way in ("motion", "all"):
        mirrored = replace(mesh, vertices=mesh.vertices * [-1.0, 1.0, 1.0], faces=mesh.faces[:, ::-1])
        mesh = move(scale(mirrored, math.exp(np.random.default_rng(seed).uniform(-3, 3))), seed)
    return mesh


def _apart(pair: tuple[SurfaceSamples, SurfaceSamples]) -> float:
    return distance_if_alike(*pair)


def _print(
    calibration: Calibration,
    same: NDArray[np.float64],
    others: NDArray[np.float64],
    made: list[tuple[int, str, Path]],
    to_copies: NDArray[np.float64],
) -> None:
    print(calibration.made_of)
    for way in SUFFIXES:
        rows = np.array([k for k, (_, of, _) in enumerate(made) if of == way], dtype=np.int64)
        if len(rows):
            largest = f"distance ≤ {to_copies[rows].max():.4f}, surfaces ≤ {same[rows].max():.2%}"
            print(f"{way:>10}: {len(rows)} copies, {largest}")
    rigid = same[len(made) :]
    print(
        f"poses of rigid bodies: {len(rigid)}, surfaces 99 % ≤ {np.quantile(rigid, 0.99):.2%}, all ≤ {rigid.max():.2%}"
    )
    print(f"others: {len(others)}, the nearest surfaces {', '.join(f'{one:.2%}' for one in np.sort(others)[:8])}")
    for kind in KINDS:
        print(f"{kind:>10}: {calibration.n_pairs[kind]} pairs, median {calibration.distances[kind][11]:.4f}")
    print(f"near {calibration.near:.4f}\nsame {calibration.same}\npose {calibration.pose}")


if __name__ == "__main__":
    auto_cli(calibrate)

"""Errors of surfaces of voxelised solids in volume, area and description.

Balls, ellipsoids, tori, capsules, rods and plates are rotated and moved at random and sampled at the centres of voxels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from operator import or_

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation
from scipy.special import elliprg

from igps import Mesh, SignatureConfig, collate, compute_signature
from igps._arrays import Booleans, Floats
from igps.data.requirements import Requirements
from igps.descriptors import descriptor
from igps.fields.volumes.label_surface import voxel_surface

KINDS = ("ball", "ellipsoid", "torus", "capsule", "rod", "plate")
AXES = np.array([1, 1.3, 2])  # of an ellipsoid
SIDES = np.array([3, 4, 1])  # of a plate
RING = 2.5  # of a torus, over the radius of its tube


@dataclass(frozen=True)
class Solid:
    """A solid around the origin, in closed form."""

    holds: Callable[[Floats], Booleans]  # whether points (..., 3) lie inside
    half: Floats  # (3,) half the sides of its box
    volume: float
    area: float
    genus: int = 0


def solid(kind: str, thickness: float) -> Solid:
    """Return a solid of a kind by its least thickness; rods are four times as long as thick, capsules three times."""
    r = thickness / 2
    if kind in ("ball", "ellipsoid"):
        axes = r * (AXES if kind == "ellipsoid" else np.ones(3))
        a, b, c = axes
        area = 4 * np.pi * float(elliprg((a * b) ** 2, (a * c) ** 2, (b * c) ** 2))
        return Solid(
            lambda p: np.asarray(((p / axes) ** 2).sum(-1) < 1),
            axes,
            4 / 3 * np.pi * axes.prod(),
            area,
        )
    if kind == "torus":
        ring = RING * r
        return Solid(
            lambda p: (np.hypot(p[..., 0], p[..., 1]) - ring) ** 2 + p[..., 2] ** 2 < r**2,
            np.array([ring + r, ring + r, r]),
            2 * np.pi**2 * ring * r**2,
            4 * np.pi**2 * ring * r,
            1,
        )
    if kind == "capsule":
        return Solid(
            lambda p: (
                np.hypot(p[..., 0], p[..., 1]) ** 2 + np.maximum(abs(p[..., 2]) - 2 * r, 0) ** 2
                < r**2
            ),
            np.array([r, r, 3 * r]),
            (4 + 4 / 3) * np.pi * r**3,
            (8 + 4) * np.pi * r**2,
        )
    if kind == "rod":
        return Solid(
            lambda p: (np.hypot(p[..., 0], p[..., 1]) < r) & (abs(p[..., 2]) < 4 * r),
            np.array([r, r, 4 * r]),
            8 * np.pi * r**3,
            18 * np.pi * r**2,
        )
    half = r * SIDES
    a, b, c = half
    return Solid(
        lambda p: np.asarray((abs(p) < half).all(-1)),
        half,
        8 * a * b * c,
        8 * (a * b + b * c + a * c),
    )


def exact_mesh(kind: str, thickness: float) -> Mesh:
    """Return the surface of a solid as a few thousand triangles."""
    r = thickness / 2
    if kind == "torus":
        surface = trimesh.creation.torus(RING * r, r, major_sections=120, minor_sections=40)
    elif kind == "plate":
        surface = trimesh.creation.box(2 * r * SIDES)
        for _ in range(4):
            surface = surface.subdivide()
    elif kind in ("capsule", "rod"):
        angle = np.linspace(0, np.pi / 2, 16)
        end = r * np.stack([np.sin(angle), 2 + np.cos(angle)], 1)
        if kind == "rod":
            end = np.concatenate([np.stack([np.linspace(0, r, 12), np.full(12, 4 * r)], 1)])
        side = np.stack([np.full(58, r), np.linspace(end[-1, 1], -end[-1, 1], 60)[1:-1]], 1)
        surface = trimesh.creation.revolve(
            np.concatenate([end, side, end[::-1] * [1, -1]]), sections=48
        )
    else:
        surface = trimesh.creation.icosphere(subdivisions=4)
        surface.vertices *= r * (AXES if kind == "ellipsoid" else np.ones(3))
    return Mesh(np.asarray(surface.vertices), np.asarray(surface.faces), name=kind)


def voxels(body: Solid, matrix: Floats, rng: np.random.Generator) -> tuple[Booleans, Floats]:
    """Sample a randomly rotated and moved solid at the centres of voxels; return (X, Y, Z) and the affine (4, 4)."""
    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    size = np.linalg.norm(body.half)
    reach = np.ceil(np.linalg.norm(np.linalg.inv(matrix), axis=1) * size).astype(int) + 1
    index = np.stack(np.meshgrid(*(np.arange(2 * n + 1) for n in reach), indexing="ij"), axis=-1)
    affine = np.eye(4)
    affine[:3, :3] = matrix
    affine[:3, 3] = -matrix @ (reach + rng.uniform(-0.5, 0.5, 3))
    mask = body.holds((index @ matrix.T + affine[:3, 3]) @ turn)
    affine[:3, 3] += (100, -50, 20)
    return mask, affine


@dataclass(frozen=True)
class Measured:
    """Errors of the surface of a voxelised solid."""

    kind: str
    n_voxels: int  # thickness in the longest side of the voxels
    length: float  # longest side of the voxels
    volume: float  # relative error, signed
    area: float  # relative error, signed
    distances: dict[
        str, float
    ]  # to the description of the exact mesh, over the median distance between two kinds


def measure(
    n_voxels: Sequence[int] = (16,),
    lengths: Sequence[float] = (1, 3, 6),
    descriptors: Sequence[str] = (),
    n_turns: int = 1,
    seed: int = 0,
) -> list[Measured]:
    """Make the surfaces of all kinds of solids and compare them with the solids.

    Args:
        n_voxels: thicknesses, in the longest side of the voxels.
        lengths: longest sides of the voxels; the others are 1.
        descriptors: names of the descriptors of the surfaces.
        n_turns: number of random rotations and positions of each solid.
        seed: seed of rotations and positions.
    """
    modules = {name: descriptor(name) for name in descriptors}
    config = reduce(or_, (x.requirements for x in modules.values()), Requirements()).apply_to(
        SignatureConfig()
    )

    def described(mesh: Mesh) -> dict[str, torch.Tensor]:
        batch = collate([compute_signature(mesh, config)])
        with torch.inference_mode():
            return {name: module(batch) for name, module in modules.items()}

    exact = {kind: described(exact_mesh(kind, 1.0)) for kind in KINDS} if modules else {}
    between = {
        name: float(
            np.median(
                [
                    float(module.distances(exact[a][name], exact[b][name]))
                    for a, b in combinations(KINDS, 2)
                ]
            )
        )
        for name, module in modules.items()
    }
    rng, results = np.random.default_rng(seed), []
    for kind in KINDS:
        for size in n_voxels:
            for length in lengths:
                for _ in range(n_turns):
                    body = solid(kind, size * length)
                    mask, affine = voxels(
                        body, np.diag(rng.permutation([1, 1, length])).astype(float), rng
                    )
                    mesh = Mesh(*voxel_surface(mask, affine)[:2], name=kind)
                    descriptions = described(mesh) if modules else {}
                    distances = {
                        name: float(module.distances(descriptions[name], exact[kind][name]))
                        / between[name]
                        for name, module in modules.items()
                    }
                    volume, area = mesh.volume / body.volume - 1, mesh.area / body.area - 1
                    results.append(Measured(kind, size, length, volume, area, distances))
    return results


def surfaces(n_turns: int = 1, descriptors: list[str] | None = None) -> None:
    """Print the median errors of surfaces of voxelised solids by kind, in percent.

    Args:
        n_turns: number of random rotations and positions of each solid.
        descriptors: names of the descriptors of solids 16 voxels thick; pretrained and interior if not given.
    """
    names = ["pretrained", "interior"] if descriptors is None else descriptors
    for n_voxels in ((4,), (8, 12), (16,)):
        results = measure(n_voxels, descriptors=names if n_voxels == (16,) else (), n_turns=n_turns)
        sizes = " and ".join(map(str, n_voxels))
        for kind in (*KINDS, "all"):
            rows = [row for row in results if kind in (row.kind, "all")]
            columns = [
                f"{name} {100 * np.median([abs(getattr(row, name)) for row in rows]):.2f}"
                for name in ("volume", "area")
            ]
            columns += [
                f"{name} {100 * np.median([row.distances[name] for row in rows]):.1f}"
                for name in rows[0].distances
            ]
            print(f"{sizes} voxels, {kind}: {', '.join(columns)}", flush=True)

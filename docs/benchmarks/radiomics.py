"""Plain numbers beside those of PyRadiomics: on masks of bodies with closed forms, and on given masks.

`python -m docs.benchmarks.radiomics FOLDER` prints the tables of docs/benchmarks/radiomics.md; FOLDER holds masks as
NIfTI, one body in each. PyRadiomics must be installed.
"""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import SimpleITK
from radiomics.shape import RadiomicsShape

from igps.fields.volumes.label_volume import LabelVolume, label_surface, read_label_volume
from igps.mesh.errors import MeshError
from igps.signature.measures import measures

# Our name of each feature of PyRadiomics
NAMES = {
    "VoxelVolume": "voxel_volume",
    "MeshVolume": "volume",
    "SurfaceArea": "area",
    "SurfaceVolumeRatio": "surface_volume_ratio",
    "Sphericity": "sphericity",
    "MajorAxisLength": "major_axis_length",
    "MinorAxisLength": "minor_axis_length",
    "LeastAxisLength": "least_axis_length",
    "Elongation": "elongation",
    "Flatness": "flatness",
    "Maximum3DDiameter": "largest_diameter",
}
SPACINGS = ((1, 1, 1), (1, 1, 3))
N_PLACES = 3
RADII = (4, 8)

Numbers = dict[str, float]
Inside = Callable[[np.ndarray], np.ndarray]


def of_axes(volume: float, area: float, diameter: float, variances: list[float]) -> Numbers:
    """Return all numbers of a body from its volume, area, diameter, and variances along its axes, descending."""
    major, minor, least = 4 * np.sqrt(variances)
    return {
        "voxel_volume": volume,
        "volume": volume,
        "area": area,
        "surface_volume_ratio": area / volume,
        "sphericity": (36 * math.pi * volume**2) ** (1 / 3) / area,
        "major_axis_length": major,
        "minor_axis_length": minor,
        "least_axis_length": least,
        "elongation": minor / major,
        "flatness": least / major,
        "largest_diameter": diameter,
    }


def ball(r: float) -> tuple[Inside, Numbers, float]:
    numbers = of_axes(4 / 3 * math.pi * r**3, 4 * math.pi * r**2, 2 * r, [r**2 / 5] * 3)
    return lambda p: (p**2).sum(axis=-1) < r**2, numbers, r


def ellipsoid(r: float) -> tuple[Inside, Numbers, float]:
    """Twice as long as wide; the area of a prolate body of revolution."""
    e = math.sqrt(3) / 2
    area = 2 * math.pi * r**2 * (1 + 2 / e * math.asin(e))
    variances = [4 * r**2 / 5, r**2 / 5, r**2 / 5]
    numbers = of_axes(8 / 3 * math.pi * r**3, area, 4 * r, variances)
    return lambda p: ((p / [r, r, 2 * r]) ** 2).sum(axis=-1) < 1, numbers, 2 * r


def rod(r: float) -> tuple[Inside, Numbers, float]:
    """A cylinder of length 6 r between two halves of a ball."""
    cylinder = 6 * math.pi * r**3
    ends = 4 / 3 * math.pi * r**3
    along = cylinder * 3 * r**2 + ends * (9 + 2 * 3 * 3 / 8 + 1 / 5) * r**2
    across = cylinder * r**2 / 4 + ends * r**2 / 5
    volume = cylinder + ends
    variances = [along / volume, across / volume, across / volume]
    numbers = of_axes(volume, 12 * math.pi * r**2 + 4 * math.pi * r**2, 8 * r, variances)

    def inside(p: np.ndarray) -> np.ndarray:
        beyond = np.maximum(np.abs(p[..., 2]) - 3 * r, 0)
        return p[..., 0] ** 2 + p[..., 1] ** 2 + beyond**2 < r**2

    return inside, numbers, 4 * r


def torus(r: float) -> tuple[Inside, Numbers, float]:
    """Of radii 3 r and r."""
    wide = 9 * r**2 / 2 + 3 / 8 * r**2
    variances = [wide, wide, r**2 / 4]
    numbers = of_axes(6 * math.pi**2 * r**3, 12 * math.pi**2 * r**2, 8 * r, variances)

    def inside(p: np.ndarray) -> np.ndarray:
        return (np.hypot(p[..., 0], p[..., 1]) - 3 * r) ** 2 + p[..., 2] ** 2 < r**2

    return inside, numbers, 4 * r


def mask_of(inside: Inside, reach: float, spacing: np.ndarray, seed: int) -> np.ndarray:
    """Return the voxels (X, Y, Z) whose centres lie in a body that is turned and moved at random."""
    generator = np.random.default_rng(seed)
    rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    sides = [np.arange(-n, n + 1) for n in np.ceil(reach / spacing).astype(int) + 2]
    index = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1) + generator.random(3)
    return inside((index * spacing) @ rotation)


def ours(mask: np.ndarray, affine: np.ndarray) -> Numbers:
    return measures(label_surface(LabelVolume((mask.astype(np.uint8),), affine), 1))


def theirs(mask: np.ndarray, affine: np.ndarray) -> Numbers:
    image = SimpleITK.GetImageFromArray(np.pad(mask, 1).astype(np.uint8).T)
    image.SetSpacing(np.linalg.norm(affine[:3, :3], axis=0).tolist())
    found = RadiomicsShape(image, image, label=1).execute()
    return {own: float(found[name]) for name, own in NAMES.items()}


def closed_forms() -> Iterator[tuple[str, Numbers, Numbers, Numbers]]:
    """Yield the kind of each mask, the closed form, and both results."""
    for spacing in SPACINGS:
        for body in (ball, ellipsoid, rod, torus):
            for radius in RADII:
                inside, expected, reach = body(radius)
                for seed in range(N_PLACES):
                    mask = mask_of(inside, reach, np.array(spacing), seed)
                    affine = np.diag([*map(float, spacing), 1.0])
                    kind = f"{':'.join(map(str, spacing))}, {2 * radius} across"
                    yield kind, expected, ours(mask, affine), theirs(mask, affine)


def print_closed_forms() -> None:
    """Print the error of each number: its root mean square over all bodies and places, for each kind of mask."""
    errors: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for kind, expected, own, other in closed_forms():
        for name in NAMES.values():
            pair = (own[name] / expected[name] - 1, other[name] / expected[name] - 1)
            errors.setdefault(name, {}).setdefault(kind, []).append(pair)
    kinds = list(next(iter(errors.values())))
    print("| number | " + " | ".join(kinds) + " |")
    print("|---" * (1 + len(kinds)) + "|")
    for name, by_kind in errors.items():
        cells = [np.sqrt(np.square(by_kind[kind]).mean(axis=0)) for kind in kinds]
        shown = [f"{100 * own:.1f} / {100 * other:.1f}" for own, other in cells]
        print(f"| `{name}` | " + " | ".join(shown) + " |")


def print_masks(folder: Path) -> None:
    """Print the quantiles of ours over theirs, on all masks of a folder that are bodies."""
    ratios: dict[str, list[float]] = {name: [] for name in NAMES.values()}
    for path in sorted(folder.rglob("*.nii.gz")):
        try:
            volume = read_label_volume(path)
            own = measures(label_surface(volume, volume.bodies[0].label))
        except MeshError:
            continue
        other = theirs(volume.mask(volume.bodies[0].label), volume.affine)
        for name, values in ratios.items():
            values.append(own[name] / other[name] - 1)
    print(f"\n{len(values)} masks\n\n| number | 5 % | median | 95 % |\n|---|---|---|---|")
    for name, values in ratios.items():
        low, middle, high = 100 * np.quantile(values, [0.05, 0.5, 0.95])
        print(f"| `{name}` | {low:+.1f} | {middle:+.1f} | {high:+.1f} |")


if __name__ == "__main__":
    logging.getLogger("radiomics").setLevel(logging.ERROR)
    print_closed_forms()
    print_masks(Path(sys.argv[1]))

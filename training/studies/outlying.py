"""Detection of damaged segmentations: outlier scores of masks, and of the same masks after damages."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igps._arrays import Booleans, Floats
from igps.analysis.groups import squared_distances
from igps.analysis.outliers import Outlier, measure_bodies, outliers
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor as descriptor_of
from igps.nn.description import describe
from igps.report.answers import write_analysis
from training.studies.mask_damages import DAMAGES, VARIED, damaged, varied

_MIN_VOXELS = 50


def outlying(
    volumes: Path | None = None,
    out: Path = Path("build/outlying"),
    cache_dir: Path | None = None,
    seed: int = 0,
    vary: bool = False,
) -> None:
    """Score masks before and after one damage each, and print the area under the ROC curve that separates them.

    Args:
        volumes: folder with organs/*.nii.gz and prostate/*.nii.gz; generated bodies if not given.
        out: folder for the masks, outlying.csv and outlying.json.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        seed: seed of the damages and of the generated bodies.
        vary: use other kinds of damages, with random sizes, places and directions, see `varied`.
    """
    masks = generated(seed) if volumes is None else _read_masks(volumes)
    names = sorted(masks)
    labels = [name.split("/")[0] for name in names]
    random = np.random.default_rng(seed)
    kinds, damage_of = (VARIED, varied) if vary else (DAMAGES, damaged)
    damages = [kinds[i % len(kinds)] for i in random.permutation(len(names))]
    paths = [_write(out / f"{i}_given.nii.gz", *masks[name]) for i, name in enumerate(names)]
    for i, (name, damage) in enumerate(zip(names, damages, strict=True)):
        mask, spacing = masks[name]
        others = np.zeros_like(mask)
        for other, (near, _) in masks.items():
            if other != name and near.shape == mask.shape:
                others |= near
        paths.append(
            _write(out / f"{i}_damaged.nii.gz", *damage_of(mask, spacing, damage, random, others))
        )
    chosen = descriptor_of("pretrained")
    all_masks = SignatureDataset(paths, descriptor=chosen, cache_dir=cache_dir, labels=2 * labels)
    failures = all_masks.precompute()
    failed = {failure.id for failure in failures}
    dataset = all_masks.usable(failures)
    usable = [
        path for path, name in zip(paths, all_masks.bodies.names, strict=True) if name not in failed
    ]
    index = {path: i for i, path in enumerate(usable)}
    described = describe(dataset, chosen, progress=True)
    distances = squared_distances(chosen.coordinates(described).double().numpy()) ** 0.5
    measures, notes = measure_bodies(dataset), dataset.all_notes()

    def scored(chosen_paths: Sequence[Path], classes: Sequence[str]) -> list[Outlier]:
        rows = [index[path] for path in chosen_paths]
        own = {name: values[np.ix_(*values.ndim * [rows])] for name, values in measures.items()}
        ranked = outliers(distances[np.ix_(rows, rows)], classes, own, [notes[row] for row in rows])
        return sorted(ranked, key=lambda outlier: outlier.body)

    undamaged = [i for i in range(len(names)) if paths[i] in index]
    files, classes = [paths[i] for i in undamaged], [labels[i] for i in undamaged]
    rows = [
        {"mask": names[i], "damage": "none", "score": outlier.score, "reason": outlier.reason}
        for i, outlier in zip(undamaged, scored(files, classes), strict=True)
    ]
    for n, i in enumerate(undamaged):
        path = paths[len(names) + i]
        if path not in index:
            rows.append(
                {
                    "mask": names[i],
                    "damage": damages[i],
                    "score": 99.0,
                    "reason": "refused by the reader",
                }
            )
            continue
        label = classes[n]
        if damages[i] == "label":
            label = str(
                random.choice(
                    [x for x in sorted(set(classes)) if x != label and classes.count(x) > 1]
                )
            )
        outlier = scored(
            [*files[:n], path, *files[n + 1 :]], [*classes[:n], label, *classes[n + 1 :]]
        )[n]
        rows.append(
            {
                "mask": names[i],
                "damage": damages[i],
                "score": outlier.score,
                "reason": outlier.reason,
            }
        )
    write_analysis(out, "outlying", rows)
    print(json.dumps(areas(rows), indent=2))


def areas(rows: Sequence[dict[str, object]]) -> dict[str, float]:
    """Return the area under the ROC curve of undamaged masks against all damages, and against each damage."""
    from sklearn.metrics import roc_auc_score

    result = {}
    for damage in ("all", *sorted({str(row["damage"]) for row in rows} - {"none"})):
        own = [row for row in rows if damage == "all" or row["damage"] in ("none", damage)]
        result[damage] = float(
            roc_auc_score([row["damage"] != "none" for row in own], [row["score"] for row in own])
        )
    return result


def _write(path: Path, mask: Booleans, spacing: Floats) -> Path:
    import nibabel

    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(mask.astype(np.uint8), np.diag([*spacing, 1.0])), path)
    return path


def _read_masks(volumes: Path) -> dict[str, tuple[Booleans, Floats]]:
    """Read the masks of at least 50 voxels, by class and name; classes are names without side and number."""
    import nibabel

    masks = {}
    for path in sorted(volumes.glob("*/*.nii.gz")):
        image: Any = nibabel.load(path)
        mask = np.asarray(image.dataobj) > 0
        if mask.sum() < _MIN_VOXELS:
            continue
        name = path.name.removesuffix(".nii.gz")
        kind = re.sub(r"_(left|right)|_?[CTL]?\d+$", "", name)
        masks[f"{kind}/{name}"] = (
            mask.squeeze(),
            np.array(image.header.get_zooms()[:3], dtype=float),
        )
    return masks


def generated(seed: int = 0) -> dict[str, tuple[Booleans, Floats]]:
    """Generate the bodies of one subject in a common grid, and one body of many subjects in separate grids.

    The bodies of the subject are single ones, pairs of sides, a series of thin arcs, and a series of blocks with a ring
    and a spine. They touch but do not overlap, and the border of the grid cuts some of them. The separate grids have
    thick slices.
    """
    random = np.random.default_rng(seed + 100)
    spacing, room = np.full(3, 3.0), np.array([110, 90, 110]) * 3.0
    masks = dict[str, tuple[Booleans, Floats]]()
    taken = np.zeros((110, 90, 110), dtype=bool)
    drawn: list[tuple[str, Floats, Floats]] = []
    for level in range(6):
        angle, wide, long = np.linspace(0.2, 2.6 + 0.1 * level, 60), 60 + 8 * level, 50 + 4 * level
        arc = [wide * np.sin(angle), long * np.cos(angle) + 120, 290 - 22 * level - 14 * angle]
        for sign in (-1, 1):
            own = _jittered(np.stack(arc, axis=1) * [sign, 1, 1] + [165, 0, 0], random)
            drawn.append((f"arc/arc{level}{sign}", own, np.full(60, 5.0)))
    for level in range(7):
        ring, size = np.linspace(0, 2 * np.pi, 40), 1 + 0.05 * level
        points = [np.linspace([0, 0, -4], [0, 0, 4], 8) * size]
        points += [np.stack([14 * np.cos(ring), 22 + 13 * np.sin(ring), 0 * ring], axis=1) * size]
        points += [np.linspace([0, 36, 0], [0, 55, -14], 14) * size]
        radii = np.repeat([13.0, 4.5, 4.5], [8, 40, 14]) * size
        own = _jittered(np.vstack(points), random) + np.array([165, 110, 270 - 36 * level])
        drawn.append((f"block/block{level}", own, radii))
    for number in range(25):
        curve, radii = _curve(random)
        if number < 12:
            middle = random.uniform([20, 40, 20], [130, 230, 310])
            for name, sign in (("left", 1), ("right", -1)):
                own = _jittered(curve * random.normal(1, 0.03, 3), random) + middle
                own = own if sign == 1 else own * [-1, 1, 1] + [room[0], 0, 0]
                drawn.append((f"pair{number}/{name}", own, radii * random.normal(1, 0.05)))
        else:
            drawn.append(
                (f"single{number}/single", curve + random.uniform(0.15, 0.85, 3) * room, radii)
            )
    for name, curve, radii in drawn:
        mask = _tube(curve, radii, spacing, random, ~taken)
        taken |= mask
        if mask.sum() >= _MIN_VOXELS:
            masks[name] = (mask, spacing)
    curve, radii = _curve(random)
    curve, radii = curve * 0.3, np.full(len(radii), 16.0)
    for number in range(16):
        own = _jittered(curve * random.normal(1, 0.2, 3), random) + 36
        flat = np.array([1.2, 1.2, 4.0])
        free = np.ones((60, 60, 18), dtype=bool)
        masks[f"many/many{number}"] = (
            _tube(own, radii * random.normal(1, 0.12), flat, random, free),
            flat,
        )
    return masks


def _curve(random: np.random.Generator) -> tuple[Floats, Floats]:
    """Draw a smooth curve of random length around the origin, and the radii of balls along it."""
    t, size = np.linspace(0, 1, 60), np.exp(random.uniform(np.log(25), np.log(170)))
    waves = sum(
        random.normal(0, 0.5 / k**2, (3, 1)) * np.cos(np.pi * k * t + random.uniform(0, 6))
        for k in (1, 2, 3)
    )
    radius = (
        size
        * np.exp(random.uniform(np.log(0.08), np.log(0.4)))
        * (1 + 0.3 * np.sin(6 * t + random.uniform(0, 6)))
    )
    return size * np.asarray(waves).T, np.maximum(radius * (1 - np.abs(2 * t - 1) ** 6) ** 0.5, 4.0)


def _jittered(points: Floats, random: np.random.Generator) -> Floats:
    """Move points by smooth noise along each axis."""
    moved: Floats = points + 1.5 * np.sin(points[:, ::-1] / 25 + random.uniform(0, 6, 3))
    return moved


def _tube(
    curve: Floats, radii: Floats, spacing: Floats, random: np.random.Generator, free: Booleans
) -> Booleans:
    """Return the largest piece of free voxels in balls along a curve, with a border as rough as in segmentations."""
    from scipy.ndimage import gaussian_filter, label

    reach = radii.max() + 2 * spacing.max()
    low = np.maximum(((curve.min(axis=0) - reach) / spacing).astype(int), 0)
    high = np.minimum(((curve.max(axis=0) + reach) / spacing).astype(int) + 1, free.shape)
    mask = np.zeros_like(free)
    if (high <= low).any():
        return mask
    away = np.full(high - low, np.inf)
    for centre, radius in zip(curve, radii, strict=True):
        first, last = (
            np.clip((centre + sign * (radius + 6)) / spacing, low, high).astype(int)
            for sign in (-1, 1)
        )
        near = tuple(map(slice, first - low, last - low + 1))
        grid = np.meshgrid(*map(np.arange, first, np.minimum(last + 1, high)), indexing="ij")
        ball = np.linalg.norm(np.stack(grid, axis=-1) * spacing - centre, axis=-1) - radius
        away[near] = np.minimum(away[near], ball)
    noise = gaussian_filter(random.normal(size=away.shape), 1.2)
    box = tuple(map(slice, low, high))
    pieces, n = label(free[box] & (away + 0.35 * spacing.min() * noise / noise.std() <= 0))
    if n:
        mask[box] = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    return mask

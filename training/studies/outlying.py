"""Whether damaged segmentations are found: the outlier scores of given masks and of the same damaged in six ways."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps.analysis.groups import squared_distances, vectors_of
from igps.analysis.outliers import Outlier, measures_of, outliers
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor as descriptor_of
from igps.nn.description import describe
from igps.report.answers import write_answer

DAMAGES = ("slices", "hole", "leak", "island", "label", "half")
_LEAST_VOXELS = 50

Mask = NDArray[np.bool_]


def outlying(volumes: Path | None = None, out: Path = Path("build/outlying"), cache_dir: Path | None = None) -> None:
    """Score masks as they are, and each with one damage in its place; the area under the curve tells them apart.

    Args:
        volumes: folder with organs/*.nii.gz and prostate/*.nii.gz; generated bodies if not given.
        out: folder for the masks, outlying.csv and outlying.json.
        cache_dir: of the signatures.
    """
    masks = _generated() if volumes is None else _given(volumes)
    names = sorted(masks)
    labels = [name.split("/")[0] for name in names]
    random = np.random.default_rng(0)
    damages = [DAMAGES[i % len(DAMAGES)] for i in random.permutation(len(names))]
    paths = [_write(out / "given" / f"{i}.nii.gz", *masks[name]) for i, name in enumerate(names)]
    for i, (name, damage) in enumerate(zip(names, damages, strict=True)):
        paths.append(_write(out / "damaged" / f"{i}.nii.gz", *damaged(*masks[name], damage, random)))
    chosen = descriptor_of("pretrained")
    whole = SignatureDataset(paths, descriptor=chosen, cache_dir=cache_dir)
    failures = whole.precompute()
    gone = {failure.id for failure in failures}
    dataset = whole.usable(failures)
    place = {
        path: i
        for i, path in enumerate(p for p, name in zip(paths, whole.bodies.names, strict=True) if name not in gone)
    }
    distances = squared_distances(vectors_of(chosen, describe(dataset, chosen, progress=True))) ** 0.5
    measures, notes = measures_of(dataset), dataset.all_notes()

    def scored(chosen_paths: Sequence[Path], classes: Sequence[str]) -> list[Outlier]:
        rows = [place[path] for path in chosen_paths]
        own = {name: values[rows] for name, values in measures.items()}
        found = outliers(distances[np.ix_(rows, rows)], classes, own, [notes[row] for row in rows])
        return sorted(found, key=lambda one: one.body)

    kept = [i for i in range(len(names)) if paths[i] in place]
    files, classes = [paths[i] for i in kept], [labels[i] for i in kept]
    rows = [
        {"mask": names[i], "damage": "none", "score": one.score, "reason": one.reason}
        for i, one in zip(kept, scored(files, classes), strict=True)
    ]
    for n, i in enumerate(kept):
        path = paths[len(names) + i]
        if path not in place:
            rows.append({"mask": names[i], "damage": damages[i], "score": 99.0, "reason": "refused by the reader"})
            continue
        mine = classes[n]
        if damages[i] == "label":
            mine = str(random.choice([one for one in sorted(set(classes)) if one != mine and classes.count(one) > 1]))
        one = scored([*files[:n], path, *files[n + 1 :]], [*classes[:n], mine, *classes[n + 1 :]])[n]
        rows.append({"mask": names[i], "damage": damages[i], "score": one.score, "reason": one.reason})
    write_answer(out, "outlying", rows)
    print(json.dumps(areas(rows), indent=2))


def areas(rows: Sequence[dict[str, object]]) -> dict[str, float]:
    """Areas under the curve, of all damages and of each against all that are not damaged."""
    from sklearn.metrics import roc_auc_score

    found = {}
    for damage in ("all", *DAMAGES):
        some = [row for row in rows if damage == "all" or row["damage"] in ("none", damage)]
        found[damage] = float(roc_auc_score([row["damage"] != "none" for row in some], [row["score"] for row in some]))
    return found


def damaged(
    mask: Mask, spacing: NDArray[np.float64], how: str, random: np.random.Generator
) -> tuple[Mask, NDArray[np.float64]]:
    """A mask and its spacing after one of the `DAMAGES`; "label" leaves both."""
    places = np.argwhere(mask) * spacing
    radius = np.cbrt(3 / (4 * np.pi) * mask.sum() * spacing.prod())
    grid = np.stack(np.meshgrid(*map(np.arange, mask.shape), indexing="ij"), axis=-1) * spacing

    def ball(centre: NDArray[np.float64], size: float) -> Mask:
        return ((grid - centre) ** 2).sum(axis=-1) <= max(size * radius, 1.01 * spacing.max()) ** 2

    from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

    skin = np.argwhere(mask & ~binary_erosion(mask)) * spacing
    if how == "slices":
        lowest, highest = places[:, 2].min(), places[:, 2].max()
        return mask & (grid[..., 2] <= highest - 0.25 * (highest - lowest)), spacing
    if how == "hole":
        deepest = np.argwhere((depth := distance_transform_edt(mask, spacing)) == depth.max())[0] * spacing
        across = ((grid - deepest)[..., :2] ** 2).sum(axis=-1) <= max(0.25 * radius, 1.01 * spacing.max()) ** 2
        return mask & ~across, spacing
    if how == "leak":
        return mask | ball(skin[random.integers(len(skin))], 0.6), spacing
    if how == "island":
        outside = np.argwhere(~binary_dilation(mask, iterations=4)) * spacing
        return mask | ball(outside[random.integers(len(outside))], 0.25), spacing
    if how == "half":
        return mask[::2, ::2, ::2], spacing * 2
    return mask, spacing


def _write(path: Path, mask: Mask, spacing: NDArray[np.float64]) -> Path:
    import nibabel

    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(mask.astype(np.uint8), np.diag([*spacing, 1.0])), path)
    return path


def _cropped(mask: Mask, spacing: NDArray[np.float64]) -> tuple[Mask, NDArray[np.float64]]:
    """With room of eight voxels around it, for what is added."""
    places = np.argwhere(mask)
    low, high = places.min(axis=0), places.max(axis=0) + 1
    return np.pad(mask[tuple(map(slice, low, high))], 8), spacing


def _given(volumes: Path) -> dict[str, tuple[Mask, NDArray[np.float64]]]:
    """The masks of at least fifty voxels, by class and name; the classes are the names without side and number."""
    import nibabel

    found = {}
    for path in sorted(volumes.glob("*/*.nii.gz")):
        image: Any = nibabel.load(path)
        mask = np.asarray(image.dataobj) > 0
        if mask.sum() < _LEAST_VOXELS:
            continue
        name = path.name.removesuffix(".nii.gz")
        kind = re.sub(r"_(left|right)|_?[CTL]?\d+$", "", name)
        found[f"{kind}/{name}"] = _cropped(mask.squeeze(), np.array(image.header.get_zooms()[:3], dtype=float))
    return found


def _generated() -> dict[str, tuple[Mask, NDArray[np.float64]]]:
    """Twelve each of five kinds of bodies that vary as organs do: eggs, beans, discs, bent rods, balls on a stalk."""
    random = np.random.default_rng(1)
    x, y, z = np.stack(np.meshgrid(*3 * [np.linspace(-1.6, 1.6, 56)], indexing="ij"))
    found = {}
    for number in range(12):
        a, b, c, bend = random.normal(1, 0.1, 4)
        forms = {
            "egg": (x / (0.6 * a)) ** 2 + (y / (0.6 * b)) ** 2 + (z / (1.0 * c + 0.2 * x)) ** 2,
            "bean": (x / (0.45 * a)) ** 2 + ((y - 0.5 * bend * z**2) / (0.35 * b)) ** 2 + (z / (1.0 * c)) ** 2,
            "disc": (x / (1.1 * a)) ** 2 + (y / (1.0 * b)) ** 2 + (z / (0.3 * c)) ** 2,
            "rod": (x / (0.2 * a)) ** 4 + ((y - 0.35 * bend * z**2) / (0.2 * b)) ** 4 + (z / (1.3 * c)) ** 8,
            "stalk": np.minimum(
                ((x / (0.5 * a)) ** 2 + (y / (0.5 * b)) ** 2 + ((z + 0.6) / (0.5 * c)) ** 2),
                (x / (0.2 * a)) ** 4 + (y / (0.2 * b)) ** 4 + ((z - 0.3) / (0.9 * bend)) ** 4,
            ),
        }
        for name, form in forms.items():
            found[f"{name}/{name}{number}"] = _cropped(form <= 1, np.full(3, 2.0))
    return found

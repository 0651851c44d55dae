"""Outliers: bodies that are unlike their class, to check segmentations and labels before they are used."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers
from igps._parallel import run
from igps._threads import n_cores
from igps.analysis.segmentation import (
    Place,
    cavity_root,
    cut_end,
    gap_root,
    hole_root,
    overlaps,
    stray_root,
)
from igps.data.filling import group_by_file
from igps.data.pipeline import SignaturePipeline
from igps.failures import Failed
from igps.fields.volumes.label_surface import MIN_VOXELS, TooFewVoxelsError
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, each_raw_body, surface_body
from igps.mesh.mesh import Mesh, millimetres
from igps.mesh.raw_body import RawBody
from igps.mesh.surface import area_vectors, lengths

if TYPE_CHECKING:
    # Loads torch, which workers do without
    from igps.data.dataset import SignatureDataset

_MEASURED = ("volume", "spacing", "handles", "flat", "stray", "cavity", "hole", "gap", "cut")

_N_NEIGHBOURS = 3  # nearest members of a class that a body is compared with
_MIN_CLASS_SIZE = 4  # smaller classes are also compared with other classes
_MIN_CLASSES = 4  # other classes, for a comparison with them
_PRIOR_WEIGHT = 5  # weight of the pooled scatter of all classes, as a number of bodies
_NORMAL_RATIO = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_MAX_WITHOUT_TAIL = 10  # largest number of values whose tail is ignored
_MIN_SUBJECTS = 5  # with fewer subjects, none can be identified as unusual
_TWO_SIDED = ("volume", "spacing")  # measures whose small values are as unusual as large ones
# Smallest scatter that is assumed, so that small differences do not count; in units of the measures
_MIN_SCATTER = {
    "shape": 0.1,
    "volume": 0.05,
    "spacing": 0.05,
    "handles": 0.35,
    "repairs": 0.35,
    "flat": 0.02,
    "stray": 0.01,
    "cavity": 0.01,
    "hole": 0.01,
    "gap": 0.01,
    "cut": 0.5,
    "overlap": 0.01,
}
LIMIT = 3.5
"""Bodies with a larger score are outliers; for a normal distribution, one body in 2,000."""
_REASONS = {
    "shape": "its shape is unusual for its class",
    "volume": "its volume is {ratio:.2f} times the usual volume",
    "spacing": "its resolution is {ratio:.2f} times as coarse as usual",
    "handles": "it has {value:.0f} handles ({usual:.0f} usual)",
    "repairs": "its repairs are unusual: {notes}",
    "flat": "{value:.0%} of its surface lies in one plane, as if cut off",
    "stray": "{square:.1%} of its voxels are detached",
    "cavity": "its cavities have {square:.1%} of its volume",
    "hole": "holes in its slices have {square:.1%} of its volume ({common:.1%} usual)",
    "gap": "its gaps have {square:.0%} of its volume ({common:.0%} usual)",
    "cut": "its last slice is as large as those before it, as if cut off",
    "overlap": "{square:.0%} of its voxels lie in a body of another class",
}


@dataclass(frozen=True)
class Outlier:
    """How much a body differs from its class."""

    body: int  # index of the body
    label: str  # class of the body
    score: float  # root of the sum of squares of the positive `scores`
    # Robust standard deviations from the other bodies of the class, by measure
    scores: Mapping[str, float]
    # Another class whose members are nearer than those of the own class, if any
    nearer_class: str | None
    reason: str  # explanation as text

    @property
    def is_outlier(self) -> bool:
        """Whether the score is above `LIMIT`."""
        return self.score > LIMIT


def outliers(
    distances: Floats,
    labels: Sequence[str],
    measures: Mapping[str, Floats] | None = None,
    notes: Sequence[Sequence[str]] | None = None,
    subjects: Sequence[object] | None = None,
    cut: Sequence[str] | None = None,
) -> list[Outlier]:
    """Rank bodies by how much they differ from their class, the most different first.

    The value of a body is compared with the median and the median absolute deviation of the other bodies of its class.
    The latter is combined with that of all classes, because small classes estimate their scatter poorly. The measures
    of the shape are the logarithm of the mean distance to the three nearest bodies of the class, and the same minus the
    logarithm for the nearest other class.

    Args:
        distances: (N, N) distances between the bodies.
        labels: classes of the N bodies.
        measures: measures of the N bodies by name, see `measure_bodies`; "volume" is compared only within classes.
        notes: notes on the repairs of each body.
        subjects: subject of each body. All bodies of one subject may be unusual, as by a wrong unit. Used only if no
            subject has several bodies of one class.
        cut: sides at which each body reaches the border of its image, "" if it does not. A body is compared with those
            of its class that a scan may have cut at the same sides.
    """
    sides = cut or [""] * len(labels)
    kinds = list(zip(labels, sides, strict=True))
    known_kinds = sorted(set(kinds))
    names = np.array([label for label, _ in known_kinds])
    codes = np.array([known_kinds.index(kind) for kind in kinds])
    own, other, nearest = _class_distances(np.asarray(distances, dtype=float), codes, names)
    n_per_subject = max_bodies_of_subject(subjects or range(len(codes)), codes)
    by_distance, usual = deviations_of(own, codes, "shape", n_per_subject)
    by_margin, _ = deviations_of(own - other, codes, "shape", n_per_subject)
    judged = [_Measure("shape", np.fmax(by_distance, by_margin), own, usual)]
    values = dict(measures or {})
    if "overlap" in values:
        values["overlap"] = np.sqrt(values["overlap"].max(axis=1))
    rare_notes: list[list[str]] = [[] for _ in labels]
    if notes is not None:
        values["repairs"], rare_notes = _rare_repairs(notes)
        if "stray" in values:  # defects of labels are measured in voxels instead
            values["repairs"][np.isfinite(values["stray"])] = 0
    for name, measured in values.items():
        scores, usual = deviations_of(measured, codes, name, n_per_subject)
        judged.append(_Measure(name, scores, measured, usual))
    result = []
    for i, label in enumerate(labels):
        scores_of_body = {one.name: float(np.nan_to_num(one.scores[i])) for one in judged}
        score = float(np.linalg.norm(np.maximum(list(scores_of_body.values()), 0)))
        reasons = []
        if score > LIMIT:
            first, *others = sorted(judged, key=lambda one: -scores_of_body[one.name])
            telling = [first, *(one for one in others if scores_of_body[one.name] > LIMIT)]
            reasons = [one.reason(i, rare_notes[i]) for one in telling]
        among = None
        if own[i] > other[i]:
            among = str(names[nearest[i]])
            reasons.append(f"labelled {label}, but nearer to {among}")
        if not reasons:
            reasons = ["nothing unusual"]
            if np.isnan(own[i]):
                place = f" cut at {sides[i]} by the border of the image" if sides[i] else ""
                reasons = [f"shape not assessed: the only body of its class{place}"]
        result.append(Outlier(i, label, score, scores_of_body, among, "; ".join(reasons)))
    return sorted(result, key=lambda outlier: -outlier.score)


@dataclass(frozen=True, eq=False)
class _Measure:
    """A measure of N bodies beside what is usual for their classes."""

    name: str
    scores: Floats  # (N,) see `deviations_of`; NaN where they are not known
    values: Floats  # (N,)
    usual: Floats  # (N,)

    def reason(self, i: int, notes: Sequence[str]) -> str:
        """Return in words why a body is unusual by this measure; `notes` are its rare repairs."""
        value = float(self.values[i])
        usual = float(self.usual[i])
        return _REASONS[self.name].format(
            value=value,
            usual=usual,
            square=value**2,
            common=usual**2,
            ratio=np.exp(min(value - usual, 50)),
            notes="; ".join(notes),
        )


def measure_bodies(dataset: SignatureDataset, *, n_workers: int | None = None) -> dict[str, Floats]:
    """Measure properties of each body in which segmentations often fail; NaN where its file cannot be read again.

    Args:
        dataset: N bodies.
        n_workers: number of worker processes; all cores if None.

    Returns:
        Arrays (N,) by name. For all bodies, "volume" and "spacing" (the side of a voxel, or the square root of the mean
        area of a face), as logarithms, in millimetres where the unit is known. For meshes, "handles" and "flat", the
        largest share of the surface that lies in one plane. For labels, "stray", "cavity", "hole" and "gap", roots of
        shares of the voxels, and "cut", see `igps.analysis.segmentation`. And "overlap" (N, N), the share of the voxels
        of each label that lies in each label of another class, in the same grid and the same file (or the same folder,
        for files with one label).
    """
    values = np.full((len(dataset), len(_MEASURED)), np.nan)
    places = list[Place | None]([None] * len(dataset))
    max_per_job = -(-len(dataset) // (n_workers or n_cores()))
    jobs = group_by_file(dataset.bodies, range(len(dataset)), max_per_job)
    bodies = [dataset.bodies.subset(job).refs for job in jobs]
    work = partial(_measure_file, dataset.pipeline)
    with contextlib.closing(run(work, bodies, n_workers=n_workers)) as outcomes:
        for number, outcome in outcomes:
            for i, body in zip(jobs[number], bodies[number], strict=True):
                if not isinstance(outcome, Failed) and body in outcome:
                    values[i], places[i] = outcome[body]
    # A file with several labels is one subject; files in its folder may be other subjects in the same standard space
    counts = Counter(dataset.bodies.paths)
    for i, (path, place) in enumerate(zip(dataset.bodies.paths, places, strict=True)):
        if place is not None and counts[path] > 1:
            places[i] = replace(place, grid=(path, *place.grid))
    return {
        **dict(zip(_MEASURED, values.T, strict=True)),
        "overlap": overlaps(places, dataset.bodies.labels),
    }


def flat_share(mesh: Mesh) -> float:
    """Return the largest share of the area in one plane: faces within 8° of its normal, within a mean edge length."""
    vectors = area_vectors(mesh.vertices, mesh.faces)
    areas = lengths(vectors)
    normals = vectors / np.maximum(areas, 1e-300)[:, None]
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    thickness = np.sqrt(areas.mean())
    largest = 0.0
    # A large flat side has many faces, so a regular subset of about 200 faces contains some of them
    for normal in normals[:: max(1, len(normals) // 200)]:
        is_parallel = normals @ normal > 0.99
        heights = centres[is_parallel] @ normal
        weights = areas[is_parallel]
        order = np.argsort(heights)
        heights = heights[order]
        sums = np.append(0, np.cumsum(weights[order]))
        ends = np.searchsorted(heights, heights + thickness, "right")
        within = sums[ends] - sums[:-1]
        largest = max(largest, float(within.max()))
    return largest / float(areas.sum())


def _measure_file(
    pipeline: SignaturePipeline, bodies: Sequence[BodyRef]
) -> dict[BodyRef, tuple[list[float], Place | None]]:
    """Measure bodies of the same file, which is read once; bodies without a surface are left out."""
    result = {}
    parts = [body.part for body in bodies]
    for body, raw in each_raw_body(bodies[0].path, pipeline.reading, parts=parts):
        with contextlib.suppress(MeshError):
            result[body] = _measure(pipeline, body, raw)
    return result


def _measure(
    pipeline: SignaturePipeline, body: BodyRef, raw: RawBody
) -> tuple[list[float], Place | None]:
    """Return the measures `_MEASURED` of a body, and the place of a label."""
    values = dict.fromkeys(_MEASURED, np.nan)
    if raw.voxels is None:
        mesh = pipeline.refined(surface_body(raw.made(), body, pipeline.reading))
        length = millimetres(mesh.unit)
        values["volume"] = np.log(mesh.volume * length**3)
        values["spacing"] = np.log(mesh.area * length**2 / len(mesh.faces)) / 2
        values["handles"] = mesh.genus
        values["flat"] = flat_share(mesh)
        return list(values.values()), None
    voxels = raw.voxels()
    mask = voxels.mask
    n_voxels = int(mask.sum())
    if n_voxels < MIN_VOXELS:
        raise TooFewVoxelsError(f"{body}: {n_voxels} voxels have no shape.")
    low = voxels.low
    grid = voxels.grid
    sides = np.linalg.norm(voxels.affine[:3, :3], axis=0)
    voxel_volume = abs(np.linalg.det(voxels.affine[:3, :3]))
    values["volume"] = np.log(n_voxels * voxel_volume)
    # Faces do not tell: the surface of a label adapts them to the shape
    values["spacing"] = np.log(sides.prod()) / 3
    values["stray"] = stray_root(mask)
    values["cavity"] = cavity_root(mask)
    values["hole"] = hole_root(mask)
    values["gap"] = gap_root(mask, sides)
    values["cut"] = cut_end(mask, np.stack([low == 0, low + mask.shape == grid], axis=1))
    key = body.path.parent, grid, voxels.affine.tobytes()
    return list(values.values()), Place(key, low, mask.shape, n_voxels, np.packbits(mask))


def _class_distances(
    distances: Floats, codes: Integers, names: NDArray[np.str_]
) -> tuple[Floats, Floats, Integers]:
    """Return the log mean distances to the nearest bodies of the own and of the nearest other kind; and that kind.

    Bodies have the kinds `codes` (N,); other kinds are those of another class, see their `names`.
    """
    n = len(codes)
    n_classes = int(codes.max()) + 1
    own = np.full(n, np.nan)
    other = np.full(n, np.nan)
    nearest = np.zeros(n, dtype=np.int64)
    members = [np.flatnonzero(codes == code) for code in range(n_classes)]
    for i, own_code in enumerate(codes):
        k = min(_N_NEIGHBOURS, max(1, len(members[own_code]) - 1))
        means = np.full(n_classes, np.nan)
        for code, indices in enumerate(members):
            others = np.sort(distances[i, indices[indices != i]])
            if len(others) >= (1 if code == own_code else min(k, 2)):
                means[code] = np.log(max(others[:k].mean(), 1e-12))
        own[i] = means[own_code]
        means[names == names[own_code]] = np.nan
        if np.isfinite(means).any():
            nearest[i] = np.nanargmin(means)
            other[i] = means[nearest[i]]
    return own, other, nearest


def max_bodies_of_subject(subjects: Sequence[object], codes: Integers) -> int:
    """Return the largest number of bodies of a subject; 1 if subjects are few or have several bodies of a class."""
    counts = Counter(subjects)
    is_usable = (
        len(set(zip(subjects, codes.tolist(), strict=True))) == len(codes)
        and len(counts) >= _MIN_SUBJECTS
    )
    return max(counts.values()) if is_usable else 1


def deviations_of(
    values: Floats, codes: Integers, name: str, n_per_subject: int
) -> tuple[Floats, Floats]:
    """Return how many robust standard deviations values (N,) exceed the usual value, and the usual value.

    The usual value is the median of the other bodies of the class; for a class of one, the median of the other classes.
    In classes of two or three, the spacing is compared with both, and the smaller deviation counts: the other classes
    decide which body is unusual. All deviations are divided by their upper quantile over that of a normal distribution,
    if this is above 1. The level of the quantile is 95 %, or lower if one subject has more than a twentieth of the
    bodies, so that the bodies of a single subject do not determine it.
    """
    n = len(values)
    min_scatter = _MIN_SCATTER[name]
    is_known = np.isfinite(values)
    members = []
    usual = np.full(n, np.nan)
    for i in range(n):
        of_class = np.flatnonzero(is_known & (codes == codes[i]))
        others = np.setdiff1d(of_class, i)
        members.append(others)
        if len(others):
            usual[i] = np.median(values[others])
    differences = values - usual
    pooled = _scatter(differences[np.isfinite(differences)], min_scatter)
    centres = {
        code: np.median(values[is_known & (codes == code)]) for code in np.unique(codes[is_known])
    }
    result = np.full(n, np.nan)
    for i in np.flatnonzero(is_known).tolist():
        deviations = []
        own = values[members[i]]
        if len(own):
            n_own = len(own)
            own_scatter = _scatter(own, 0, use_tail=False)
            variance = (n_own * own_scatter**2 + _PRIOR_WEIGHT * pooled**2) / (
                n_own + _PRIOR_WEIGHT
            )
            deviations.append(differences[i] / max(min_scatter, np.sqrt(variance)))
        if name != "volume" and len(own) < (_MIN_CLASS_SIZE - 1 if name == "spacing" else 1):
            others = np.array([centre for code, centre in centres.items() if code != codes[i]])
            if len(others) >= _MIN_CLASSES:
                deviations.append((values[i] - np.median(others)) / _scatter(others, min_scatter))
                usual[i] = usual[i] if len(own) else np.median(others)
        if deviations:
            result[i] = min(np.abs(deviations) if name in _TWO_SIDED else deviations)
    if (count := np.isfinite(result).sum()) > _MAX_WITHOUT_TAIL:
        level = min(0.95, max(1 - 1 / _MIN_SUBJECTS, 1 - n_per_subject / (count - 1)))
        result /= max(1.0, np.nanquantile(result, level) / NormalDist().inv_cdf(level))
    return result, usual


def _scatter(values: Floats, minimum: float, use_tail: bool = True) -> float:
    """Return a robust standard deviation, by the median or the 90 % quantile of absolute deviations, if larger."""
    if not len(values):
        return minimum
    deviations = np.abs(values - np.median(values))
    tail = (
        np.quantile(deviations, 0.9) / 1.645
        if use_tail and len(values) > _MAX_WITHOUT_TAIL
        else 0.0
    )
    return max(minimum, _NORMAL_RATIO * float(np.median(deviations)), float(tail))


# Numbers, and the endings of nouns that depend on them.
_NUMBER = re.compile(r"[\d.,]+|(ex|ices|y|ies|s)\b")


def _rare_repairs(notes: Sequence[Sequence[str]]) -> tuple[Floats, list[list[str]]]:
    """Return twice the number of rare notes of each body (N,), and these notes.

    A note is rare if fewer than a quarter of the bodies have it, whatever its numbers.
    """
    kinds = [_kinds(notes_of_body) for notes_of_body in notes]
    counts = Counter(kind for kinds_of_body in kinds for kind in set(kinds_of_body))
    rare = []
    for notes_of_body, kinds_of_body in zip(notes, kinds, strict=True):
        pairs = zip(notes_of_body, kinds_of_body, strict=True)
        rare.append([note for note, kind in pairs if counts[kind] < len(notes) / 4])
    return np.array([2.0 * len(rare_of_body) for rare_of_body in rare]), rare


def _kinds(notes: Sequence[str]) -> list[str]:
    """Return notes without their numbers."""
    return [_NUMBER.sub("", note) for note in notes]

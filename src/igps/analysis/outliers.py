"""Which bodies are unlike their class: for checking segmentations and labels before anybody trusts them."""

import contextlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import NormalDist

import numpy as np

from igps._arrays import Floats, Integers
from igps._parallel import Failed, run
from igps._threads import n_cores
from igps.analysis.segmentation import Place, cavity_root, cut_end, gap_root, hole_root, overlaps, stray_root
from igps.data.dataset import SignatureDataset
from igps.data.filling import group_by_file
from igps.data.pipeline import SignaturePipeline
from igps.mesh.formats import RawBody
from igps.mesh.loading import BodyRef, each_surface, surface_body
from igps.mesh.mesh import Mesh, MeshError, millimetres
from igps.mesh.surface import area_vectors

_MEASURED = ("volume", "spacing", "handles", "flat", "stray", "cavity", "hole", "gap", "cut")

# Members of a class that a body is compared with, and from how many on a class is its own measure of what is usual
_NEAREST, _ENOUGH = 3, 4
# So many bodies of a class weigh as much as all classes together in what scatter is usual
_PRIOR = 5
# Of a normal distribution, the standard deviation over the median absolute deviation
_NORMAL = 1.4826
# Fewer values have no tail
_FEW = 10
# Among fewer subjects it cannot be told which is odd
_FEWEST_SUBJECTS = 5
# Measures of which less than usual is as odd as more
_TWO_SIDED = ("volume", "spacing")
# Scatter below which no measure is taken to differ; of logarithms, counts, shares and their roots
_LEAST = {
    "shape": 0.1, "volume": 0.05, "spacing": 0.05, "handles": 0.35, "repairs": 0.35, "flat": 0.02,
    "stray": 0.01, "cavity": 0.01, "hole": 0.01, "gap": 0.01, "cut": 0.5, "overlap": 0.01,
}  # fmt: skip
# A score above this is said to be an outlier: of a normal distribution one body in 2,000 is
LIMIT = 3.5
_SAYS = {
    "shape": "its shape is unlike its class",
    "volume": "its volume is {ratio:.2f} times the usual",
    "spacing": "it is {ratio:.2f} times as coarse as usual",
    "handles": "it has {value:.0f} handles, where {usual:.0f} are usual",
    "repairs": "it was repaired as few are: {notes}",
    "flat": "{value:.0%} of its surface lie in one plane, as if it were cut",
    "stray": "{square:.1%} of it lie apart",
    "cavity": "it has cavities of {square:.1%} of its voxels",
    "hole": "it has holes of {square:.1%} of its voxels in slices, where {common:.1%} are usual",
    "gap": "it has gaps of {square:.0%} of its voxels, where {common:.0%} are usual",
    "cut": "its last slice is as large as those before it, as if it were cut",
    "overlap": "{square:.0%} of it lie in a body of another class",
}


@dataclass(frozen=True)
class Outlier:
    """How unlike its class a body is."""

    body: int  # its number
    label: str  # its class
    score: float  # the root of the sum of squares of those `scores` that are positive
    scores: Mapping[str, float]  # of each measure, how many robust standard deviations it is from the rest of its class
    lies_among: str | None  # the class whose members are nearer than its own; None where its own are
    reason: str  # in words

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
) -> list[Outlier]:
    """The bodies by how unlike their class they are, the most unlike first.

    Each body is left out of what it is compared with: medians and median absolute deviations of the others, the latter
    drawn towards those of all classes, since small classes tell little of their scatter. Its shape is the logarithm of
    its mean distance to the nearest three of its class, alone and over that to the nearest three of another.

    Args:
        distances: (N, N) between the bodies.
        labels: N classes.
        measures: (N,) each, see `measures_of`; "volume" is compared within classes alone.
        notes: of each body, what was done to it.
        subjects: of each body the subject, all of whose bodies may be odd, as by a wrong unit. Heeded where a subject
            has at most one body of a class.
    """
    names, codes = np.unique(np.asarray(labels), return_inverse=True)
    own, other, nearest = _nearness(np.asarray(distances, dtype=float), codes)
    n_together = _most_of_a_subject(subjects or range(len(codes)), codes)
    scores = {"shape": np.fmax(*(_deviations(one, codes, "shape", n_together)[0] for one in (own, own - other)))}
    values = dict(measures or {})
    if "overlap" in values:
        values["overlap"] = np.sqrt(values["overlap"].max(axis=1))
    if notes is not None:
        values["repairs"], rare = _repairs(notes)
        if "stray" in values:  # what is repaired in labels is measured in voxels
            values["repairs"][np.isfinite(values["stray"])] = 0
    usual: dict[str, Floats] = {}
    for name, one in values.items():
        scores[name], usual[name] = _deviations(one, codes, name, n_together)
    found = []
    for i, label in enumerate(labels):
        of_body = {name: float(np.nan_to_num(one[i], nan=0.0)) for name, one in scores.items()}
        score = float(np.linalg.norm(np.maximum(list(of_body.values()), 0)))
        among = str(names[nearest[i]]) if own[i] > other[i] else None
        worst = sorted(of_body, key=lambda name: -of_body[name])
        told = []
        for name in [one for k, one in enumerate(worst) if k == 0 or of_body[one] > LIMIT]:
            value, centre = (float(one[name][i]) if name in one else 0.0 for one in (values, usual))
            ratio = np.exp(min(value - centre, 50))
            text = "; ".join(rare[i]) if name == "repairs" else ""
            told.append(
                _SAYS[name].format(
                    value=value, usual=centre, square=value**2, common=centre**2, ratio=ratio, notes=text
                )
            )
        alone = "alone in its class, its shape is not judged" if np.isnan(own[i]) else "nothing unusual"
        said = [*(told if score > LIMIT else ()), *([] if among is None else [f"labelled {label}, lies among {among}"])]
        found.append(Outlier(i, label, score, of_body, among, "; ".join(said) or alone))
    return sorted(found, key=lambda one: -one.score)


def measures_of(dataset: SignatureDataset, *, n_workers: int | None = None) -> dict[str, Floats]:
    """What segmentations go wrong in, of each body: NaN where its mesh cannot be read again.

    Of all: "volume" and "spacing", the side of a voxel or else the root of the area of a face, as logarithms, in
    millimetres where the unit is known. Of meshes: "handles", and "flat", the largest share of the surface that lies in
    one plane. Of labels: "stray", "cavity", "hole" and "gap", roots of shares of their voxels, and "cut", see
    `igps.analysis.segmentation`; and "overlap", (N, N), the share of each that lies in each body of another class in
    the same grid and file, or of files of one body, folder.
    """
    found = np.full((len(dataset), len(_MEASURED)), np.nan)
    places = list[Place | None]([None] * len(dataset))
    jobs = group_by_file(dataset.bodies, range(len(dataset)), -(-len(dataset) // (n_workers or n_cores())))
    given = [[dataset.bodies[i] for i in job] for job in jobs]
    with contextlib.closing(run(partial(_measures, dataset.pipeline), given, n_workers=n_workers)) as all_:
        for number, outcome in all_:
            for i, body in zip(jobs[number], given[number], strict=True):
                if not isinstance(outcome, Failed) and body in outcome:
                    found[i], places[i] = outcome[body]
    # A file of several labels is a subject by itself; other subjects of its folder may be in the same standard space
    counts = Counter(dataset.bodies.paths)
    for i, (path, place) in enumerate(zip(dataset.bodies.paths, places, strict=True)):
        if place is not None and counts[path] > 1:
            places[i] = replace(place, grid=(path, *place.grid))
    return {**dict(zip(_MEASURED, found.T, strict=True)), "overlap": overlaps(places, dataset.bodies.labels)}


def flat_share(mesh: Mesh) -> float:
    """The largest share of the area in one plane: faces within 8° of its normal, a mean edge from it at most."""
    vectors = area_vectors(mesh.vertices, mesh.faces)
    areas = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.maximum(areas, 1e-300)[:, None]
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    thickness = np.sqrt(areas.mean())
    best = 0.0
    # The largest flat side holds many faces, so that some of few in equal steps are on it
    for normal in normals[:: max(1, len(normals) // 200)]:
        along = normals @ normal > 0.99
        heights, weights = centres[along] @ normal, areas[along]
        order = np.argsort(heights)
        heights, sums = heights[order], np.append(0, np.cumsum(weights[order]))
        best = max(best, float((sums[np.searchsorted(heights, heights + thickness, "right")] - sums[:-1]).max()))
    return best / float(areas.sum())


def _measures(
    pipeline: SignaturePipeline, bodies: Sequence[BodyRef]
) -> dict[BodyRef, tuple[list[float], Place | None]]:
    """Of the bodies of one file, which is read once; without those that have no surface."""
    found = {}
    for body, raw in each_surface(bodies[0].path, pipeline.reading, parts=[one.part for one in bodies]):
        with contextlib.suppress(MeshError):
            found[body] = _of_body(pipeline, body, raw)
    return found


def _of_body(pipeline: SignaturePipeline, body: BodyRef, raw: RawBody) -> tuple[list[float], Place | None]:
    mesh = surface_body(raw, body, pipeline.reading, least_vertices=pipeline.config.n_vertices_read)
    found = dict.fromkeys(_MEASURED, np.nan)
    length = millimetres(mesh.unit)
    found["volume"] = np.log(mesh.volume * length**3)
    if raw.voxels is None:
        found["spacing"] = np.log(mesh.area * length**2 / len(mesh.faces)) / 2
        found["handles"], found["flat"] = mesh.genus, flat_share(mesh)
        return list(found.values()), None
    voxels = raw.voxels()
    mask, low, grid = voxels.mask, voxels.low, voxels.grid
    sides = np.linalg.norm(voxels.affine[:3, :3], axis=0)
    found["spacing"] = np.log(sides.prod()) / 3  # the surface has as many faces as its form needs, on any grid
    found["stray"], found["cavity"], found["hole"] = stray_root(mask), cavity_root(mask), hole_root(mask)
    found["gap"] = gap_root(mask, sides)
    found["cut"] = cut_end(mask, np.stack([low == 0, low + mask.shape == grid], axis=1))
    where = body.path.parent, grid, voxels.affine.tobytes()
    return list(found.values()), Place(where, low, mask.shape, int(mask.sum()), np.packbits(mask))


def _nearness(distances: Floats, codes: Integers) -> tuple[Floats, Floats, Integers]:
    """Logarithms of mean distances to the nearest of the own class and of the nearest other class, and its number."""
    n, n_classes = len(codes), int(codes.max()) + 1
    own, other, nearest = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, dtype=np.int64)
    members = [np.flatnonzero(codes == one) for one in range(n_classes)]
    for i, mine in enumerate(codes):
        k = min(_NEAREST, max(1, len(members[mine]) - 1))
        of_class = np.full(n_classes, np.nan)
        for one, places in enumerate(members):
            others = np.sort(distances[i, places[places != i]])
            if len(others) >= (1 if one == mine else min(k, 2)):
                of_class[one] = np.log(max(others[:k].mean(), 1e-12))
        own[i] = of_class[mine]
        of_class[mine] = np.nan
        if np.isfinite(of_class).any():
            nearest[i] = np.nanargmin(of_class)
            other[i] = of_class[nearest[i]]
    return own, other, nearest


def _most_of_a_subject(subjects: Sequence[object], codes: Integers) -> int:
    """The most bodies of one subject; 1 where a subject has several of a class, or where there are few subjects."""
    counts = Counter(subjects)
    is_known = len(set(zip(subjects, codes.tolist(), strict=True))) == len(codes) and len(counts) >= _FEWEST_SUBJECTS
    return max(counts.values()) if is_known else 1


def _deviations(values: Floats, codes: Integers, name: str, n_together: int) -> tuple[Floats, Floats]:
    """By how many robust standard deviations values exceed the usual value, and the usual value.

    Usual is what the others of the class have; of a class of one, other classes. Where less is as odd as more, a body
    of a class of two or three is as far away as from both, whatever is less: other classes tell which of the two is
    odd. All is over what a twentieth of the bodies exceed, where that is more than by chance; or a larger share that
    those of one subject cannot make up.
    """
    n, least, known = len(values), _LEAST[name], np.isfinite(values)
    members = [np.setdiff1d(np.flatnonzero(known & (codes == codes[i])), i) for i in range(n)]
    usual = np.array([np.median(values[own]) if len(own) else np.nan for own in members])
    away = values - usual
    pooled = _scatter(away[np.isfinite(away)], least)
    classes = {one: np.median(values[known & (codes == one)]) for one in np.unique(codes[known])}
    found = np.full(n, np.nan)
    for i in np.flatnonzero(known).tolist():
        opinions, own = [], values[members[i]]
        if len(own):
            variance = (len(own) * _scatter(own, 0, False) ** 2 + _PRIOR * pooled**2) / (len(own) + _PRIOR)
            opinions.append(away[i] / max(least, np.sqrt(variance)))
        if name != "volume" and len(own) < (_ENOUGH - 1 if name == "spacing" else 1):
            others = np.array([centre for one, centre in classes.items() if one != codes[i]])
            if len(others) >= _ENOUGH:
                opinions.append((values[i] - np.median(others)) / _scatter(others, least))
                usual[i] = usual[i] if len(own) else np.median(others)
        if opinions:
            found[i] = min(np.abs(opinions) if name in _TWO_SIDED else opinions)
    if (count := np.isfinite(found).sum()) > _FEW:  # without the largest, which may be what is odd
        level = min(0.95, max(1 - 1 / _FEWEST_SUBJECTS, 1 - n_together / (count - 1)))
        found /= max(1.0, np.nanquantile(found, level) / NormalDist().inv_cdf(level))
    return found, usual


def _scatter(values: Floats, least: float, tail: bool = True) -> float:
    """The robust standard deviation: of the median, or of the largest tenth, whatever is more."""
    if not len(values):
        return least
    away = np.abs(values - np.median(values))
    largest = np.quantile(away, 0.9) / 1.645 if tail and len(values) > _FEW else 0.0
    return max(least, _NORMAL * float(np.median(away)), float(largest))


def _repairs(notes: Sequence[Sequence[str]]) -> tuple[Floats, list[list[str]]]:
    """Of each body, how many notes it has whose like fewer than a quarter of all have, and these."""
    kinds = [[re.sub(r"[\d.,]+", "n", note) for note in of_body] for of_body in notes]
    counts = Counter(kind for of_body in kinds for kind in set(of_body))
    rare = [
        [note for note, kind in zip(of_body, of_kind, strict=True) if counts[kind] < len(notes) / 4]
        for of_body, of_kind in zip(notes, kinds, strict=True)
    ]
    return np.array([2.0 * len(one) for one in rare]), rare

"""Which bodies are unlike their class: for checking segmentations and labels before anybody trusts them."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._parallel import Failed, run
from igps.analysis.placement import Place, end_of, overlaps
from igps.data.dataset import SignatureDataset
from igps.data.pipeline import SignaturePipeline
from igps.mesh.formats.volumes import read_label_volume
from igps.mesh.loading import BodyRef, each_surface, surface_body
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors

Values = NDArray[np.float64]

# Members of a class that a body is compared with, and from how many on a class is its own measure of what is usual
_NEAREST, _ENOUGH = 3, 4
# So many bodies of a class weigh as much as all classes together in what scatter is usual
_PRIOR = 5
# Of a normal distribution, the standard deviation over the median absolute deviation
_NORMAL = 1.4826
# Fewer values have no tail
_FEW = 10
# Less is as odd as more
_TWO_SIDED = ("volume", "spacing")
# Scatter below which no measure is taken to differ; of logarithms, counts and shares
_LEAST = {
    "shape": 0.1, "volume": 0.05, "spacing": 0.05, "handles": 0.35, "pieces": 0.2, "repairs": 0.35, "flat": 0.02,
    "cut": 0.5, "thick": 0.05, "overlap": 0.01,
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
    "pieces": "it has {count:.0f} pieces, where {common:.0f} are usual",
    "cut": "its last slice is as large as those before it, as if it were cut",
    "thick": "it is {ratio:.2f} times as thick as usual somewhere, as if it had leaked",
    "overlap": "{value:.0%} of it lie in a body of another class",
}


@dataclass(frozen=True)
class Outlier:
    """How unlike its class a body is.

    Args:
        body: its number.
        label: its class.
        score: the root of the sum of squares of those `scores` that are positive.
        scores: of each measure, how many robust standard deviations it is from the rest of its class.
        lies_among: the class whose members are nearer than its own; None where its own are.
        reason: in words.
    """

    body: int
    label: str
    score: float
    scores: Mapping[str, float]
    lies_among: str | None
    reason: str

    @property
    def is_outlier(self) -> bool:
        """Whether the score is above what chance explains."""
        return self.score > LIMIT


def outliers(
    distances: Values,
    labels: Sequence[str],
    measures: Mapping[str, Values] | None = None,
    notes: Sequence[Sequence[str]] | None = None,
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
    """
    names, codes = np.unique(np.asarray(labels), return_inverse=True)
    own, other, nearest = _nearness(np.asarray(distances, dtype=float), codes)
    scores = {"shape": np.fmax(*(_deviations(one, codes, "shape")[0] for one in (own, own - other)))}
    values = dict(measures or {})
    if "overlap" in values:  # bodies of one class lie in one place, in others' files
        values["overlap"] = np.where(codes[:, None] == codes, 0, values["overlap"]).max(axis=1)
    if notes is not None:
        values["repairs"], rare = _repairs(notes)
    usual: dict[str, Values] = {}
    for name, one in values.items():
        scores[name], usual[name] = _deviations(one, codes, name)
    found = []
    for i, label in enumerate(labels):
        of_body = {name: float(np.nan_to_num(one[i], nan=0.0)) for name, one in scores.items()}
        score = float(np.linalg.norm(np.maximum(list(of_body.values()), 0)))
        among = str(names[nearest[i]]) if own[i] > other[i] else None
        worst = sorted(of_body, key=lambda name: -of_body[name])
        told = []
        for name in [one for k, one in enumerate(worst) if k == 0 or of_body[one] > LIMIT]:
            value, centre = (float(one[name][i]) if name in one else 0.0 for one in (values, usual))
            count, common, ratio = np.exp(np.minimum([value, centre, value - centre], 50))
            text = "; ".join(rare[i]) if name == "repairs" else ""
            told.append(
                _SAYS[name].format(value=value, usual=centre, count=count, common=common, ratio=ratio, notes=text)
            )
        reason = "; ".join(told) if score > LIMIT else "nothing unusual"
        if among is not None:
            reason += f"; labelled {label}, lies among {among}"
        found.append(Outlier(i, label, score, of_body, among, reason))
    return sorted(found, key=lambda one: -one.score)


def measures_of(dataset: SignatureDataset, *, n_workers: int | None = None) -> dict[str, Values]:
    """What segmentations go wrong in, of each body: NaN where its mesh cannot be read again.

    Of all: "volume" and "spacing", the side of a voxel or else the root of the area of a face, as logarithms; "handles"
    of the surface. Of meshes: "flat", the largest share of the surface that lies in one plane. Of labels: "pieces" and
    "thick", the radius of the largest ball within over volume by area, as logarithms; "cut", see `end_of`; and
    "overlap", (N, N), the share of each that lies in each other body of the same grid and folder.

    Args:
        dataset: N bodies.
        n_workers: processes; all cores if None.
    """
    names = ("volume", "spacing", "handles", "flat", "pieces", "thick", "cut")
    found, places = np.full((len(dataset), len(names)), np.nan), list[Place | None]([None] * len(dataset))
    with contextlib.closing(
        run(partial(_measures, dataset.pipeline), list(dataset.bodies), n_workers=n_workers)
    ) as all_:
        for i, outcome in all_:
            if not isinstance(outcome, Failed):
                found[i], places[i] = outcome
    return {**dict(zip(names, found.T, strict=True)), "overlap": overlaps(places, dataset.bodies.labels)}


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


def _measures(pipeline: SignaturePipeline, body: BodyRef) -> tuple[Values, Place | None]:
    reading = pipeline.reading
    ((_, raw),) = each_surface(body.path, reading, parts=[body.part])
    mesh = surface_body(raw, body, reading, least_vertices=pipeline.config.n_vertices_read)
    found = np.array([np.log(mesh.volume), np.log(mesh.area / len(mesh.faces)) / 2, mesh.genus, *4 * [np.nan]])
    if raw.voxels is None:
        found[3] = flat_share(mesh)
        return found, None
    volume = read_label_volume(body.path, reading)
    if body.part is None:
        layer = np.any([one > 0 for one in volume.layers], axis=0)
        box = ndimage.find_objects(layer.view(np.uint8))[0]
        mask = layer[box]
    else:
        box, mask = volume.body(body.part).box, volume.mask(body.part)
    low, shape = np.array([one.start for one in box]), volume.layers[0].shape
    sides = np.linalg.norm(volume.affine[:3, :3], axis=0)
    depth = ndimage.distance_transform_edt(np.pad(mask, 1), sides).max()
    found[1] = np.log(sides.prod()) / 3  # the surface has as many faces as its form needs, on any grid
    found[4] = np.log(ndimage.label(mask, np.ones((3, 3, 3)))[1])
    found[5] = np.log(depth * mesh.area / mesh.volume)
    found[6] = end_of(mask, np.stack([low == 0, low + mask.shape == shape], axis=1))
    grid = (body.path.parent, shape, volume.affine.tobytes())
    return found, Place(grid, low, mask.shape, int(mask.sum()), np.packbits(mask))


def _nearness(distances: Values, codes: NDArray[np.int64]) -> tuple[Values, Values, NDArray[np.int64]]:
    """Logarithms of mean distances to the nearest of the own class and of the nearest other, and which that is."""
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


def _deviations(values: Values, codes: NDArray[np.int64], name: str) -> tuple[Values, Values]:
    """How many robust standard deviations values are above what is usual, and what that is.

    Usual is what the others of the class have; of a class of one, other classes. Where less is as odd as more, a body
    of a class of two or three is as far away as from both, whatever is less: other classes tell which of the two is
    odd. All is over what a twentieth of the bodies exceed, where that is more than by chance.
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
    scale = np.nanquantile(found, 0.95) / 1.645 if n > _FEW and np.isfinite(found).any() else 1.0
    return found / max(1.0, scale), usual


def _scatter(values: Values, least: float, tail: bool = True) -> float:
    """The robust standard deviation: of the median, or of the largest tenth, whatever is more."""
    if not len(values):
        return least
    away = np.abs(values - np.median(values))
    largest = np.quantile(away, 0.9) / 1.645 if tail and len(values) > _FEW else 0.0
    return max(least, _NORMAL * float(np.median(away)), float(largest))


def _repairs(notes: Sequence[Sequence[str]]) -> tuple[Values, list[list[str]]]:
    """Of each body, how many notes it has whose like fewer than a quarter of all have, and these."""
    kinds = [[re.sub(r"[\d.,]+", "n", note) for note in of_body] for of_body in notes]
    counts = Counter(kind for of_body in kinds for kind in set(of_body))
    rare = [
        [note for note, kind in zip(of_body, of_kind, strict=True) if counts[kind] < len(notes) / 4]
        for of_body, of_kind in zip(notes, kinds, strict=True)
    ]
    return np.array([2.0 * len(one) for one in rare]), rare

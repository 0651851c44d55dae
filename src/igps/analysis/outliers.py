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

from igps._parallel import Failed, run
from igps.data.dataset import SignatureDataset
from igps.data.pipeline import SignaturePipeline
from igps.mesh.loading import BodyRef, each_surface, surface_body
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors

Values = NDArray[np.float64]

# Members of a class that a body is compared with, and from how many on a class is its own measure of what is usual
_NEAREST, _ENOUGH = 3, 4
# So many bodies of a class weigh as much as all classes together in what scatter is usual
_PRIOR = 5
# Of a normal distribution, over the median absolute deviation
_NORMAL = 1.4826
# Scatter below which no measure is taken to differ; of logarithms, counts and shares of the area
_LEAST = {"shape": 0.1, "volume": 0.05, "spacing": 0.05, "handles": 0.35, "repairs": 0.35, "flat": 0.02}
# A score above this is said to be an outlier: of a normal distribution one body in 2,000 is
LIMIT = 3.5
_SAYS = {
    "shape": "its shape is unlike its class",
    "volume": "its volume is {ratio:.2f} times the usual",
    "spacing": "it is {ratio:.2f} times as coarse as usual",
    "handles": "it has {value:.0f} handles, where {usual:.0f} are usual",
    "repairs": "it was repaired as few are: {notes}",
    "flat": "{value:.0%} of its surface lie in one plane, as if it were cut",
}


@dataclass(frozen=True)
class Outlier:
    """How unlike its class a body is.

    Args:
        body: its number.
        label: its class.
        score: the largest of the `scores`.
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
    scores = {"shape": np.maximum(_deviations(own, codes, "shape"), _deviations(own - other, codes, "shape", False))}
    values = dict(measures or {})
    if notes is not None:
        values["repairs"], rare = _repairs(notes)
    usual: dict[str, Values] = {}
    for name, one in values.items():
        usual[name] = _centres(one, codes, name == "volume")
        away = _deviations(one, codes, name, name == "volume")
        scores[name] = np.abs(away) if name in ("volume", "spacing") else away
    found = []
    for i, label in enumerate(labels):
        of_body = {name: float(np.nan_to_num(one[i], nan=0.0)) for name, one in scores.items()}
        worst = max(of_body, key=lambda name: of_body[name])
        among = str(names[nearest[i]]) if own[i] > other[i] else None
        told = _SAYS[worst]
        if worst != "shape":
            value, centre = float(values[worst][i]), float(usual[worst][i])
            text = "; ".join(rare[i]) if worst == "repairs" else ""
            told = told.format(value=value, usual=centre, ratio=np.exp(min(value - centre, 50)), notes=text)
        reason = told if of_body[worst] > LIMIT else "nothing unusual"
        if among is not None:
            reason += f"; labelled {label}, lies among {among}"
        found.append(Outlier(i, label, of_body[worst], of_body, among, reason))
    return sorted(found, key=lambda one: -one.score)


def measures_of(dataset: SignatureDataset, *, n_workers: int | None = None) -> dict[str, Values]:
    """What segmentations go wrong in, of each body: NaN where its mesh cannot be read again.

    "volume" and "spacing", the side of a voxel or else the root of the area of a face, as logarithms; "handles" of the
    surface; "flat", the largest share of the surface that lies in one plane.

    Args:
        dataset: N bodies.
        n_workers: processes; all cores if None.
    """
    found = np.full((len(dataset), 4), np.nan)
    with contextlib.closing(
        run(partial(_measures, dataset.pipeline), list(dataset.bodies), n_workers=n_workers)
    ) as all_:
        for i, outcome in all_:
            if not isinstance(outcome, Failed):
                found[i] = outcome
    return dict(zip(("volume", "spacing", "handles", "flat"), found.T, strict=True))


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


def _measures(pipeline: SignaturePipeline, body: BodyRef) -> tuple[float, float, float, float]:
    ((_, raw),) = each_surface(body.path, pipeline.reading, parts=[body.part])
    mesh = surface_body(raw, body, pipeline.reading, least_vertices=pipeline.config.n_vertices_read)
    spacing = np.log(mesh.area / len(mesh.faces)) / 2
    if raw.voxels is not None:  # the surface of a label has as many faces as its form needs, on any grid
        spacing = np.log(mesh.volume / raw.voxels().n_voxels) / 3
    return float(np.log(mesh.volume)), float(spacing), float(mesh.genus), flat_share(mesh)


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


def _others(values: Values, codes: NDArray[np.int64], within: bool, i: int) -> Values:
    """The values that body i is compared with: of its class where that says enough, or must; else of all."""
    mine = codes == codes[i]
    mine[i] = False
    if not within and np.isfinite(values[mine]).sum() < _ENOUGH - 1:
        mine = np.arange(len(values)) != i
    found: Values = values[mine & np.isfinite(values)]
    return found


def _centres(values: Values, codes: NDArray[np.int64], within: bool) -> Values:
    compared = (_others(values, codes, within, i) for i in range(len(values)))
    return np.array([np.median(one) if len(one) else np.nan for one in compared])


def _deviations(values: Values, codes: NDArray[np.int64], name: str, within: bool = True) -> Values:
    """How many robust standard deviations values are above the median of those that they are compared with."""
    away = values - _centres(values, codes, within)
    usual = np.abs(away[np.isfinite(away)])
    pooled = max(_LEAST[name], _NORMAL * float(np.median(usual)) if len(usual) else 0)
    found = np.full(len(values), np.nan)
    for i in np.flatnonzero(np.isfinite(away)).tolist():
        others = _others(values, codes, within, i)
        scatter = _NORMAL * np.median(np.abs(others - np.median(others)))
        variance = (len(others) * scatter**2 + _PRIOR * pooled**2) / (len(others) + _PRIOR)
        found[i] = away[i] / max(_LEAST[name], np.sqrt(variance))
    return found


def _repairs(notes: Sequence[Sequence[str]]) -> tuple[Values, list[list[str]]]:
    """Of each body, how many notes it has whose like fewer than a quarter of all have, and these."""
    kinds = [[re.sub(r"[\d.,]+", "n", note) for note in of_body] for of_body in notes]
    counts = Counter(kind for of_body in kinds for kind in set(of_body))
    rare = [
        [note for note, kind in zip(of_body, of_kind, strict=True) if counts[kind] < len(notes) / 4]
        for of_body, of_kind in zip(notes, kinds, strict=True)
    ]
    return np.array([2.0 * len(one) for one in rare]), rare

"""The numbers that the page of results is drawn from, as its scripts read them."""

import base64
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from igps._arrays import Integers
from igps.analysis.clusters import STABLE, clusters_of
from igps.analysis.map import body_map
from igps.report.explanations import Painted
from igps.report.results import Results, System
from igps.report.surfaces import PageSurface
from igps.retrieval import RetrievalScores, precision_recall_curve, retrieval_scores

N_WORST = 20
"""How many of the rankings that are most wrong the page shows at most."""
_N_WRONG = 3
_LEAST_RANKED = 48
_DECIMALS = 5
_OF_QUERIES = ("nn", "ft", "st", "map")
# Fewer are no map; more take too long to lay out, and no browser draws them well
_LEAST_MAPPED, _MOST_MAPPED = 3, 3000


def data_of(
    results: Results, surfaces: Mapping[str, PageSurface], explanations: Mapping[str, Painted] | None = None
) -> dict[str, Any]:
    """All numbers of the page but the surfaces themselves; for `shapes` see `_shapes`, for `systems` `_of_system`."""
    classes = sorted(set(results.labels or ()))
    index = {name: i for i, name in enumerate(results.names)}
    sizes = Counter(results.labels or ())
    # As long as a second tier is.
    n_ranked = max(_LEAST_RANKED, 2 * max(sizes.values(), default=0))
    return {
        "classes": classes,
        "shapes": _shapes(results, surfaces, classes, explanations or {}),
        "columns": {name: [of.get(one) for one in results.names] for name, of in results.columns.items()},
        "systems": [_of_system(system, index, classes, n_ranked) for system in results.systems],
        "movements": finite((results.robustness or {}).get("movements", {})),
    }


def letters(content: bytes) -> str:
    """Bytes in base 64."""
    return base64.b64encode(content).decode("ascii")


def _shapes(
    results: Results, surfaces: Mapping[str, PageSurface], classes: Sequence[str], explanations: Mapping[str, Painted]
) -> list[dict[str, Any]]:
    """Of each body its name, class, notes and surface: place among the surfaces and numbers of vertices and faces.

    Of one of several in a file, its part and the others of the file by their numbers. Where that is explained, how it
    differs from its nearest: `other`, `told`, and `values` of the vertices of both surfaces.
    """
    found, place = [], 0
    files: dict[str, list[int]] = {}
    for i, name in enumerate(results.names):
        if name in results.parts:
            files.setdefault(name.removesuffix(f"#{results.parts[name]}"), []).append(i)
    together = {i: [j for j in bodies if j != i] for bodies in files.values() for i in bodies}
    for i, name in enumerate(results.names):
        shape: dict[str, Any] = {
            "name": name,
            "label": classes.index(results.labels[i]) if results.labels else -1,
            "notes": list(results.notes.get(name, ())),
        }
        if i in together:
            shape.update(part=results.parts[name], together=together[i])
        if name in surfaces:
            one = surfaces[name]
            shape["surface"] = [place, len(one.vertices), len(one.faces)]
            shape["mesh"] = [one.n_vertices, one.n_faces, _significant(one.area), _significant(one.volume)]
            shape["unit"] = one.unit
            shape["potential"] = [_significant(value) for value in one.potential_range]
            place += 1
        if name in explanations:
            painted = explanations[name]
            values = [letters(one.tobytes()) for one in painted.values]
            other = results.names.index(painted.other)
            shape["explained"] = {"other": other, "told": painted.told, "values": values}
        found.append(shape)
    return found


def _of_system(system: System, index: Mapping[str, int], classes: Sequence[str], n_ranked: int) -> dict[str, Any]:
    """Of a descriptor: `shapes` it describes as numbers among all; for each of them the nearest others, uint32 (N, top)
    `ranked` and float32 (N, top) `distances`; mean scores, those of each class and each query; confusion, curve; the
    `worst` confusions, see `_worst`; the `map`, see `_map`."""
    order = system.ranked()
    near = order[:, :n_ranked]
    places = np.array([index[name] for name in system.names])
    distances = np.take_along_axis(system.distances.numpy(), near, axis=1)
    scored: dict[str, Any] = dict.fromkeys(("scores", "per_class", "per_query", "curve", "worst"))
    if system.labels is not None and len(set(system.labels)) < len(system.labels):  # two share a class
        scores = retrieval_scores(system.distances, system.labels)
        curve = precision_recall_curve(system.distances, system.labels)
        by_class = {str(label): values for label, values in scores.per_class().items()}
        numbers = {
            "scores": scores.mean(),
            "per_class": [by_class.get(name) for name in classes],
            "per_query": {one: getattr(scores, one).tolist() for one in _OF_QUERIES},
            "curve": [curve.recall.tolist(), curve.precision.tolist()],
        }
        scored = {**finite(numbers, _DECIMALS), "worst": _worst(system, order, scores, places)}
    return {
        "name": system.name,
        "seconds": system.seconds_per_mesh,
        "shapes": places.tolist(),
        "top": near.shape[1],
        "ranked": letters(places[near].astype("<u4").tobytes()),
        "distances": letters(distances.astype("<f4").tobytes()),
        **scored,
        "confusion": None if system.labels is None else _confusion(order, system.labels, classes),
        "map": _map(system),
    }


def _map(system: System) -> dict[str, Any] | None:
    """Where the shapes lie, (N, 2) `points` and the `stress`; the `cluster` of each, the `stability` of these, of which
    `n_stable` are stable; and the `tree`: of each joining, the lowest first, two branches and their distance; rows come
    before joinings."""
    distances = system.distances.double().numpy()
    if not _LEAST_MAPPED <= len(distances) <= _MOST_MAPPED or not np.isfinite(distances).all():
        return None
    found, clusters = body_map(distances), clusters_of(distances, n_resamples=50)
    extent = float(np.ptp(found.points, axis=0).max()) or 1.0
    return {
        "points": ((found.points - found.points.min(axis=0)) / extent).round(4).tolist(),
        "stress": round(found.stress, 3),
        "cluster": clusters.labels.tolist(),
        "stability": finite(clusters.stability, _DECIMALS),
        "n_stable": sum(one >= STABLE for one in clusters.stability),
        "tree": [[int(one), int(other), _significant(height)] for one, other, height, _ in clusters.tree.tolist()],
    }


def _confusion(order: Integers, labels: Sequence[str], classes: Sequence[str]) -> dict[str, list[list[int]]] | None:
    """(C, C) how many shapes of a class (row) have their nearest in a class (column), and so for their first tiers."""
    if not order.size:
        return None
    codes = np.array([classes.index(label) for label in labels])
    sizes = np.bincount(codes, minlength=len(classes))[codes] - 1
    nearest, tier = np.zeros((2, len(classes), len(classes)), dtype=np.int64)
    np.add.at(nearest, (codes, codes[order[:, 0]]), 1)
    rows, columns = np.nonzero(np.arange(order.shape[1]) < sizes[:, None])
    np.add.at(tier, (codes[rows], codes[order[rows, columns]]), 1)
    return {"nearest": nearest.tolist(), "tier": tier.tolist()}


def _worst(system: System, order: Integers, scores: RetrievalScores, places: Integers) -> list[dict[str, Any]]:
    """The queries whose rankings are most wrong, at most twenty, the worst first; ranks count from 1.

    The later the first shape of the query's class comes, the worse; then the lower the first tier; then by name. So a
    query whose nearest is right comes after all others, and one whose whole first tier is right is no confusion.

    Of each `query`, its number among all shapes; the `rank` of the first shape of its class; the ranks of the `wrong`
    ones before that, or where that is the nearest, of those in the first tier: at most three.
    """
    _, codes = np.unique(np.asarray(system.labels), return_inverse=True)
    first_tier = scores.ft.numpy()  # NaN for a shape without another of its class
    queries = np.flatnonzero(first_tier < 1).tolist()
    right = codes[order[queries]] == codes[queries][:, None]
    ranks = (right.argmax(axis=1) + 1).tolist()
    worst = sorted(range(len(queries)), key=lambda i: (-ranks[i], first_tier[queries[i]], system.names[queries[i]]))
    found = []
    for i in worst[:N_WORST]:
        wrong = np.flatnonzero(~right[i, : ranks[i] - 1 or int(right[i].sum())])[:_N_WRONG] + 1
        found.append({"query": int(places[queries[i]]), "rank": ranks[i], "wrong": wrong.tolist()})
    return found


def finite(value: Any, decimals: int | None = None) -> Any:
    """The same, perhaps rounded, with None for numbers that JSON does not know, as of a score that is not defined."""
    if isinstance(value, Mapping):
        return {name: finite(one, decimals) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one, decimals) for one in value]
    if not isinstance(value, float):
        return value
    return (value if decimals is None else round(value, decimals)) if math.isfinite(value) else None


def _significant(value: float) -> float:
    return float(f"{value:.4g}")

"""The data of the page of results, in the form that its scripts read."""

import base64
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from igps._arrays import Integers
from igps.analysis.clusters import STABLE, clusters_of
from igps.analysis.map import body_map
from igps.report.pictures import PageSurface
from igps.report.results import Results, System
from igps.retrieval import RetrievalScores, precision_recall_curve, retrieval_scores

N_WORST = 20
"""Largest number of queries among the worst confusions on the page."""
_N_WRONG = 3  # shapes of other classes that are shown for each of these queries
_MIN_RANKED = 48  # shortest ranking of a query
_DECIMALS = 5
_MAX_FILTERED = 30  # different values of a column, of which one can be chosen
_QUERY_SCORES = ("nn", "ft", "st", "map")  # scores that are shown for each query
# Shapes of a map; more take too long to lay out and to draw in a browser
_MIN_MAPPED = 3
_MAX_MAPPED = 3000


def data_of(results: Results, surfaces: Mapping[str, PageSurface]) -> dict[str, Any]:
    """Return the data of the page without its surfaces; for `shapes` see `_shapes`, for `systems` `_system_data`."""
    sizes = Counter(results.labels or ())
    classes = sorted(sizes)
    index = {name: i for i, name in enumerate(results.names)}
    largest = max(sizes.values(), default=0)
    n_ranked = max(_MIN_RANKED, 2 * largest)  # covers the second tier of every class
    columns = {}
    for title, column in results.columns.items():
        columns[title] = [column.get(name) for name in results.names]
    return {
        "classes": classes,
        "shapes": _shapes(results, surfaces, classes),
        "columns": columns,
        "systems": [_system_data(system, index, classes, n_ranked) for system in results.systems],
        "filters": _filters(results),
    }


def _filters(results: Results) -> dict[str, list[str]]:
    """Return the values by which shapes can be chosen, by the column of labels.csv; none of a column of many values."""
    filters = {}
    for title, column in results.columns.items():
        values = sorted({value for value in column.values() if value is not None})
        if 1 < len(values) <= _MAX_FILTERED:
            filters[title] = values
    return filters


def base64_text(content: bytes) -> str:
    """Encode bytes in base 64."""
    return base64.b64encode(content).decode("ascii")


def _shapes(
    results: Results,
    surfaces: Mapping[str, PageSurface],
    classes: Sequence[str],
) -> list[dict[str, Any]]:
    """Return the data of each body.

    Every body has its `name`, `label` (index of its class), and `notes`. A body with a surface has `surface` (index
    among the surfaces, numbers of vertices and of faces), `mesh` (measures of the original mesh), `unit`, `frame`, and
    the range of the `potential`. One of several bodies in a file has its `part` and the indices of the others,
    `together`.
    """
    files: dict[str, list[int]] = {}
    for i, name in enumerate(results.names):
        if name in results.parts:
            file = name.removesuffix(f"#{results.parts[name]}")
            files.setdefault(file, []).append(i)
    shapes: list[dict[str, Any]] = []
    for name in results.names:
        shapes.append({"name": name, "label": -1, "notes": list(results.notes.get(name, ()))})
    for shape, label in zip(shapes, results.labels or (), strict=False):
        shape["label"] = classes.index(label)
    for bodies in files.values():
        for i in bodies:
            shapes[i]["part"] = results.parts[results.names[i]]
            shapes[i]["together"] = [other for other in bodies if other != i]
    n_surfaces = 0
    for shape in shapes:
        surface = surfaces.get(shape["name"])
        if surface is not None:
            shape |= _surface_data(surface, n_surfaces)
            n_surfaces += 1
    return shapes


def _surface_data(surface: PageSurface, number: int) -> dict[str, Any]:
    """Return what `_shapes` tells of a surface, which is the one of that number on the page."""
    return {
        "surface": [number, len(surface.vertices), len(surface.faces)],
        "mesh": [
            surface.n_vertices,
            surface.n_faces,
            _significant(surface.area),
            _significant(surface.volume),
        ],
        "unit": surface.unit,
        "frame": surface.frame,
        "potential": [_significant(value) for value in surface.potential_range],
    }


def _system_data(
    system: System, index: Mapping[str, int], classes: Sequence[str], n_ranked: int
) -> dict[str, Any]:
    """Return the data of a descriptor.

    These are the `shapes` that it describes (indices among all shapes); for each of them the `top` nearest others,
    `ranked` (uint32) and their `distances` (float32), both (N, top); mean scores, scores per class and per query, and
    the precision–recall `curve`, of which classes of two have only some, see `_scores_of_pairs`; the `confusion`, see
    `_confusion`; the `worst` confusions, see `_worst`; and the `map`, see `_map`.
    """
    order = system.ranked()
    nearest = order[:, :n_ranked]
    indices = np.array([index[name] for name in system.names])
    distances = np.take_along_axis(system.distances.numpy(), nearest, axis=1)
    scored: dict[str, Any] = dict.fromkeys(("scores", "per_class", "per_query", "curve", "worst"))
    labels = system.labels
    if labels is not None and len(set(labels)) < len(labels):  # some share a class
        scores = retrieval_scores(system.distances, labels)
        numbers = _scores_of_pairs(scores)
        if not scores.has_single_answers:
            numbers = _scores_of_classes(scores, system, classes)
        scored |= finite(numbers, _DECIMALS)
        scored["worst"] = _worst(system, order, scores, indices)
    return {
        "name": system.name,
        "seconds": system.seconds_per_mesh,
        "shapes": indices.tolist(),
        "top": nearest.shape[1],
        "ranked": base64_text(indices[nearest].astype("<u4").tobytes()),
        "distances": base64_text(distances.astype("<f4").tobytes()),
        **scored,
        "confusion": None if labels is None else _confusion(order, labels, classes),
        "map": _map(system),
    }


def _scores_of_classes(
    scores: RetrievalScores, system: System, classes: Sequence[str]
) -> dict[str, Any]:
    curve = precision_recall_curve(system.distances, system.labels or ())
    by_class = {str(label): values for label, values in scores.per_class().items()}
    return {
        "scores": scores.mean(),
        "per_class": [by_class.get(name) for name in classes],
        "per_query": {name: getattr(scores, name).tolist() for name in _QUERY_SCORES},
        "curve": [curve.recall.tolist(), curve.precision.tolist()],
    }


def _scores_of_pairs(scores: RetrievalScores) -> dict[str, Any]:
    """Return what suits queries with one other shape of their class: tiers, curves and classes would tell no more."""
    ranks = 1 / scores.map
    return {
        "scores": scores.single_answers(),
        "per_query": {"nn": scores.nn.tolist(), "rank": ranks.tolist()},
    }


def _map(system: System) -> dict[str, Any] | None:
    """Return the map and the clusters of the shapes that a descriptor describes; None if there are too few or too many.

    The map has `points` (N, 2) and its `stress`; each shape has a `cluster`, and each cluster its `stability`, of which
    `n_stable` are stable. The `tree` lists the two children of each node and their distance, the lowest node first: a
    child below N is a shape, and child N + i is node i.
    """
    distances = system.distances.double().numpy()
    if not _MIN_MAPPED <= len(distances) <= _MAX_MAPPED:
        return None
    if not np.isfinite(distances).all():
        return None
    layout = body_map(distances)
    low = layout.points.min(axis=0)
    extent = float(np.ptp(layout.points, axis=0).max()) or 1.0
    points = (layout.points - low) / extent
    clusters = clusters_of(distances, n_resamples=50)
    tree = []
    for one, other, height, _ in clusters.tree.tolist():
        tree.append([int(one), int(other), _significant(height)])
    return {
        "points": points.round(4).tolist(),
        "stress": round(layout.stress, 3),
        "cluster": clusters.labels.tolist(),
        "stability": finite(clusters.stability, _DECIMALS),
        "n_stable": sum(stability >= STABLE for stability in clusters.stability),
        "tree": tree,
    }


def _confusion(
    order: Integers, labels: Sequence[str], classes: Sequence[str]
) -> dict[str, list[list[int]]] | None:
    """Count (C, C) the nearest shapes, and the first tiers, of each class of queries (row) by their class (column)."""
    if not order.size:
        return None
    codes = np.array([classes.index(label) for label in labels])
    found = codes[order]  # the class at each rank of each query
    n_others = np.bincount(codes)[codes] - 1  # of the class of each query
    ranks = np.arange(order.shape[1])
    queries, in_tier = np.nonzero(ranks < n_others[:, None])
    nearest, tier = np.zeros((2, len(classes), len(classes)), dtype=np.int64)
    np.add.at(nearest, (codes, found[:, 0]), 1)
    np.add.at(tier, (codes[queries], found[queries, in_tier]), 1)
    return {"nearest": nearest.tolist(), "tier": tier.tolist()}


def _worst(
    system: System, order: Integers, scores: RetrievalScores, indices: Integers
) -> list[dict[str, Any]]:
    """Return the queries with the worst rankings, at most `N_WORST`, the worst first.

    The lower the first shape of the query's class is ranked, the worse is the ranking; ties are ordered by the first
    tier, then by name. Queries whose whole first tier is correct are left out. Each has the `query` (index among all
    shapes), the `rank` of the first shape of its class, from 1, and the ranks of at most three `wrong` shapes: those
    before the first shape of the class or, if this is the nearest, those in the first tier.
    """
    _, codes = np.unique(np.asarray(system.labels), return_inverse=True)
    is_relevant = codes[order] == codes[:, None]
    ranks = (is_relevant.argmax(axis=1) + 1).tolist()
    first_tier = scores.ft.numpy()  # NaN for a shape that is alone in its class

    def badness(query: int) -> tuple[int, float, str]:
        return (-ranks[query], first_tier[query], system.names[query])

    queries = np.flatnonzero(first_tier < 1).tolist()
    queries.sort(key=badness)
    worst = []
    for query in queries[:N_WORST]:
        rank = ranks[query]
        n_shown = rank - 1 if rank > 1 else int(is_relevant[query].sum())
        wrong = np.flatnonzero(~is_relevant[query, :n_shown]) + 1
        worst.append(
            {
                "query": int(indices[query]),
                "rank": rank,
                "wrong": wrong[:_N_WRONG].tolist(),
            }
        )
    return worst


def finite(value: Any, decimals: int | None = None) -> Any:
    """Return a copy of nested data with None for numbers that are not finite, for JSON, and optionally rounded."""
    if isinstance(value, Mapping):
        return {name: finite(item, decimals) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item, decimals) for item in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    return value if decimals is None else round(value, decimals)


def _significant(value: float) -> float:
    return float(f"{value:.4g}")

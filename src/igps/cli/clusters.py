"""`igps clusters`, and the map of `igps figure map`."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from igps._arrays import Floats
from igps._parameters import check_at_least
from igps.analysis.clusters import STABLE, Linkage, clusters_of
from igps.analysis.comparison import pair_distances
from igps.analysis.map import Layout, body_map, import_umap
from igps.cli.reading import Folder, described, print_failures
from igps.data.dataset import SignatureDataset
from igps.data.sources import LABELS_FILE, Bodies
from igps.mesh.mesh import millimetres
from igps.report.answers import clusters_figure, map_figure, write_answer


def clusters(
    root: Path,
    descriptor: str = "pretrained",
    n_clusters: int | None = None,
    linkage: Linkage = "average",
    n_resamples: int = 100,
    seed: int = 0,
    out: Path | None = None,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Find clusters of bodies that are alike, without classes, and tell which of them another sample would show again.

    Hierarchical clustering of the descriptor's distances. Of each cluster: its bodies, the one in its middle, its
    classes where they are known, and its stability, from 0 to 1: how much of it comes together again when half of the
    bodies are clustered alone; a single body has none. Below 0.75 it is not to be relied on.

    Args:
        n_clusters: how many; as many as have the largest mean silhouette if not given.
        linkage: two clusters are as far apart as their bodies are on average (average), at most (complete), or at least
            (single).
        n_resamples: random halves of the bodies, for the stability.
        seed: of the random halves.
        out: folder for clusters.csv and clusters.json, and the tree as clusters.svg and clusters.png.
    """
    check_at_least(0, n_resamples=n_resamples, seed=seed)

    def check_number(bodies: Bodies) -> None:
        if n_clusters is not None and not 1 <= n_clusters <= len(bodies):
            raise ValueError(f"n_clusters: expected 1 to {len(bodies)}, the bodies of the folder, got {n_clusters}.")

    dataset, distances, label_of = _compared(root, check_number, descriptor, **reading)
    found = clusters_of(distances, n_clusters, linkage=linkage, n_resamples=n_resamples, seed=seed)
    names, told = dataset.bodies.names, list[dict[str, Any]]()
    print(f"{'cluster':>7}{'bodies':>8}{'stability':>11}  in the middle")
    for number, (middle, stability) in enumerate(zip(found.medoids, found.stability, strict=True)):
        members = np.flatnonzero(found.labels == number)
        classes = Counter(label_of[i] for i in members if label_of[i])
        told.append(
            {"cluster": number + 1, "n_bodies": len(members), "stability": stability, "middle": names[middle],
             "classes": dict(classes.most_common()), "bodies": [names[i] for i in members]}
        )  # fmt: skip
        shown = ", ".join(f"{count} {name}" for name, count in classes.most_common(3)) + ", …" * (len(classes) > 3)
        told_stability = "–" if np.isnan(stability) else f"{stability:.2f}"
        print(f"{number + 1:>7}{len(members):>8}{told_stability:>11}  {names[middle]}" + f" ({shown})" * bool(shown))
    n_stable = sum(one >= STABLE for one in found.stability)
    unknown = f", {n} unknown" if (n := np.isnan(found.stability).sum()) else ""
    print(f"{n_stable} of {len(told)} clusters are stable (at least {STABLE}){unknown}")
    if out is not None:
        rows = [
            {"name": name, "class": label_of[i], "cluster": int(number) + 1, "stability": found.stability[number]}
            for i, (name, number) in enumerate(zip(names, found.labels, strict=True))
        ]
        write_answer(out, "clusters", rows, clusters_figure(found, names))
        print(f"written to {out}")
    return told


def map_bodies(
    root: Path,
    descriptor: str = "pretrained",
    colour: str = "class",
    layout: Layout = "mds",
    seed: int = 0,
    out: Path | None = None,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Draw bodies as points in the plane, near to each other where their distances are small.

    Args:
        colour: class, cluster, volume (in mm³ where the unit is known), or a column of labels.csv.
        layout: mds keeps all distances as well as possible, umap keeps neighbours (needs umap-learn).
        seed: of umap, and of clusters.
        out: folder for map.csv, map.json, map.svg and map.png.
    """

    def values_of(bodies: Bodies) -> list[str] | list[float]:
        """What labels.csv says; nothing where the colour is something else."""
        if colour in ("class", "cluster", "volume"):
            return []
        try:
            return bodies.numbers(colour)
        except ValueError:  # words
            return list(bodies.column(colour))

    check_at_least(0, seed=seed)
    if layout == "umap":
        import_umap()
    dataset, distances, label_of = _compared(root, values_of, descriptor, **reading)
    found, bodies = body_map(distances, layout, seed=seed), dataset.bodies
    values: list[str] | list[float]
    if colour == "class":
        values = label_of
    elif colour == "cluster":
        values = [str(one + 1) for one in clusters_of(distances, n_resamples=0, seed=seed).labels]
    elif colour == "volume":
        values = [one.volume * millimetres(one.unit) ** 3 for one in dataset.signatures()]
    else:
        values = values_of(bodies)
    column = colour if colour not in ("name", "x", "y") else f"{colour} of {LABELS_FILE}"
    rows = [
        {"name": name, "x": x, "y": y, "class": label, column: value}
        for name, (x, y), label, value in zip(bodies.names, found.points.tolist(), label_of, values, strict=True)
    ]
    print(f"{len(rows)} bodies; stress {found.stress:.2f}: 0 keeps every distance, above 0.2 the map distorts much")
    if out is not None:
        write_answer(out, "map", rows, map_figure(found, values, colour))
        print(f"written to {out}")
    return rows


def _compared(
    root: Path, check: Callable[[Bodies], object], descriptor: str, **reading: Any
) -> tuple[SignatureDataset, Floats, list[str]]:
    """The bodies, their distances, and the class of each, "" where that is not known; for `check` see `Folder`."""

    def check_all(bodies: Bodies) -> None:
        if len(bodies) < 3:
            raise ValueError(f"root: expected three bodies or more, {root} has {len(bodies)}. Name a larger folder.")
        check(bodies)

    found = described(Folder(root, check=check_all), descriptor, **reading)
    print_failures(found.failures, len(found.dataset))
    distances = pair_distances(found.descriptor, found.descriptions, progress=True).double().numpy()
    return found.dataset, distances, list(found.dataset.bodies.labels or [""] * len(found.dataset))

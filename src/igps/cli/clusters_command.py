"""The command `igps clusters`."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from igps._parameters import check_at_least, check_seed

if TYPE_CHECKING:
    from igps.analysis.clusters import Clusters
    from igps.data.dataset import SignatureDataset
    from igps.data.sources import Bodies

_OWN_COLOURS = ("cluster", "class", "volume")


def clusters(
    root: Path,
    descriptor: str = "pretrained",
    n_clusters: int | None = None,
    linkage: Literal["average", "complete", "single"] = "average",
    n_resamples: int = 100,
    colour: str = "cluster",
    layout: Literal["mds", "umap"] = "mds",
    seed: int = 0,
    out: Path | None = None,
    **describing: Any,
) -> list[dict[str, Any]]:
    """Find clusters of similar bodies without using classes, measure how stable each is, and draw a map of the bodies.

    The descriptor's distances are clustered hierarchically. The table shows the bodies of each cluster, its medoid, its
    classes where they are known, and its stability from 0 to 1: how well the cluster is found again when only a random
    half of the bodies is clustered. Clusters with a stability below 0.75 are not reliable. A single body has none. On
    the map, each body is a point in the plane, and similar bodies lie close together.

    Args:
        n_clusters: number of clusters; by default the number with the largest mean silhouette.
        linkage: distance between two clusters: the mean (average), largest (complete) or smallest (single) distance
            between their bodies.
        n_resamples: number of random halves of the bodies, for the stability.
        colour: of the map: cluster, class, volume (in mm³ where the unit is known), or a column of labels.csv.
        layout: of the map: mds preserves all distances as well as possible, umap preserves neighbours (needs
            umap-learn).
        seed: seed of the random halves and of umap.
        out: folder for clusters.csv and clusters.json with the cluster of each body and its place on the map, the tree
            as clusters.svg and clusters.png, and the map as map.svg and map.png.
    """
    from igps._progress import number_bars
    from igps.analysis.clusters import STABLE, clusters_of
    from igps.analysis.comparison import pair_distances
    from igps.analysis.map import body_map, import_umap
    from igps.cli.reading import Folder, described
    from igps.data.sources import LABELS_FILE
    from igps.report.figures import clusters_figure, map_figure, save_both, write_analysis
    from igps.report.tables import text_table

    check_at_least(0, n_resamples=n_resamples)
    check_seed(seed)
    if layout == "umap":
        import_umap()

    def check(bodies: Bodies) -> None:
        if len(bodies) < 3:
            raise ValueError(
                f"root: expected three bodies or more, {root} has {len(bodies)}. Choose a larger folder."
            )
        if n_clusters is not None and not 1 <= n_clusters <= len(bodies):
            raise ValueError(
                f"n_clusters: expected 1 to {len(bodies)}, the bodies of the folder, got {n_clusters}."
            )
        if colour not in _OWN_COLOURS:
            bodies.column(colour)

    number_bars(3)
    described_bodies = described(Folder(root, check=check), descriptor, **describing)
    dataset = described_bodies.dataset
    module = described_bodies.descriptor
    tensor = pair_distances(module, described_bodies.descriptions, progress=True)
    distances = tensor.double().numpy()
    found = clusters_of(distances, n_clusters, linkage=linkage, n_resamples=n_resamples, seed=seed)
    places = body_map(distances, layout, seed=seed)
    table = _rows(dataset, found)
    cells = []
    for row in table:
        largest = list(row["classes"].items())[:3]
        classes = [f"{count} {name}" for name, count in largest] + ["…"] * (len(row["classes"]) > 3)
        stability = "–" if row["stability"] is None else f"{row['stability']:.2f}"
        numbers = (row["cluster"], row["n_bodies"], stability)
        cells.append((*numbers, row["middle"], ", ".join(classes)))
    titles = ("cluster", "bodies", "stability", "medoid", "classes")
    print(text_table(titles, cells, left=("medoid", "classes")))
    known = [row["stability"] for row in table if row["stability"] is not None]
    n_stable = sum(stability >= STABLE for stability in known)
    n_unknown = len(table) - len(known)
    unknown = f", {n_unknown} unknown" if n_unknown else ""
    print(f"{n_stable} of {len(table)} clusters are stable (at least {STABLE}){unknown}")
    print(f"map: stress {places.stress:.2f} (0: exact distances; above 0.2: strong distortion)")
    if out is not None:
        columns: dict[str, Any] = {
            "name": dataset.bodies.names,
            "class": _classes(dataset),
            "cluster": [int(number) + 1 for number in found.labels],
            "stability": [found.stability[number] for number in found.labels],
            "x": places.points[:, 0].tolist(),
            "y": places.points[:, 1].tolist(),
        }
        if colour == "class":
            values = columns["class"]
        elif colour == "cluster":
            values = [str(number) for number in columns["cluster"]]
        else:
            values = _further(dataset, colour)
            columns[f"{colour} of {LABELS_FILE}" if colour in columns else colour] = values
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        write_analysis(out, "clusters", rows, clusters_figure(found, dataset.bodies.names))
        save_both(map_figure(places, values, colour), out / "map")
        print(f"written to {out}")
    return table


def _rows(dataset: SignatureDataset, found: Clusters) -> list[dict[str, Any]]:
    """Return a row for each cluster, the largest first; a stability that was not measured is None."""
    names = dataset.bodies.names
    classes = _classes(dataset)
    rows = []
    for number, (medoid, stability) in enumerate(zip(found.medoids, found.stability, strict=True)):
        members = [i for i, label in enumerate(found.labels) if label == number]
        counts = Counter(classes[i] for i in members if classes[i])
        rows.append(
            {
                "cluster": number + 1,
                "n_bodies": len(members),
                "stability": None if math.isnan(stability) else stability,
                "middle": names[medoid],
                "classes": dict(counts.most_common()),
                "bodies": [names[i] for i in members],
            }
        )
    return rows


def _classes(dataset: SignatureDataset) -> list[str]:
    """Return the class of each body, "" where it is unknown."""
    return list(dataset.bodies.labels or [""] * len(dataset))


def _further(dataset: SignatureDataset, colour: str) -> list[str] | list[float]:
    """Return the volumes of bodies, or their values in a column of labels.csv, as numbers where all are numbers."""
    from igps.mesh.mesh import millimetres

    if colour == "volume":
        return [one.volume * millimetres(one.unit) ** 3 for one in dataset.signatures()]
    try:
        return dataset.bodies.numbers(colour)
    except ValueError:
        return list(dataset.bodies.column(colour))

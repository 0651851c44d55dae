"""The commands `igps clusters` and `igps map`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from igps._parameters import check_at_least, check_seed

if TYPE_CHECKING:
    from igps._arrays import Floats
    from igps.data.dataset import SignatureDataset
    from igps.data.sources import Bodies


def clusters(
    root: Path,
    descriptor: str = "pretrained",
    n_clusters: int | None = None,
    linkage: Literal["average", "complete", "single"] = "average",
    n_resamples: int = 100,
    seed: int = 0,
    out: Path | None = None,
    **describing: Any,
) -> list[dict[str, Any]]:
    """Find clusters of similar bodies without using classes, and measure how stable each cluster is.

    The descriptor's distances are clustered hierarchically. The table shows the bodies of each cluster, its medoid, its
    classes where they are known, and its stability from 0 to 1: how well the cluster is found again when only a random
    half of the bodies is clustered. Clusters with a stability below 0.75 are not reliable. A single body has none.

    Args:
        n_clusters: number of clusters; by default the number with the largest mean silhouette.
        linkage: distance between two clusters: the mean (average), largest (complete) or smallest (single) distance
            between their bodies.
        n_resamples: number of random halves of the bodies, for the stability.
        seed: seed of the random halves.
        out: folder for clusters.csv and clusters.json, and the tree as clusters.svg and clusters.png.
    """
    import numpy as np

    from igps.analysis.clusters import STABLE, clusters_of
    from igps.report.figures import clusters_figure, write_analysis

    check_at_least(0, n_resamples=n_resamples)
    check_seed(seed)

    def check_number(bodies: Bodies) -> None:
        if n_clusters is not None and not 1 <= n_clusters <= len(bodies):
            raise ValueError(
                f"n_clusters: expected 1 to {len(bodies)}, the bodies of the folder, got {n_clusters}."
            )

    dataset, distances, labels = _distances(root, check_number, descriptor, **describing)
    result = clusters_of(distances, n_clusters, linkage=linkage, n_resamples=n_resamples, seed=seed)
    names = dataset.bodies.names
    table = list[dict[str, Any]]()
    print(f"{'cluster':>7}{'bodies':>8}{'stability':>11}  medoid (classes)")
    for number, (medoid, stability) in enumerate(
        zip(result.medoids, result.stability, strict=True)
    ):
        members = np.flatnonzero(result.labels == number)
        classes = Counter(labels[i] for i in members if labels[i])
        table.append(
            {
                "cluster": number + 1,
                "n_bodies": len(members),
                "stability": stability,
                "middle": names[medoid],
                "classes": dict(classes.most_common()),
                "bodies": [names[i] for i in members],
            }
        )
        shown = ", ".join(f"{count} {name}" for name, count in classes.most_common(3)) + ", …" * (
            len(classes) > 3
        )
        stability_text = "–" if np.isnan(stability) else f"{stability:.2f}"
        print(
            f"{number + 1:>7}{len(members):>8}{stability_text:>11}  {names[medoid]}"
            + f" ({shown})" * bool(shown)
        )
    n_stable = sum(stability >= STABLE for stability in result.stability)
    unknown = f", {n} unknown" if (n := np.isnan(result.stability).sum()) else ""
    print(f"{n_stable} of {len(table)} clusters are stable (at least {STABLE}){unknown}")
    if out is not None:
        rows = [
            {
                "name": name,
                "class": label,
                "cluster": int(number) + 1,
                "stability": result.stability[number],
            }
            for name, label, number in zip(names, labels, result.labels, strict=True)
        ]
        write_analysis(out, "clusters", rows, clusters_figure(result, names))
        print(f"written to {out}")
    return table


def map_bodies(
    root: Path,
    descriptor: str = "pretrained",
    colour: str = "class",
    layout: Literal["mds", "umap"] = "mds",
    seed: int = 0,
    out: Path | None = None,
    **describing: Any,
) -> list[dict[str, Any]]:
    """Draw a map of bodies as points in the plane, in which similar bodies lie close together.

    Args:
        colour: class, cluster, volume (in mm³ where the unit is known), or a column of labels.csv.
        layout: mds preserves all distances as well as possible, umap preserves neighbours (needs umap-learn).
        seed: seed of umap.
        out: folder for map.csv, map.json, map.svg and map.png.
    """
    from igps.analysis.clusters import clusters_of
    from igps.analysis.map import body_map, import_umap
    from igps.data.sources import LABELS_FILE
    from igps.mesh.mesh import millimetres
    from igps.report.figures import map_figure, write_analysis

    def column_values(bodies: Bodies) -> list[str] | list[float]:
        """Return the column of labels.csv with the name `colour`; an empty list if the colour is not a column."""
        if colour in ("class", "cluster", "volume"):
            return []
        try:
            return bodies.numbers(colour)
        except ValueError:  # a categorical column
            return list(bodies.column(colour))

    check_seed(seed)
    if layout == "umap":
        import_umap()
    dataset, distances, labels = _distances(root, column_values, descriptor, **describing)
    result = body_map(distances, layout, seed=seed)
    bodies = dataset.bodies
    values: list[str] | list[float]
    if colour == "class":
        values = labels
    elif colour == "cluster":
        values = [
            str(number + 1) for number in clusters_of(distances, n_resamples=0, seed=seed).labels
        ]
    elif colour == "volume":
        values = [
            signature.volume * millimetres(signature.unit) ** 3
            for signature in dataset.signatures()
        ]
    else:
        values = column_values(bodies)
    column = colour if colour not in ("name", "x", "y") else f"{colour} of {LABELS_FILE}"
    rows = [
        {"name": name, "x": x, "y": y, "class": label, column: value}
        for name, (x, y), label, value in zip(
            bodies.names, result.points.tolist(), labels, values, strict=True
        )
    ]
    print(
        f"{len(rows)} bodies; stress {result.stress:.2f} (0: exact distances; above 0.2: strong distortion)"
    )
    if out is not None:
        write_analysis(out, "map", rows, map_figure(result, values, colour))
        print(f"written to {out}")
    return rows


def _distances(
    root: Path, check: Callable[[Bodies], object], descriptor: str, **describing: Any
) -> tuple[SignatureDataset, Floats, list[str]]:
    """Return the bodies, their distances (N, N) and their classes, "" where unknown; for `check` see `Folder`."""
    from igps.analysis.comparison import pair_distances
    from igps.cli.reading import Folder, described, print_failures

    def check_all(bodies: Bodies) -> None:
        if len(bodies) < 3:
            raise ValueError(
                f"root: expected three bodies or more, {root} has {len(bodies)}. Choose a larger folder."
            )
        check(bodies)

    result = described(Folder(root, check=check_all), descriptor, **describing)
    print_failures(result.failures, len(result.dataset))
    distances = (
        pair_distances(result.descriptor, result.descriptions, progress=True).double().numpy()
    )
    return (
        result.dataset,
        distances,
        list(result.dataset.bodies.labels or [""] * len(result.dataset)),
    )

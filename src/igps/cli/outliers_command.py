"""The command `igps outliers`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igps._parameters import check_at_least


def outliers(
    root: Path,
    descriptor: str = "pretrained",
    top: int = 20,
    out: Path | None = None,
    **describing: Any,
) -> list[dict[str, Any]]:
    """List the bodies that are most unlike their class, to review before the collection is used.

    Each body is compared with the others of its class by its shape, volume and resolution; a mesh also by its handles,
    flat sides and repairs; a label also by detached pieces, cavities, holes, gaps, cut ends, and overlap with other
    labels. A score counts robust standard deviations; a body with a score above 3.5 is an outlier. The list also names
    the bodies that are nearer to another class than to their own. Bodies that reach the border of their image are
    compared with those that reach it at the same sides.

    Args:
        root: folder with one subfolder per class, or with files and a labels.csv (columns file,label).
        top: number of bodies to list.
        out: folder for outliers.csv and outliers.json with all bodies, and outliers.svg and outliers.png with pictures
            of the highest-scoring bodies.
    """
    from igps.analysis.groups import squared_distances
    from igps.analysis.outliers import LIMIT, measure_bodies
    from igps.analysis.outliers import outliers as find_outliers
    from igps.cli.reading import Folder, described
    from igps.fields.volumes.border import border_of
    from igps.report.figures import outliers_figure, write_analysis
    from igps.report.tables import text_table

    check_at_least(0, top=top)
    result = described(Folder(root, labelled=True), descriptor, **describing)
    dataset = result.dataset
    distances = squared_distances(result.coordinates()) ** 0.5
    measures = measure_bodies(dataset, n_workers=describing.get("n_workers"))
    files = dataset.bodies.paths
    # Where each file holds one mask, a folder holds the organs of one subject
    subjects = files if len(set(files)) < len(files) else [file.parent for file in files]
    borders = [border_of(notes) for notes in dataset.all_notes()]
    sides = [border.sides if border else "" for border in borders]
    if any(sides):
        n_cut = sum(map(bool, sides))
        print(f"{n_cut} of {len(sides)} bodies reach the border of their image: compared apart")
    ranked = find_outliers(
        distances, dataset.bodies.labels or (), measures, dataset.all_notes(), subjects, sides
    )
    names = dataset.bodies.names
    rows: list[dict[str, Any]] = []
    for one in ranked:
        row = {
            "name": names[one.body],
            "class": one.label,
            "score": round(one.score, 3),
            "reason": one.reason,
        }
        for name, value in one.scores.items():
            row[f"score_{name}"] = round(value, 3)
        rows.append(row)
    cells = []
    for row in rows[:top]:
        reason = f"{row['class']}: {row['reason']}"
        cells.append((f"{row['score']:.1f}", row["name"], reason))
    print(text_table(("score", "body", "class: reason"), cells, left=("body", "class: reason")))
    n_outliers = sum(one.is_outlier for one in ranked)
    print(f"{n_outliers} of {len(rows)} bodies are outliers, with a score above {LIMIT}")
    if out is not None:
        pictured = []
        for one in ranked[: min(top, 12)]:
            pictured.append((one, names[one.body], dataset.mesh(one.body)))
        write_analysis(out, "outliers", rows, outliers_figure(pictured) if pictured else None)
        print(f"written to {out}")
    return rows

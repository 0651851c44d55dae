"""The command `igps demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def demo(out: Path = Path("build/demo"), n_workers: int | None = None) -> dict[str, Any]:
    """Generate a small benchmark of articulated shapes, run retrieval on it, and make a map and a page of results.

    Args:
        out: folder for the meshes, the results of igps retrieve and of igps clusters, and report.html.
        n_workers: number of worker processes; by default one for each core.
    """
    from igps._progress import number_bars
    from igps.cli.clusters_command import clusters
    from igps.cli.report_command import report
    from igps.cli.retrieval_commands import retrieve
    from igps.shapes import ArticulatedShapes

    # Fewer vertices than a page shows, so that the loops that simplify surfaces are not compiled for the demo
    shapes = ArticulatedShapes(n_classes=8, n_per_class=10, n_vertices=850)
    shapes.write(out / "shapes", progress=True)
    options: dict[str, Any] = {"out": out, "cache_dir": out / "cache", "n_workers": n_workers}
    summary = retrieve(out / "shapes", **options)
    clusters(out / "shapes", colour="class", **options)
    print(f"map of the shapes: {out / 'map.png'}")
    number_bars(None)
    report(out, n_workers=n_workers)
    return summary

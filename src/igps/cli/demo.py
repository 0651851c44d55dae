"""The command `igps demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def demo(out: Path = Path("build/demo"), n_workers: int | None = None) -> dict[str, Any]:
    """Generate a small benchmark of articulated shapes, run retrieval on it, and save a figure and a page of results.

    Args:
        out: folder for the meshes, the results of igps retrieve, ranked.png and report.html.
        n_workers: number of worker processes; by default one for each core.
    """
    from igps.cli.report import report
    from igps.cli.retrieval import retrieve
    from igps.report.drawing import ranked_results
    from igps.shapes import ArticulatedShapes

    shapes = ArticulatedShapes(n_classes=8, n_per_class=10)
    shapes.write(out / "shapes", progress=True)
    summary = retrieve(out / "shapes", out=out, cache_dir=out / "cache", n_workers=n_workers)
    ranked_results(out / "shapes", out / "ranking.csv", out / "ranked.png", progress=True)
    print(f"ranked results of one query per class: {out / 'ranked.png'}")
    report(out, n_workers=n_workers)
    return summary

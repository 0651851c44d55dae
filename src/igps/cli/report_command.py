"""The command `igps report`, and the option `--report` of other commands."""

from __future__ import annotations

from pathlib import Path


def report(
    results: Path,
    out: Path | None = None,
    meshes: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Make a page of results for the browser, a single self-contained HTML file.

    The page shows rankings, scores, a map of the bodies, and the results of igps groups and igps outliers in the same
    folder. A mesh that no longer exists has no picture.

    Args:
        results: folder that igps retrieve or igps compare wrote (--out).
        out: the page; by default report.html in the folder of results.
        meshes: folder of the meshes, if they were moved since.
        n_workers: number of processes that make the pictures; by default one for each core.
    """
    from igps.report.page import render_page
    from igps.report.pictures import surfaces_of
    from igps.report.results import read_results, read_sources

    if meshes is not None and not meshes.is_dir():
        raise FileNotFoundError(f"meshes: {meshes}: no such folder. Check the path.")
    dataset = read_sources(results, meshes)
    contents = read_results(results)
    surfaces = {} if dataset is None else surfaces_of(dataset, n_workers=n_workers)
    page = out or results / "report.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(render_page(contents, surfaces), encoding="utf-8")
    print(f"page of results: {page}")


def check_report_folder(is_wanted: bool, out: Path | None) -> None:
    """Raise a ValueError if a page is requested without a folder for it, before anything is computed."""
    if is_wanted and out is None:
        raise ValueError("report: expected --out with it, the folder for the page. Add --out.")

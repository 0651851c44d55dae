"""`igps report`, and the `--report` of other commands."""

from pathlib import Path

from igps.descriptors import descriptor as descriptor_of
from igps.report.explanations import keep_explanations, read_explanations
from igps.report.page import page_of
from igps.report.results import read_results, read_sources
from igps.report.surfaces import keep_surfaces, read_surfaces


def report(
    results: Path,
    out: Path | None = None,
    meshes: Path | None = None,
    explain: bool = False,
    n_workers: int | None = None,
) -> None:
    """Make a page of results, to look at in a browser: one HTML file that needs nothing else.

    It has rankings, scores, a map of the bodies, and what `igps groups` and `igps outliers` wrote to the same folder.
    Small pictures of the meshes are kept in the folder, in surfaces.npz. Meshes that are gone by then have no picture.

    Args:
        results: folder that `igps retrieve`, `igps compare` or `python -m training.study robustness` wrote (--out).
        out: the page; report.html in the folder of results if not given.
        meshes: the folder of the meshes, if they were moved since.
        explain: paint where each body differs from its nearest, kept in explanations.npz; takes seconds for each
        n_workers: processes that make the pictures; all cores if not given.
    """
    if meshes is not None and not meshes.is_dir():
        raise FileNotFoundError(f"meshes: {meshes}: no such folder. Check the path.")
    dataset, found = read_sources(results, meshes), read_results(results)
    kept = results / "surfaces.npz"
    surfaces = read_surfaces(kept) if dataset is None else keep_surfaces(kept, dataset, n_workers=n_workers)
    kept = results / "explanations.npz"
    if not explain:
        explanations = read_explanations(kept, surfaces)
    elif dataset is None or len(found.systems) != 1:
        raise ValueError("explain: expected results of `igps retrieve`, which tell a descriptor and its meshes.")
    else:
        (system,), own = found.systems, results / "descriptor.safetensors"
        module = descriptor_of(str(own) if own.is_file() else system.name)
        explanations = keep_explanations(kept, system, dataset, module, surfaces, n_workers=n_workers)
    page = out or results / "report.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(page_of(found, surfaces, explanations), encoding="utf-8")
    print(f"page of results: {page}")


def check_report(is_wanted: bool, out: Path | None) -> None:
    """Raise, before anything is computed, where a page is wanted that could not be made."""
    if is_wanted and out is None:
        raise ValueError("report: expected --out beside it, the folder that the page is written to. Give one.")

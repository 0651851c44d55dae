"""The command `igps doctor`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps.cli.shared_options import Verdict, limits_of
from igps.mesh.options import LoadOptions
from igps.signature.config import SignatureConfig

if TYPE_CHECKING:
    from igps.analysis.doctor import Finding


def doctor(
    root: Path,
    out: Path | None = None,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    attribute: list[str] | None = None,
    cache_dir: Path | None = None,
    **load: Any,
) -> Verdict:
    """Check each body of a folder: list its defects, how they are repaired, and the expected cost of its signature.

    For labels of volumes, also list the number of voxels and of pieces, and the thickness of the thinnest part in
    voxels, up to ten. Remarks tell what was repaired or left out, what is open or in several pieces, and which sides
    the border of the image may have cut; the unit, where it comes from: the header, the format, or a default. Bodies
    are repaired, but no signature is computed. The exit status is 1 if a body cannot be used; empty masks are no fault.

    Args:
        out: CSV file for the findings, with all notes.
    """
    from igps.analysis.doctor import examine
    from igps.data.attribute_sources import attribute_sources
    from igps.data.cache import default_cache_dir
    from igps.data.pipeline import SignaturePipeline
    from igps.data.sources import find_bodies
    from igps.report.tables import findings_table, write_rows

    reading = LoadOptions(**load)
    limits = limits_of(time_limit, memory_limit)
    attributes = attribute_sources(attribute or (), root)
    cache = cache_dir or default_cache_dir()
    bodies = find_bodies(root, reading, attributes=attributes.values(), cache_dir=cache)
    pipeline = SignaturePipeline(signature.resolved(), reading, cache)
    findings = examine(bodies, pipeline, n_workers=n_workers, limits=limits)
    print(findings_table(findings))
    if out is not None:
        rows = [_row(finding) for finding in findings]
        write_rows(out, rows[0], [row.values() for row in rows])
        print(f"written to {out}")
    return Verdict(
        [asdict(finding) for finding in findings],
        all(finding.error is None or finding.summary for finding in findings),
    )


def _row(finding: Finding) -> dict[str, Any]:
    from igps.fields.volumes.border import border_of

    voxels = finding.voxels
    border = border_of(finding.notes)
    return {
        "name": finding.id,
        "usable": "no" if finding.error else "yes",
        "fault": finding.fault,
        "mended_by": " ".join(finding.steps),
        "notes": "; ".join(finding.notes),
        "unit": finding.unit,
        "unit_from": finding.unit_from if finding.unit else None,
        "voxels": voxels.n_voxels if voxels else None,
        "pieces": voxels.n_pieces if voxels else finding.n_pieces,
        "thinnest": voxels.thinnest if voxels else None,
        "at_border": f"{border.share:.4f}" if border else None,
        "border_sides": border.sides if border else None,
        "missing": f"{finding.missing:.4f}",
        "vertices": finding.n_vertices,
        "vertices_after": finding.n_vertices_after,
        "seconds": None if finding.seconds is None else f"{finding.seconds:.1f}",
        "megabytes": None if finding.memory is None else f"{finding.memory / 1e6:.0f}",
        "error": finding.error,
    }

"""`igps doctor`."""

from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any

from igps.analysis.doctor import Finding, examine
from igps.cli.reading import Verdict, limits_of, write_rows
from igps.data.attribute_sources import attribute_sources
from igps.data.sources import find_bodies
from igps.mesh.options import LoadOptions
from igps.report.tables import findings_table
from igps.signature.signature import SignatureConfig

_HEADER = (
    "file", "usable", "fault", "mended_by", "notes", "voxels", "pieces", "thinnest", "vertices", "vertices_after",
    "seconds", "megabytes", "error",
)  # fmt: skip


def doctor(
    root: Path,
    out: Path | None = None,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    allow_open: bool = False,
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    attribute: list[str] | None = None,
    **options: Any,
) -> Verdict:
    """Tell what is wrong with each body of a folder, what will be done about it, and what that will cost.

    Of labels of volumes it tells the number of voxels and of pieces, and how many voxels thick the thinnest part is, up
    to ten. Nothing is computed but the mending. The exit status is 1 if a body cannot be used.

    Args:
        out: a CSV file for the findings, with all notes.
        signature: parameters of the signatures to come.
        attribute: values inside the bodies, such as ct=images/{stem}.nii.gz; these files are not taken as bodies.
    """
    reading, limits = LoadOptions(allow_open=allow_open, **options), limits_of(time_limit, memory_limit)
    bodies = find_bodies(root, reading, attributes=attribute_sources(attribute or (), root).values())
    found = examine(bodies, reading, signature, n_workers=n_workers, limits=limits)
    print(findings_table(found))
    if out is not None:
        write_rows(out, _HEADER, [_row(finding) for finding in found])
        print(f"written to {out}")
    return Verdict([asdict(finding) for finding in found], all(finding.error is None for finding in found))


def _row(finding: Finding) -> tuple[Any, ...]:
    return (
        finding.id,
        "no" if finding.error else "yes",
        finding.fault,
        " ".join(finding.steps),
        "; ".join(finding.notes),
        *(("",) * 3 if finding.voxels is None else astuple(finding.voxels)),
        finding.n_vertices,
        finding.n_vertices_after,
        None if finding.seconds is None else f"{finding.seconds:.1f}",
        None if finding.memory is None else f"{finding.memory / 1e6:.0f}",
        finding.error,
    )

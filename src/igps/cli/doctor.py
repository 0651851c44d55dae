"""`igps doctor`."""

from __future__ import annotations

from dataclasses import asdict, astuple
from pathlib import Path

from igps._parallel import Limits
from igps.analysis.doctor import Finding, examine, usable
from igps.cli.reading import Verdict, write_rows
from igps.data.sources import find_bodies
from igps.mesh.mending import Cavities, Mending
from igps.mesh.options import MAX_UNPACKED, BodyKind, Component, LoadOptions
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
    mend: Mending = "auto",
    component: Component | None = None,
    allow_open: bool = False,
    bodies: BodyKind | None = None,
    names: str | None = None,
    threshold: float = 0.5,
    cavities: Cavities = "fill",
    max_unpacked: int = MAX_UNPACKED,
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
) -> Verdict:
    """Tell what is wrong with each body of a folder, what will be done about it, and what that will cost.

    Of labels of volumes it tells the number of voxels and of pieces, and how many voxels thick the thinnest part is, up
    to ten. Nothing is computed but the mending. The exit status is 1 if a body cannot be used.

    Args:
        root: folder of meshes, with or without classes.
        out: a CSV file for the findings, with all notes.
        signature: parameters of the signatures to come.
        mend: auto does the least that makes a body of each mesh, never refuses what is no body, always makes
            watertight all that does not bound one body without crossing itself.
        component: largest keeps only the largest connected component of each mesh.
        allow_open: accept surfaces with holes
        bodies: what of a file is a body: whole, labels, objects, pieces, chains, models or assembly; the labels of a
            volume, the chains of a molecule and the whole of anything else if not given.
        names: a table of the names of labels; those of the volume, or beside it, if not given.
        threshold: a voxel of at least this probability belongs to the body, in volumes of probabilities.
        cavities: fill takes a hollow body for the full one, keep lets the surfaces of its hollows bound it, too.
        max_unpacked: bytes that a compressed file may unpack to.
        n_workers: processes; all cores if not given.
        time_limit: seconds that one file may take; no limit if not given.
        memory_limit: gigabytes of memory that one file may take; no limit if not given.
    """
    reading = LoadOptions(mend, component, allow_open, bodies, max_unpacked, names, threshold, cavities)
    limits = Limits(time_limit, None if memory_limit is None else int(memory_limit * 1e9))
    found = examine(find_bodies(root, reading), reading, signature, n_workers=n_workers, limits=limits)
    print(findings_table(found))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_rows(out, _HEADER, [_row(finding) for finding in found])
        print(f"written to {out}")
    return Verdict([asdict(finding) for finding in found], usable(found))


def _row(finding: Finding) -> tuple[str, ...]:
    voxels = ("",) * 3 if finding.voxels is None else tuple(map(str, astuple(finding.voxels)))
    return (
        finding.id,
        "no" if finding.error else "yes",
        finding.fault or "",
        " ".join(finding.steps),
        "; ".join(finding.notes),
        *voxels,
        "" if finding.n_vertices is None else str(finding.n_vertices),
        "" if finding.n_vertices_after is None else str(finding.n_vertices_after),
        "" if finding.seconds is None else f"{finding.seconds:.1f}",
        "" if finding.memory is None else f"{finding.memory / 1e6:.0f}",
        finding.error or "",
    )

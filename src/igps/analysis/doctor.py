"""Defects of the bodies in files, the steps that mend them, and the expected cost of their signatures."""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from igps._parallel import run
from igps._progress import Progress
from igps._text import counted
from igps.data.filling import group_by_file
from igps.data.pipeline import SignaturePipeline
from igps.data.sources import Bodies, BodyRef
from igps.failures import Failed, Limits
from igps.fields.volumes.label_measures import VoxelMeasures, measure
from igps.mesh._tidying import closed_by_rims, weld
from igps.mesh.errors import MeshError, NoBodyError
from igps.mesh.loading import each_surface, surface_body
from igps.mesh.mending import Step, repair_steps
from igps.mesh.mesh import check_arrays
from igps.mesh.raw_body import RawBody, UnitSource
from igps.mesh.surface import face_parts

# Seconds and bytes of a signature on one core, by vertices and eigenpairs, as fitted by docs/benchmarks/cost.py to 62
# signatures of 31 generated bodies with 770 to 119,000 vertices, with 50 and 250 eigenpairs. For bodies left out of the
# fit, 97 % of the times are within a factor of 1.5 of the prediction, 90 % within 1.28, and the memory within 1.05. The
# memory includes that of the process before it reads a file; the constant time includes what a process pays once, such
# as loading compiled code. Other processors change all times by a common factor.
_SECONDS, _SECONDS_PER_VERTEX, _SECONDS_PER_ENTRY = 0.468, 2.33e-5, 2.31e-7
_BYTES, _BYTES_PER_VERTEX, _BYTES_PER_ENTRY = 4.57e8, 2820.0, 30.0


# Smaller openings, as share of the surface, are not worth a remark.
_MIN_MISSING = 0.001


@dataclass(frozen=True)
class Finding:
    """Examination of a body before its signature is computed."""

    id: str  # name of the body
    fault: str | None = None  # why the surface in the file does not bound a body; None if it does
    steps: tuple[Step, ...] = ()  # steps that mend it
    notes: tuple[str, ...] = ()  # the same steps as sentences
    # Of the surface in the file, or made from it; None if it cannot be read
    n_vertices: int | None = None
    n_vertices_after: int | None = None  # of the mended body; None if it cannot be used
    seconds: float | None = None  # expected processor time from file to signature
    memory: float | None = None  # expected peak memory, bytes
    error: str | None = None  # why the body cannot be used; None if it can
    summary: str = ""  # such as "empty", of a mask that holds no body, see `MeshError.summary`
    unit: str | None = None  # of length; None if it is unknown
    unit_from: UnitSource | None = None  # what states the unit
    voxels: VoxelMeasures | None = None  # of a label of a volume; None for other bodies
    n_pieces: int | None = None  # of the surface in the file, after welding; None for labels
    missing: float = 0.0  # share of the surface that its openings leave out, see `closed_by_rims`

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know of the body: the notes of a label; else openings, pieces, steps, and notes on no step."""
        if self.voxels is not None:
            return self.notes
        facts: list[str] = []
        if self.n_pieces is not None and self.n_pieces > 1:
            facts.append(counted(self.n_pieces, "piece"))
        is_noted = any(note.startswith("open") for note in self.notes)
        if self.missing >= _MIN_MISSING and not is_noted:
            facts.append(f"open: {self.missing:.1%} of the surface is missing")
        others = [note for note in self.notes if not repair_steps([note])]
        return (*facts, *self.steps, *others)


def examine(
    files: Bodies,
    pipeline: SignaturePipeline,
    *,
    n_workers: int | None = None,
    limits: Limits | None = None,
    progress: bool = True,
) -> list[Finding]:
    """Read and mend every body as for its signature, and return the findings in order; `limits` apply to each file.

    The surfaces of labels, and reasons why bodies cannot be used, are kept in the cache of the pipeline.
    """
    jobs = group_by_file(files, range(len(files)))
    bodies = [files.subset(job).refs for job in jobs]
    pipeline = replace(pipeline, needs_cache=False)
    outcomes = run(partial(_examine_file, pipeline), bodies, n_workers=n_workers, limits=limits)
    findings: dict[int, Finding] = {}
    with (
        Progress(total=len(files), desc="bodies", disable=not progress) as bar,
        contextlib.closing(outcomes),
    ):
        for number, outcome in outcomes:
            bar.update(len(jobs[number]))
            for k, i in enumerate(jobs[number]):
                if isinstance(outcome, Failed):
                    findings[i] = Finding(files.names[i], error=outcome.reason)
                else:
                    findings[i] = replace(outcome[k], id=files.names[i])
    return [findings[i] for i in range(len(files))]


def expected_cost(n_vertices: int, n_eigenpairs: int) -> tuple[float, float]:
    """Return the expected seconds on one core and bytes of memory of a signature, mostly within a factor of 1.5."""
    entries = n_vertices * n_eigenpairs
    seconds = _SECONDS + _SECONDS_PER_VERTEX * n_vertices + _SECONDS_PER_ENTRY * entries
    return seconds, _BYTES + _BYTES_PER_VERTEX * n_vertices + _BYTES_PER_ENTRY * entries


def _examine_file(pipeline: SignaturePipeline, bodies: Sequence[BodyRef]) -> list[Finding]:
    """Examine bodies of the same file, which is read once."""
    path = bodies[0].path
    findings: dict[BodyRef, Finding] = {}
    by_part = {body.part: body for body in bodies}
    start = time.process_time()
    error = MeshError(f"{path}: the file has no such body. Choose a body of the file.")
    try:
        content = pipeline.content(bodies[0])
        for ref, raw in each_surface(path, pipeline.reading, parts=[*by_part]):
            body = by_part[ref.part]
            pipeline.keep_surface(body, content, raw)
            findings[body] = _finding(ref, raw, pipeline, start)
            start = time.process_time()
    except NoBodyError as nothing:  # only `each_surface` raises it
        error = nothing
        pipeline.remember(bodies[0], content, nothing)
    except MeshError as raised:
        error = raised
    unread = _refused(Finding(str(path)), error)
    return [findings.get(body, unread) for body in bodies]


def _refused(finding: Finding, error: MeshError) -> Finding:
    fault = finding.fault or str(error)
    return replace(finding, fault=fault, error=str(error), summary=error.summary)


def _finding(ref: BodyRef, raw: RawBody, pipeline: SignaturePipeline, start: float) -> Finding:
    reading = pipeline.reading
    config = pipeline.config
    voxels = None if raw.voxels is None else measure(raw.voxels())
    finding = Finding(str(ref), unit=raw.unit, unit_from=raw.unit_from, voxels=voxels)
    if raw.fault is not None:
        return _refused(finding, raw.fault)
    finding = replace(finding, n_vertices=len(raw.vertices))
    if voxels is None:  # the surface of a label was made closed
        try:
            surface_body(raw, ref, replace(reading, mend="never"))
        except MeshError as error:
            finding = replace(finding, fault=str(error))
    try:
        mesh = pipeline.refined(surface_body(raw, ref, reading))
    except MeshError as error:
        return _refused(finding, error)
    n_simplified = min(len(mesh.vertices), config.max_vertices or len(mesh.vertices))
    seconds, memory = expected_cost(n_simplified, config.n_kept)
    seconds += time.process_time() - start
    n_pieces, missing = (None, 0.0) if voxels is not None else _condition(raw)
    return replace(
        finding,
        n_pieces=n_pieces,
        missing=missing,
        steps=repair_steps(mesh.notes),
        notes=mesh.notes,
        n_vertices_after=len(mesh.vertices),
        seconds=seconds,
        memory=memory,
    )


def _condition(raw: RawBody) -> tuple[int | None, float]:
    """Return the number of pieces of a surface, and the share that is missing; None and 0 if it has no sound faces."""
    try:
        check_arrays(raw.vertices, raw.faces, "")
    except MeshError:
        return None, 0.0
    if not len(raw.faces) or not np.isfinite(raw.vertices).all():
        return None, 0.0
    vertices, faces = weld(raw.vertices, raw.faces, [])
    _, areas = face_parts(vertices, faces)
    return len(areas), closed_by_rims(vertices, faces)[2]

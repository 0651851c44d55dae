"""What is wrong with mesh files, what will be done about it, and what that will cost."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from tqdm import tqdm

from igps._parallel import Failed, Limits, run
from igps.data.sources import Bodies, BodyRef
from igps.mesh.loading import load_mesh, read_surface
from igps.mesh.mending import Step, mended_by
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

# Of a signature on one core: seconds and bytes by vertices and eigenpairs, as tests/benchmarks/cost.py fits them.
# 62 signatures of 31 generated bodies of 770 to 119,000 vertices, with 50 and 250 eigenpairs, took times within a
# factor of 1.5 of this (97 % of those of bodies left out of the fit; 90 % within 1.28) and memory within 1.05, that of
# the process before it reads anything included. The constant holds what a process pays once, such as loading compiled
# code. Other processors are slower or faster as a whole.
_SECONDS, _SECONDS_PER_VERTEX, _SECONDS_PER_ENTRY = 0.468, 2.33e-5, 2.31e-7
_BYTES, _BYTES_PER_VERTEX, _BYTES_PER_ENTRY = 4.57e8, 2820.0, 30.0


@dataclass(frozen=True)
class Finding:
    """What is known of a file before its signature is computed.

    Args:
        id: its name.
        fault: why the surface as it is in the file is no body; None if it is one.
        steps: what is done to it.
        notes: the same in words.
        n_vertices: in the file; None if it cannot be read.
        n_vertices_after: of the body; None if there is none.
        seconds: expected processor time from file to signature.
        memory: expected peak memory, bytes.
        error: why the file cannot be used; None if it can.
    """

    id: str
    fault: str | None = None
    steps: tuple[Step, ...] = ()
    notes: tuple[str, ...] = ()
    n_vertices: int | None = None
    n_vertices_after: int | None = None
    seconds: float | None = None
    memory: float | None = None
    error: str | None = None


def examine(
    files: Bodies,
    reading: LoadOptions | None = None,
    config: SignatureConfig | None = None,
    *,
    n_workers: int | None = None,
    limits: Limits | None = None,
    progress: bool = True,
) -> list[Finding]:
    """Read and mend every file as for its signature, and say what was found.

    Args:
        files: to be examined.
        reading: how they are read; the default if None.
        config: of the signatures; the default if None.
        n_workers: processes; all cores if None.
        limits: time and memory of one file.
        progress: show a bar.
    """
    one = partial(_examine, reading or LoadOptions(), config or SignatureConfig())
    outcomes = run(one, list(files), n_workers=n_workers, limits=limits)
    found: dict[int, Finding] = {}
    with tqdm(total=len(files), desc="files", disable=not progress) as bar, contextlib.closing(outcomes):
        for i, outcome in outcomes:
            bar.update()
            found[i] = Finding(files.names[i], error=outcome.reason) if isinstance(outcome, Failed) else outcome
    return [replace(found[i], id=files.names[i]) for i in range(len(files))]


def expected_cost(n_vertices: int, n_eigenpairs: int) -> tuple[float, float]:
    """Seconds of one core and bytes of memory that a signature takes, mostly within a factor of 1.5."""
    entries = n_vertices * n_eigenpairs
    seconds = _SECONDS + _SECONDS_PER_VERTEX * n_vertices + _SECONDS_PER_ENTRY * entries
    return seconds, _BYTES + _BYTES_PER_VERTEX * n_vertices + _BYTES_PER_ENTRY * entries


def _examine(reading: LoadOptions, config: SignatureConfig, body: BodyRef) -> Finding:
    start = time.process_time()
    path, part, name = body.path, body.part, str(body)
    try:
        vertices = read_surface(path, reading, part=part).vertices
    except MeshError as error:
        return Finding(name, fault=str(error), error=str(error))
    fault = None
    try:
        load_mesh(path, replace(reading, mend="never"), part=part)
    except MeshError as error:
        fault = str(error)
    try:
        mesh = load_mesh(path, reading, part=part, least_vertices=config.n_vertices_read)
    except MeshError as error:
        return Finding(name, fault=fault, n_vertices=len(vertices), error=str(error))
    n_after = min(len(mesh.vertices), config.max_vertices or len(mesh.vertices))
    seconds, memory = expected_cost(n_after, config.n_kept)
    return Finding(
        id=name,
        fault=fault,
        steps=mended_by(mesh.notes),
        notes=mesh.notes,
        n_vertices=len(vertices),
        n_vertices_after=len(mesh.vertices),
        seconds=time.process_time() - start + seconds,
        memory=memory,
    )


def usable(findings: Sequence[Finding]) -> bool:
    """Whether every file can be used."""
    return all(finding.error is None for finding in findings)

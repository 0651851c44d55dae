"""What is wrong with the bodies of files, what will be done about it, and what that will cost."""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from tqdm import tqdm

from igps._parallel import Failed, Limits, run
from igps.data.filling import group_by_file
from igps.data.sources import Bodies, BodyRef
from igps.mesh.formats import RawBody, VoxelMeasures
from igps.mesh.loading import each_surface, surface_body
from igps.mesh.mending import Step, repair_steps
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
    """What is known of a body before its signature is computed."""

    id: str  # its name
    fault: str | None = None  # why the surface as it is in the file is no body; None if it is one
    steps: tuple[Step, ...] = ()  # what is done to it
    notes: tuple[str, ...] = ()  # the same in words
    n_vertices: int | None = None  # in the file, or of the surface made of it; None if it cannot be read
    n_vertices_after: int | None = None  # of the body; None if there is none
    seconds: float | None = None  # expected processor time from file to signature
    memory: float | None = None  # expected peak memory, bytes
    error: str | None = None  # why the file cannot be used; None if it can
    voxels: VoxelMeasures | None = None  # of a label of a volume; None of anything else


def examine(
    files: Bodies,
    reading: LoadOptions | None = None,
    config: SignatureConfig | None = None,
    *,
    n_workers: int | None = None,
    limits: Limits | None = None,
    progress: bool = True,
) -> list[Finding]:
    """Read and mend every body as for its signature, and say what was found; limits are of one file."""
    jobs = group_by_file(files, range(len(files)))
    one = partial(_examine, reading or LoadOptions(), config or SignatureConfig())
    outcomes = run(one, [[files[i] for i in job] for job in jobs], n_workers=n_workers, limits=limits)
    found: dict[int, Finding] = {}
    with tqdm(total=len(files), desc="bodies", disable=not progress) as bar, contextlib.closing(outcomes):
        for number, outcome in outcomes:
            bar.update(len(jobs[number]))
            for k, i in enumerate(jobs[number]):
                one_found = Finding("", error=outcome.reason) if isinstance(outcome, Failed) else outcome[k]
                found[i] = replace(one_found, id=files.names[i])
    return [found[i] for i in range(len(files))]


def expected_cost(n_vertices: int, n_eigenpairs: int) -> tuple[float, float]:
    """Seconds of one core and bytes of memory that a signature takes, mostly within a factor of 1.5."""
    entries = n_vertices * n_eigenpairs
    seconds = _SECONDS + _SECONDS_PER_VERTEX * n_vertices + _SECONDS_PER_ENTRY * entries
    return seconds, _BYTES + _BYTES_PER_VERTEX * n_vertices + _BYTES_PER_ENTRY * entries


def _examine(reading: LoadOptions, config: SignatureConfig, bodies: Sequence[BodyRef]) -> list[Finding]:
    """The bodies of one file, which is read once."""
    path, found = bodies[0].path, {}
    start, fault = time.process_time(), f"{path}: has no such body. Choose one that the file has."
    try:
        for ref, raw in each_surface(path, reading, parts=[body.part for body in bodies]):
            found[ref] = _finding(ref, raw, reading, config, start)
            start = time.process_time()
    except MeshError as error:
        fault = str(error)
    return [found.get(body, Finding(str(body), fault=fault, error=fault)) for body in bodies]


def _finding(ref: BodyRef, raw: RawBody, reading: LoadOptions, config: SignatureConfig, start: float) -> Finding:
    voxels = None if raw.voxels is None else raw.voxels().measures()
    found = Finding(str(ref), n_vertices=len(raw.vertices), voxels=voxels)
    if raw.fault is not None:
        return replace(found, n_vertices=None, fault=str(raw.fault), error=str(raw.fault))
    try:
        surface_body(raw, ref, replace(reading, mend="never"))
    except MeshError as error:
        found = replace(found, fault=str(error))
    try:
        mesh = surface_body(raw, ref, reading, least_vertices=config.n_vertices_read)
    except MeshError as error:
        return replace(found, error=str(error))
    n_after = min(len(mesh.vertices), config.max_vertices or len(mesh.vertices))
    seconds, memory = expected_cost(n_after, config.n_kept)
    seconds += time.process_time() - start
    found = replace(found, steps=repair_steps(mesh.notes), notes=mesh.notes, n_vertices_after=len(mesh.vertices))
    return replace(found, seconds=seconds, memory=memory)

"""Computation of the Signatures that are missing in a cache, by processes on this machine or a cluster."""

from __future__ import annotations

import contextlib
import logging
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

from igps._parallel import run
from igps._progress import Progress
from igps._text import counted
from igps._threads import n_cores
from igps.data.cache import Kind
from igps.data.cache_hit import CacheHit
from igps.data.keys import FileDigest
from igps.data.known_files import KnownFiles
from igps.data.pipeline import SignaturePipeline, fill_elsewhere, version
from igps.data.sources import Bodies
from igps.failures import Failed, Limits, MachineError
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of
from igps.mesh.loading import BodyRef

logger = logging.getLogger(__name__)

_RECORDS_PER_WRITE = 1000  # to the database of `KnownFiles`
_MAX_BODIES_PER_JOB = 64  # each job reads the file again, and its results arrive together
_MAX_DELAY = 60.0  # seconds until a shared file system shows a file that another machine wrote


@dataclass(frozen=True)
class Failure:
    """A body that could not be used, and the reason."""

    id: str
    path: Path
    error: str
    summary: str = ""  # such as "empty", if the file is sound; see `MeshError.summary`

    @staticmethod
    def of(bodies: Bodies, i: int, reason: str, summary: str = "") -> Failure:
        """Return the failure of a body by its index, with its file named in the error."""
        path = bodies.paths[i]
        return Failure(
            bodies.names[i],
            path,
            reason if reason.startswith(str(path)) else f"{bodies[i]}: {reason}",
            summary,
        )


def left_out(summaries: Iterable[str]) -> str:
    """Return a line such as "47 masks left out: 45 empty, 2 of …" on failures that have a summary; "" if none has."""
    counts = Counter(summary for summary in summaries if summary)
    if not counts:
        return ""
    listed = ", ".join(f"{n} {summary}" for summary, n in counts.most_common())
    return f"{counted(counts.total(), 'mask')} left out: {listed}"


def fill(
    pipeline: SignaturePipeline,
    bodies: Bodies,
    executor: Executor | None,
    n_workers: int | None,
    strict: bool,
    progress: bool,
    limits: Limits | None,
) -> tuple[list[CacheHit | None], list[Failure]]:
    """Compute missing Signatures; return all cache entries, and failures. See `SignatureDataset.precompute`."""
    try:  # here, so that it is reported once and not for every body
        pipeline.cache_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        cause = f"cache_dir: {pipeline.cache_dir} cannot be created ({error.strerror})"
        raise MachineError(f"{cause}. Choose a writable folder and run again.") from error
    for kind in get_args(Kind):
        pipeline.cache(kind).remove_abandoned()
    known = KnownFiles(pipeline.cache_dir)
    found = find_cached(pipeline, bodies, read_files=executor is None)
    hits = [None if isinstance(outcome, Failed) else outcome for outcome in found]
    failures: dict[int, Failure] = {}
    missing = [i for i, outcome in enumerate(found) if outcome is None]

    def fail(i: int, failed: Failed) -> None:
        failures[i] = Failure.of(bodies, i, failed.reason, failed.summary)
        if strict:
            raise MeshError(failures[i].error)
        if not failed.summary:
            logger.warning("skipped: %s", failures[i].error)

    for i, outcome in enumerate(found):
        if isinstance(outcome, Failed):
            fail(i, outcome)
    outcomes = compute(
        pipeline, bodies, missing, n_workers=n_workers, executor=executor, limits=limits or Limits()
    )
    n_found = len(bodies) - len(missing)
    bar = Progress(total=len(bodies), initial=n_found, desc="signatures", disable=not progress)
    new: list[FileDigest] = []
    is_visible = False
    with bar, contextlib.closing(outcomes):
        try:
            for i, outcome in outcomes:
                bar.update()
                if isinstance(outcome, Failed):
                    fail(i, outcome)
                    continue
                if not is_visible:
                    wait_until_visible(pipeline, outcome)
                    is_visible = True
                hits[i] = outcome
                new += outcome.files
                if len(new) >= _RECORDS_PER_WRITE:
                    known.remember(new)
                    new.clear()
        finally:
            known.remember(new)
    _warn_of_left_out(failures.values())
    return hits, [failures[i] for i in sorted(failures)]


def _warn_of_left_out(failures: Iterable[Failure]) -> None:
    line = left_out(failure.summary for failure in failures)
    if line:
        logger.warning("%s", line)


def find_cached(
    pipeline: SignaturePipeline, bodies: Bodies, read_files: bool = True
) -> list[CacheHit | Failed | None]:
    """Return the cache entry of each body, or why it could not be used before; None if neither is known.

    Files that are new or changed are read only if `read_files`.
    """
    found: list[CacheHit | Failed | None] = [None] * len(bodies)
    for i, body in enumerate(bodies):
        if body in pipeline.meshes:
            with contextlib.suppress(MeshError):  # which the computation reports
                found[i] = pipeline.find(body, pipeline.content(body))
    on_disk = [i for i, body in enumerate(bodies) if body not in pipeline.meshes]
    groups = group_by_file(bodies, on_disk)
    files: dict[Path, list[Path]] = {}
    for group in groups:
        path = bodies.paths[group[0]]
        with contextlib.suppress(MeshError):  # which the computation reports
            files[path] = dependencies_of(path, pipeline.reading)
    database = KnownFiles(pipeline.cache_dir)
    known = database.unchanged(file for paths in files.values() for file in paths)
    new: list[FileDigest] = []
    for group in groups:
        path = bodies.paths[group[0]]
        is_known = path in files and all(file in known for file in files[path])
        if not (is_known or read_files):
            continue
        with contextlib.suppress(MeshError):  # which the computation reports
            content = pipeline.content(bodies[group[0]], known)
            new += [file for file in content.files if file.path not in known]
            for i in group:
                found[i] = pipeline.find(bodies[i], content)
    database.remember(new)
    return found


def compute(
    pipeline: SignaturePipeline,
    bodies: Bodies,
    indices: Sequence[int],
    *,
    n_workers: int | None,
    executor: Executor | None,
    limits: Limits,
    max_per_job: int | None = None,
) -> Generator[tuple[int, CacheHit | Failed], None, None]:
    """Compute Signatures into the cache, and yield the index and the cache entry or failure of each body.

    A job computes several bodies of one file, which it reads once. If the process of a job dies, each of its bodies is
    tried again in a job of its own. With limits, which are those of one body, each job has one body. `max_per_job` is
    64 if None, or less so that all workers have a job. See `igps._parallel.run` for the other arguments.
    """
    per_worker = -(-len(indices) // (n_workers or n_cores()))
    max_per_job = (
        1 if limits != Limits() else max_per_job or max(1, min(per_worker, _MAX_BODIES_PER_JOB))
    )
    groups = group_by_file(bodies, indices, max_per_job)
    jobs = [[bodies[i] for i in group] for group in groups]
    function: Callable[[Sequence[BodyRef]], list[CacheHit | Failed]] = pipeline.fill
    if executor is not None:  # its workers may run in another folder, so all paths must be absolute
        function = partial(
            fill_elsewhere,
            replace(pipeline, cache_dir=pipeline.cache_dir.absolute()).fill,
            version(),
        )
        jobs = [
            [b if b in pipeline.meshes else replace(b, path=b.path.absolute()) for b in job]
            for job in jobs
        ]
    lost: list[int] = []
    results = run(function, jobs, n_workers=n_workers, executor=executor, limits=limits)
    with contextlib.closing(results):
        for job_index, outcome in results:
            group = groups[job_index]
            if not isinstance(outcome, Failed):
                yield from zip(group, outcome, strict=True)
            elif len(group) > 1:
                lost += group
            else:
                yield group[0], outcome
    if lost:
        yield from compute(
            pipeline,
            bodies,
            lost,
            n_workers=n_workers,
            executor=executor,
            limits=limits,
            max_per_job=1,
        )


def wait_until_visible(pipeline: SignaturePipeline, hit: CacheHit) -> None:
    """Wait until the file that a worker wrote appears in the cache; raise a MachineError if it does not."""
    path = pipeline.cache("signature").path(hit.key)
    deadline = time.monotonic() + _MAX_DELAY
    while not path.exists():
        if time.monotonic() > deadline:
            cause = f"{pipeline.cache_dir}: the workers' signatures do not appear there"
            raise MachineError(
                f"{cause}. Choose a cache_dir that this machine and all workers share by the same path."
            )
        time.sleep(0.1)


def group_by_file(
    bodies: Bodies, indices: Iterable[int], max_size: int | None = None
) -> list[list[int]]:
    """Group the indices of bodies by file, with at most `max_size` indices in a group."""
    groups: dict[Path, list[int]] = {}
    for i in indices:
        groups.setdefault(bodies.paths[i], []).append(i)
    step = max_size or len(bodies)
    return [
        group[start : start + step]
        for group in groups.values()
        for start in range(0, len(group), step)
    ]

"""Computation of the Signatures that are missing in a cache, by processes on this machine or a cluster."""

from __future__ import annotations

import contextlib
import logging
import math
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
from igps.data.known_files import KnownFiles
from igps.data.pipeline import SignaturePipeline, fill_elsewhere, version
from igps.data.sources import Bodies
from igps.failures import Failed, Limits, MachineError
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of
from igps.mesh.loading import BodyRef

logger = logging.getLogger(__name__)

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
        if not reason.startswith(str(path)):
            reason = f"{bodies[i]}: {reason}"
        return Failure(bodies.names[i], path, reason, summary)


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
    found = find_cached(pipeline, bodies)
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
    with bar, contextlib.closing(outcomes):
        for i, outcome in outcomes:
            bar.update()
            if isinstance(outcome, Failed):
                fail(i, outcome)
                continue
            if executor is not None:
                wait_until_visible(pipeline, outcome)
            hits[i] = outcome
    line = left_out(failure.summary for failure in failures.values())
    if line:
        logger.warning("%s", line)
    return hits, [failures[i] for i in sorted(failures)]


def find_cached(pipeline: SignaturePipeline, bodies: Bodies) -> list[CacheHit | Failed | None]:
    """Return the cache entry of each body, or why it could not be used before; None if neither is known."""
    found: list[CacheHit | Failed | None] = [None] * len(bodies)
    groups = _groups(pipeline, bodies, range(len(bodies)))
    files: list[Path] = []
    if not pipeline.meshes:
        for group in groups:
            with contextlib.suppress(MeshError):  # which the computation reports
                files += dependencies_of(bodies.paths[group[0]], pipeline.reading)
    known = KnownFiles(pipeline.cache_dir).digests(files)
    for group in groups:
        with contextlib.suppress(MeshError):  # which the computation reports
            content = pipeline.content(bodies[group[0]], known)
            for i in group:
                found[i] = pipeline.find(bodies[i], content)
    return found


def _groups(
    pipeline: SignaturePipeline, bodies: Bodies, indices: Sequence[int], max_size: int | None = None
) -> list[list[int]]:
    """Group the indices of bodies by what they are read from: a file, or a mesh in memory."""
    if pipeline.meshes:
        return [[i] for i in indices]
    return group_by_file(bodies, indices, max_size)


def compute(
    pipeline: SignaturePipeline,
    bodies: Bodies,
    indices: Sequence[int],
    *,
    n_workers: int | None,
    executor: Executor | None,
    limits: Limits,
) -> Generator[tuple[int, CacheHit | Failed], None, None]:
    """Compute Signatures into the cache, and yield the index and the cache entry or failure of each body.

    A job computes several bodies of one file, which it reads once: at most 64, and so few that all workers have a job.
    If the process of a job dies, each of its bodies is tried again in a job of its own. With limits, which are those of
    one body, each job has one body. See `igps._parallel.run` for the other arguments.
    """
    function: Callable[[Sequence[BodyRef]], list[CacheHit | Failed]] = pipeline.fill
    refs = bodies.refs
    if executor is not None:  # its workers may run in another folder, so all paths must be absolute
        absolute = replace(pipeline, cache_dir=pipeline.cache_dir.absolute())
        function = partial(fill_elsewhere, absolute.fill, version())
        if not pipeline.meshes:
            refs = tuple(replace(ref, path=ref.path.absolute()) for ref in refs)
    n_each = math.ceil(len(indices) / (n_workers or n_cores()))
    n_each = 1 if limits != Limits() else min(n_each, _MAX_BODIES_PER_JOB)
    groups = _groups(pipeline, bodies, indices, n_each)
    while groups:
        jobs = [[refs[i] for i in group] for group in groups]
        lost: list[list[int]] = []
        results = run(function, jobs, n_workers=n_workers, executor=executor, limits=limits)
        with contextlib.closing(results):
            for number, outcome in results:
                group = groups[number]
                if not isinstance(outcome, Failed):
                    yield from zip(group, outcome, strict=True)
                elif len(group) > 1:
                    lost += [[i] for i in group]
                else:
                    yield group[0], outcome
        groups = lost


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
    parts = []
    for group in groups.values():
        for start in range(0, len(group), step):
            parts.append(group[start : start + step])
    return parts

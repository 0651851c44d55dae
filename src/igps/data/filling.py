"""Fill the cache: what it lacks of many bodies is computed by processes, here or elsewhere."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from tqdm import tqdm

from igps._parallel import Failed, Limits, MachineError, n_cores, run
from igps.data.cache import SignatureCache
from igps.data.file_stat_cache import FileStatCache
from igps.data.pipeline import CacheHit, SignaturePipeline, fill_elsewhere, version
from igps.data.sources import Bodies
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import MeshError

logger = logging.getLogger(__name__)

_REMEMBERED_AT_ONCE = 1000
# Bodies of one file that are computed before any of them is reported; the file is read again for the next
_REPORTED_AT_ONCE = 64
# Seconds within which a shared file system shows a file that another machine wrote.
_SHARED_WITHIN = 60.0


@dataclass(frozen=True)
class Failure:
    """A body that could not be used, and why."""

    id: str
    path: Path
    error: str

    @staticmethod
    def of(bodies: Bodies, i: int, reason: str) -> Failure:
        """What failed of a body, in a sentence that names its file."""
        path = bodies.paths[i]
        return Failure(bodies.names[i], path, reason if reason.startswith(str(path)) else f"{bodies[i]}: {reason}")


def fill(
    pipeline: SignaturePipeline, bodies: Bodies, executor: Executor | None, n_workers: int | None, strict: bool,
    progress: bool, limits: Limits | None,
) -> tuple[list[CacheHit | None], list[Failure]]:  # fmt: skip
    """What serves each body, after computing what was missing; and what failed, see `SignatureDataset.precompute`."""
    try:  # once here, or every body would be reported as a failure
        pipeline.cache_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        told = f"cache_dir: {pipeline.cache_dir} cannot be made ({error.strerror})"
        raise MachineError(f"{told}. Choose a folder that can be written and run again.") from error
    SignatureCache(pipeline.cache_dir).remove_abandoned()
    known = FileStatCache(pipeline)
    found = find_cached(pipeline, bodies, look=executor is None)
    failures: dict[int, Failure] = {}
    new: dict[BodyRef, CacheHit] = {}
    missing = [i for i, hit in enumerate(found) if hit is None]
    outcomes = compute(pipeline, bodies, missing, n_workers=n_workers, executor=executor, limits=limits or Limits())
    bar = tqdm(total=len(bodies), initial=len(bodies) - len(missing), desc="signatures", disable=not progress)
    with bar, contextlib.closing(outcomes):
        try:
            for i, outcome in outcomes:
                bar.update()
                if isinstance(outcome, Failed):
                    failures[i] = Failure.of(bodies, i, outcome.reason)
                    if strict:
                        raise MeshError(failures[i].error)
                    logger.warning("skipped: %s", failures[i].error)
                    continue
                if not new:
                    wait_until_visible(pipeline, outcome)
                new[bodies[i]] = found[i] = outcome
                if len(new) >= _REMEMBERED_AT_ONCE:
                    known.remember(new)
                    new.clear()
        finally:
            known.remember(new)
    return found, [failures[i] for i in sorted(failures)]


def find_cached(pipeline: SignaturePipeline, bodies: Bodies, look: bool = True) -> list[CacheHit | None]:
    """What in the cache serves each body, None where nothing does.

    Files that are not known or have changed are read only if `look`; otherwise nothing serves their bodies.
    """
    known = FileStatCache(pipeline)
    ready = known.ready(bodies)
    found = [ready.get(body) for body in bodies]
    new: dict[BodyRef, CacheHit] = {}
    for group in group_by_file(bodies, (i for i, hit in enumerate(found) if hit is None and look)):
        with contextlib.suppress(MeshError):  # computing it will say why
            for i, hit in zip(group, pipeline.lookup([bodies[i] for i in group]), strict=True):
                if hit is not None:
                    found[i] = new[bodies[i]] = hit
    known.remember(new)
    return found


def compute(
    pipeline: SignaturePipeline,
    bodies: Bodies,
    numbers: Sequence[int],
    *,
    n_workers: int | None,
    executor: Executor | None,
    limits: Limits,
    at_once: int | None = None,
) -> Generator[tuple[int, CacheHit | Failed], None, None]:
    """Compute Signatures into the cache, and yield of each body, by number, its cache entry, or why it failed.

    The bodies of one file are computed in chunks, for each of which it is read once. Where one of a chunk loses its
    process, each of the chunk is tried again alone. With limits, which are of one body, every body is. A chunk has at
    most `at_once` bodies; if None 64, or fewer so that every worker has one. See `igps._parallel.run` for the rest.
    """
    shared = min(-(-len(numbers) // (n_workers or n_cores())), _REPORTED_AT_ONCE)
    most = 1 if limits != Limits() else at_once or max(1, shared)
    jobs = group_by_file(bodies, numbers, most)
    work: Callable[[Sequence[BodyRef]], list[CacheHit | Failed]] = pipeline.fill
    given = [[bodies[i] for i in job] for job in jobs]
    if executor is not None:  # whose workers run in another folder
        there = replace(pipeline, cache_dir=pipeline.cache_dir.absolute())
        work = partial(fill_elsewhere, there.fill, version())
        known = pipeline.meshes  # these are in no file
        given = [[b if b in known else replace(b, path=b.path.absolute()) for b in job] for job in given]
    lost: list[int] = []
    results = run(work, given, n_workers=n_workers, executor=executor, limits=limits)
    with contextlib.closing(results):
        for number, outcome in results:
            job = jobs[number]
            if not isinstance(outcome, Failed):
                yield from zip(job, outcome, strict=True)
            elif len(job) > 1:
                lost += job
            else:
                yield job[0], outcome
    if lost:
        yield from compute(pipeline, bodies, lost, n_workers=n_workers, executor=executor, limits=limits, at_once=1)


def wait_until_visible(pipeline: SignaturePipeline, hit: CacheHit) -> None:
    """Raise a MachineError if what a worker put into the cache does not appear there."""
    path = SignatureCache(pipeline.cache_dir).path(hit.key)
    deadline = time.monotonic() + _SHARED_WITHIN
    while not path.exists():
        if time.monotonic() > deadline:
            raise MachineError(
                f"{pipeline.cache_dir}: the workers' signatures do not appear there. Choose a cache_dir that this "
                "machine and all workers share, by the same path."
            )
        time.sleep(0.1)


def group_by_file(bodies: Bodies, numbers: Iterable[int], most: int | None = None) -> list[list[int]]:
    """The numbers of bodies in groups of one file each, at most so many in a group."""
    groups: dict[Path, list[int]] = {}
    for i in numbers:
        groups.setdefault(bodies.paths[i], []).append(i)
    most = most or len(bodies)
    return [group[start : start + most] for group in groups.values() for start in range(0, len(group), most)]

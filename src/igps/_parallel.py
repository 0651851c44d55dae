"""Parallel jobs in processes or threads. A job that fails, or kills its process, does not affect the other jobs.

Each worker is a `ProcessPoolExecutor` with one process. So if a process dies, its job is known, and a job that takes
too long is stopped by killing its process. Any other `concurrent.futures.Executor`, such as that of a cluster, can run
the jobs instead.
"""

import errno
import queue
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass
from itertools import islice

from igps._parameters import check_at_least
from igps._threads import Job, Result, n_cores, one_thread, stay_on_one_thread
from igps._threads import n_threads as available_threads
from igps._workers import MachineError, Worker, workers_environment

_MAX_ATTEMPTS = (
    2  # of a job whose process died: an administrator or another program may be the cause
)
_KILLED = "its process was killed twice. It may need more memory: use fewer workers, or set a memory limit to find out."
_KILLED_ON_CLUSTER = "several workers that had it were killed. It may need more memory: start workers with more memory."
_MAX_SUBMITTED = 10_000  # jobs in an executor: enough for the workers of a large cluster, few enough for the memory
_MACHINE_ERRORS = {
    "Free disk space": ("ENOSPC", "EDQUOT", "EFBIG"),
    "Choose a writable folder": ("EROFS", "EACCES", "EPERM"),
    "Check the disk": ("EIO",),
    "Raise the limit of open files": ("EMFILE", "ENFILE"),
    "Free memory": ("ENOMEM",),
}
_REMEDIES = {
    getattr(errno, name, 0): remedy for remedy, names in _MACHINE_ERRORS.items() for name in names
}


@dataclass(frozen=True)
class Failed:
    """The outcome of a job that failed, with the reason in one sentence."""

    reason: str


@dataclass(frozen=True)
class Limits:
    """Limits of one job; None is no limit."""

    seconds: float | None = None  # wall time
    memory: int | None = None  # bytes of data of the process; enforced only on Linux

    def __post_init__(self) -> None:
        for name, value in (("time_limit", self.seconds), ("memory_limit", self.memory)):
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected None or a positive number, got {value}.")


def run(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    n_workers: int | None = None,
    executor: Executor | None = None,
    limits: Limits | None = None,
) -> Generator[tuple[int, Result | Failed], None, None]:
    """Run a function on many jobs, and yield the index and the result of each as it finishes.

    Args:
        function: picklable. Its exceptions become `Failed`, except for those that the machine causes.
        jobs: picklable arguments of the function.
        n_workers: number of processes; the number of cores if None. With 1 and no limits, jobs run in this process.
        executor: runs the jobs instead of own processes.
        limits: limits of each job; not allowed with an executor.

    Raises:
        MachineError: the disk is full, memory runs out without a limit, a library is missing, or no process starts.
    """
    check_at_least(1, n_workers=n_workers)
    limits = limits or Limits()
    n_workers = min(n_workers or n_cores(), len(jobs))
    if executor is not None:
        if limits != Limits():
            raise ValueError("limits: expected None with an executor, which sets its own limits.")
        yield from _run_on_executor(executor, function, jobs)
    elif n_workers > 1 or (jobs and limits != Limits()):
        yield from _run_on_workers(function, jobs, n_workers, limits)
    else:
        for i, job in enumerate(jobs):
            yield i, attempt(lambda job=job: function(job), limits)  # type: ignore[misc]


def on_threads(
    function: Callable[[Job], Result], jobs: Sequence[Job], n_threads: int | None = None
) -> Iterator[Result]:
    """Yield the result of every job in order. Each job computes on one thread, see `igps._threads`.

    The number of threads is `igps._threads.n_threads()` by default.
    """
    n_threads = min(available_threads() if n_threads is None else n_threads, len(jobs))
    on_one_thread = one_thread()(function)
    if n_threads <= 1:
        yield from map(on_one_thread, jobs)
        return
    with ThreadPoolExecutor(n_threads, initializer=stay_on_one_thread) as pool:
        yield from pool.map(on_one_thread, jobs)


def is_machine_error(error: OSError) -> bool:
    """Return whether the machine is at fault, not a single file: a full or broken disk, a missing permission."""
    return error.errno in _REMEDIES


def machine_error_text(error: OSError) -> str:
    """Return the message of an error for which `is_machine_error` holds, with a remedy."""
    return f"{error}. {_REMEDIES[error.errno or 0]} and run again: finished results are kept."


def attempt(function: Callable[[], Result], limits: Limits = Limits()) -> Result | Failed:
    """Return the result or the failure of a job; raise a MachineError if the machine is at fault."""
    try:
        return function()
    except (BrokenExecutor, CancelledError, MachineError):
        raise
    except MemoryError as error:
        if limits.memory is not None:
            return Failed(
                f"it needs more than the memory_limit of {limits.memory / 2**20:.0f} MiB."
            )
        raise MachineError(
            "out of memory. Use fewer workers or a memory limit: finished results are kept."
        ) from error
    except ImportError as error:
        raise MachineError(
            f"{str(error).rstrip('.')}. Install it and run again: finished results are kept."
        ) from error
    except OSError as error:
        if is_machine_error(error):
            raise MachineError(machine_error_text(error)) from error
        return Failed(_sentence(error))
    except Exception as error:
        # Dask raises KilledWorker after several workers died with the same job.
        return Failed(
            _KILLED_ON_CLUSTER if type(error).__name__ == "KilledWorker" else _sentence(error)
        )


def _sentence(error: Exception) -> str:
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


def _run_on_executor(
    executor: Executor, function: Callable[[Job], Result], jobs: Sequence[Job]
) -> Generator[tuple[int, Result | Failed], None, None]:
    done: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    indices: dict[Future[Result], int] = {}
    waiting = enumerate(jobs)

    def submit(n_jobs: int) -> None:
        for i, job in islice(waiting, n_jobs):
            future = executor.submit(function, job)
            indices[future] = i
            future.add_done_callback(done.put)

    try:
        submit(_MAX_SUBMITTED)
        while indices:
            future = done.get()
            yield indices.pop(future), attempt(future.result)
            submit(1)
    except CancelledError as error:
        raise MachineError(
            "the executor cancelled a job. Run again: finished results are kept."
        ) from error
    except MachineError:
        raise
    except RuntimeError as error:  # the executor broke, or was shut down
        raise MachineError(
            f"the executor broke ({error}). Run again: finished results are kept."
        ) from error
    finally:
        for future in indices:
            future.cancel()


def _run_on_workers(
    function: Callable[[Job], Result], jobs: Sequence[Job], n_workers: int, limits: Limits
) -> Generator[tuple[int, Result | Failed], None, None]:
    seconds = float("inf") if limits.seconds is None else limits.seconds
    waiting = deque(range(len(jobs)))
    n_deaths: Counter[int] = Counter()
    workers = [Worker(limits.memory) for _ in range(n_workers)]
    idle = list(workers)
    busy: dict[Future[Result], tuple[Worker, int, float]] = {}  # worker, index of the job, deadline
    finished = False
    try:
        # All start at the same time, because a process needs seconds for its imports
        with workers_environment(), ThreadPoolExecutor(n_workers) as starters:
            list(starters.map(Worker.started, workers))
        while waiting or busy:
            while waiting and idle:
                worker, i = idle.pop(), waiting.popleft()
                future = worker.submit(function, jobs[i])
                busy[future] = worker, i, time.monotonic() + seconds
            next_deadline = min(deadline for _, _, deadline in busy.values())
            timeout = None if limits.seconds is None else max(0.0, next_deadline - time.monotonic())
            done, _ = wait(busy, timeout=timeout, return_when=FIRST_COMPLETED)
            for future in done:
                worker, i, _ = busy.pop(future)
                idle.append(worker)
                try:
                    yield i, attempt(future.result, limits)
                except BrokenExecutor:
                    worker.end()
                    n_deaths[i] += 1
                    if n_deaths[i] < _MAX_ATTEMPTS:
                        waiting.append(i)
                    else:
                        yield i, Failed(_KILLED)
            for future, (worker, i, deadline) in list(busy.items()):
                # A job may have finished in time while the caller was slow to take results
                if time.monotonic() >= deadline and not future.done():
                    worker.end(kill=True)
                    del busy[future]
                    idle.append(worker)
                    yield i, Failed(f"it took longer than the time_limit of {limits.seconds:g} s.")
        finished = True
    finally:
        for worker in workers:
            worker.end(kill=not finished)

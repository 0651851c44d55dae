"""Many jobs at once, on processes or on threads. A job that fails, or kills its process, costs no other its result.

Each worker is a `ProcessPoolExecutor` of one process. So it is known which job a process had when it died, and a job
that takes too long is ended by killing its process. Any other `concurrent.futures.Executor`, such as that of a
cluster, may do the work instead.
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

# A job whose process died is tried once more: an administrator or another program may have been the cause.
_MOST_DEATHS = 2
_KILLED = (
    "the process that worked on it was killed, twice. It may need more memory than there is: use fewer workers, or set "
    "a memory limit to be told."
)
_KILLED_ELSEWHERE = (
    "the workers that had it were killed, one after the other. It may need more memory than they have: start them with "
    "more."
)
# Enough for the workers of a large cluster, few enough for the memory of the caller.
_MOST_SUBMITTED = 10_000
_MACHINES = frozenset(
    getattr(errno, name, 0)
    for name in ("ENOSPC", "EDQUOT", "EFBIG", "EIO", "EROFS", "EACCES", "EPERM", "EMFILE", "ENFILE", "ENOMEM")
)
_FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)


@dataclass(frozen=True)
class Failed:
    """Why a job has no result, in one sentence."""

    reason: str


@dataclass(frozen=True)
class Limits:
    """What one job may use."""

    seconds: float | None = None  # of wall time; None for no limit
    memory: int | None = None  # bytes of data of its process; None for no limit. Linux alone enforces it

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
    """The number and the result of every job, in the order in which they end.

    Args:
        function: picklable; the exceptions that it raises, but for those of the machine, are failures of the job.
        jobs: picklable.
        n_workers: processes; as many as cores if None. One works in this process, unless there are limits.
        executor: does the work instead of these processes.
        limits: of each job; not with an executor.

    Raises:
        MachineError: the disk is full, memory runs out without a limit, a library is missing, or no process can be
            started.
    """
    check_at_least(1, n_workers=n_workers)
    limits = limits or Limits()
    limited = limits != Limits()
    if executor is not None:
        if limited:
            raise ValueError("limits: expected none beside an executor, which has its own.")
        yield from _by_executor(executor, function, jobs)
        return
    n_workers = min(n_workers or n_cores(), len(jobs))
    if n_workers > 1 or (limited and jobs):
        yield from _by_workers(function, jobs, n_workers, limits)
        return
    for number, job in enumerate(jobs):
        yield number, attempt(lambda job=job: function(job), limits)  # type: ignore[misc]


def on_threads(
    function: Callable[[Job], Result], jobs: Sequence[Job], n_threads: int | None = None
) -> Iterator[Result]:
    """The result of every job in order, each job on one thread of its own, as PyTorch lets many compute at once.

    Splitting each small product over all cores instead makes every one of them wait for the slowest core, which on a
    machine with other work to do costs many times the product itself. The threads are as many as `n_threads()` if None.
    """
    n_threads = min(available_threads() if n_threads is None else n_threads, len(jobs))
    alone = one_thread()(function)
    if n_threads <= 1:
        yield from map(alone, jobs)
        return
    with ThreadPoolExecutor(n_threads, initializer=stay_on_one_thread) as pool:
        yield from pool.map(alone, jobs)


def is_machine_error(error: OSError) -> bool:
    """Whether an error tells of the machine and not of a file: no room, no right to write, a broken disk."""
    return error.errno in _MACHINES


def machine_error_text(error: OSError) -> str:
    """What to do about it."""
    remedy = "Choose a folder that can be written" if error.errno in _FORBIDDEN else "Make room"
    return f"{error}. {remedy} and run again: what is done is kept."


def attempt(result: Callable[[], Result], limits: Limits = Limits()) -> Result | Failed:
    """The result; the job's failure in words; a MachineError where the machine is at fault."""
    try:
        return result()
    except (BrokenExecutor, CancelledError, MachineError):
        raise
    except MemoryError as error:
        if limits.memory is not None:
            return Failed(f"it needs more than the memory_limit of {limits.memory / 2**20:.0f} MiB.")
        raise MachineError("out of memory. Use fewer workers or set a memory limit; what is done is kept.") from error
    except ImportError as error:
        raise MachineError(f"{str(error).rstrip('.')}. Install it and run again: what is done is kept.") from error
    except OSError as error:
        if is_machine_error(error):
            raise MachineError(machine_error_text(error)) from error
        return Failed(_sentence(error))
    except Exception as error:
        # Dask raises it after several workers died with the same job.
        return Failed(_KILLED_ELSEWHERE if type(error).__name__ == "KilledWorker" else _sentence(error))


def _sentence(error: Exception) -> str:
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


def _by_executor(
    executor: Executor, function: Callable[[Job], Result], jobs: Sequence[Job]
) -> Generator[tuple[int, Result | Failed], None, None]:
    done: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    numbers: dict[Future[Result], int] = {}
    waiting = enumerate(jobs)

    def submit(n_more: int) -> None:
        for number, job in islice(waiting, n_more):
            future = executor.submit(function, job)
            numbers[future] = number
            future.add_done_callback(done.put)

    try:
        submit(_MOST_SUBMITTED)
        while numbers:
            future = done.get()
            yield numbers.pop(future), attempt(future.result)
            submit(1)
    except CancelledError as error:
        raise MachineError("the executor gave the work up. Run again: what is done is kept.") from error
    except MachineError:
        raise
    except RuntimeError as error:  # it broke, or takes no work any more
        raise MachineError(f"the executor broke ({error}). Run again: what is done is kept.") from error
    finally:
        for future in numbers:
            future.cancel()


def _by_workers(
    function: Callable[[Job], Result], jobs: Sequence[Job], n_workers: int, limits: Limits
) -> Generator[tuple[int, Result | Failed], None, None]:
    seconds = float("inf") if limits.seconds is None else limits.seconds
    waiting = deque(range(len(jobs)))
    deaths: Counter[int] = Counter()
    workers = [Worker(limits.memory) for _ in range(n_workers)]
    idle = list(workers)
    busy: dict[Future[Result], tuple[Worker, int, float]] = {}  # with the number of the job, and when it must be done
    finished = False
    try:
        # All at the same time, as a process takes seconds to import what it needs
        with workers_environment(), ThreadPoolExecutor(n_workers) as starters:
            list(starters.map(Worker.started, workers))
        while waiting or busy:
            while waiting and idle:
                worker, number = idle.pop(), waiting.popleft()
                future = worker.submit(function, jobs[number])
                busy[future] = worker, number, time.monotonic() + seconds
            soonest = min(deadline for _, _, deadline in busy.values())
            timeout = None if limits.seconds is None else max(0.0, soonest - time.monotonic())
            done, _ = wait(busy, timeout=timeout, return_when=FIRST_COMPLETED)
            for future in done:
                worker, number, _ = busy.pop(future)
                idle.append(worker)
                try:
                    yield number, attempt(future.result, limits)
                except BrokenExecutor:
                    worker.end()
                    deaths[number] += 1
                    if deaths[number] < _MOST_DEATHS:
                        waiting.append(number)
                    else:
                        yield number, Failed(_KILLED)
            for future, (worker, number, deadline) in list(busy.items()):
                if time.monotonic() >= deadline and not future.done():  # as it may be after a slow caller
                    worker.end(kill=True)
                    del busy[future]
                    idle.append(worker)
                    yield number, Failed(f"it took longer than the time_limit of {limits.seconds:g} s.")
        finished = True
    finally:
        for worker in workers:
            worker.end(kill=not finished)

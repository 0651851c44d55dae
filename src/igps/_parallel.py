"""Parallel jobs in processes or threads. A job that fails, or kills its process, does not affect the other jobs.

Each worker process has one job at a time. So if a process dies, its job is known, and a job that takes too long is
stopped by killing its process. Any `concurrent.futures.Executor`, such as that of a cluster, can run the jobs instead.
"""

import queue
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from itertools import islice

from igps._parameters import check_at_least
from igps._threads import Job, Result, n_cores, one_thread, stay_on_one_thread
from igps._threads import n_threads as available_threads
from igps._workers import WorkerPool
from igps.failures import Failed, Limits, MachineError, attempt

_MAX_SUBMITTED = 10_000  # jobs in an executor: enough for the workers of a large cluster, few enough for the memory


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
        yield from WorkerPool(function, jobs, n_workers, limits).results()
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

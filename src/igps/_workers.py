"""A worker process for one job at a time. If the process is killed, only its current job is affected."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from typing import Any, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")

# Each worker has one thread for linear algebra; otherwise, n workers on n cores would run n² threads. The thresholds
# make the allocator of glibc reuse freed memory for the next body, as the system clears each page that it hands out.
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": str(2**26),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
_MAX_STARTS = 2  # of a process that is killed while it starts: an administrator or another program may be the cause


class MachineError(RuntimeError):
    """The machine is at fault, not a job: for example, the disk is full. Finished results are kept."""


class Worker:
    """A process for one job at a time, whose data is limited to `max_bytes`."""

    def __init__(self, max_bytes: int | None) -> None:
        self._max_bytes = max_bytes
        self._pool: ProcessPoolExecutor | None = None
        self._pid = 0

    def submit(self, function: Callable[[Job], Result], job: Job) -> Future[Result]:
        try:
            return self.started().submit(function, job)
        except BrokenExecutor:  # killed while it waited for a job
            self.end()
            return self.started().submit(function, job)

    def started(self) -> ProcessPoolExecutor:
        """Return the executor of the process, which is started if it is not running."""
        context = multiprocessing.get_context("spawn")
        n_starts = 0
        while self._pool is None:
            n_starts += 1
            with workers_environment():
                pool = ProcessPoolExecutor(
                    1, context, initializer=_initialise, initargs=(self._max_bytes,)
                )
                try:
                    with _interrupts_blocked():
                        first = pool.submit(os.getpid)
                    self._pid = first.result()
                    self._pool = pool
                except BrokenExecutor as error:
                    pool.shutdown()
                    if n_starts == _MAX_STARTS:
                        raise MachineError(
                            "no worker process could be started. A script that uses several processes must do so under "
                            "`if __name__ == '__main__':`. Otherwise, raise the memory_limit, check that there is "
                            "enough free memory, or pass n_workers=1. Finished results are kept."
                        ) from error
        return self._pool

    def end(self, kill: bool = False) -> None:
        """End the process. It finishes its job unless it is killed."""
        if self._pool is None:
            return
        if kill:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = None


@contextlib.contextmanager
def workers_environment() -> Generator[None, None, None]:
    """Set the environment variables of processes that are started in this context.

    Libraries read them while they are loaded, which in a spawned process is before any initialiser runs.
    """
    before: dict[str, Any] = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_blocked() -> Generator[None, None, None]:
    """Block Ctrl-C, which reaches all processes, in those that are started in this context: the parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _initialise(max_bytes: int | None) -> None:
    """Limit the memory of a worker process, and make it end when its parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Windows, where it could not be blocked
    if max_bytes is not None:
        with contextlib.suppress(ImportError, ValueError):
            import resource

            resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, max_bytes))
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()

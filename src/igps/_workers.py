"""A worker process, which has one job: if it is killed, that costs no other its result."""

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

# A worker has one thread for linear algebra, or n workers on n cores run n² threads. And glibc's allocator keeps what
# is freed for the next body: pages that are given back come again one by one, each cleared by the system.
_WORKERS_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": str(2**26),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
# A process that is killed while it starts is started once more: an administrator may have been the cause.
_MOST_STARTS = 2


class MachineError(RuntimeError):
    """The machine, not a job, is at fault: a full disk, no memory, a library that is missing. What is done is kept."""


class Worker:
    """A process for one job at a time, which may take so many bytes of data."""

    def __init__(self, memory: int | None) -> None:
        self._memory = memory
        self._pool: ProcessPoolExecutor | None = None
        self._pid = 0

    def submit(self, function: Callable[[Job], Result], job: Job) -> Future[Result]:
        try:
            return self.started().submit(function, job)
        except BrokenExecutor:  # killed while it waited for a job
            self.end()
            return self.started().submit(function, job)

    def started(self) -> ProcessPoolExecutor:
        """The process, started if there is none."""
        context = multiprocessing.get_context("spawn")
        starts = 0
        while self._pool is None:
            starts += 1
            with workers_environment():
                pool = ProcessPoolExecutor(1, context, initializer=_begin, initargs=(self._memory,))
                try:
                    with _uninterrupted():
                        first = pool.submit(os.getpid)
                    self._pid = first.result()
                    self._pool = pool
                except BrokenExecutor as error:
                    pool.shutdown()
                    if starts == _MOST_STARTS:
                        raise MachineError(
                            "no worker process could be started. A script that computes on several processes must call "
                            "it under `if __name__ == '__main__':`; otherwise raise the memory_limit, look for a want "
                            "of memory, or pass n_workers=1. What is done is kept."
                        ) from error
        return self._pool

    def end(self, kill: bool = False) -> None:
        """End the process, in the midst of its work if need be."""
        if self._pool is None:
            return
        if kill:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = None


@contextlib.contextmanager
def workers_environment() -> Generator[None, None, None]:
    """The environment of the processes that are started meanwhile.

    The libraries read it when they are loaded, which in a spawned process is before any initialiser runs.
    """
    before: dict[str, Any] = {name: os.environ.get(name) for name in _WORKERS_ENVIRONMENT}
    os.environ.update(_WORKERS_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _uninterrupted() -> Generator[None, None, None]:
    """Ctrl-C, which goes to all processes, is nothing to those that are started meanwhile: the parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(memory: int | None) -> None:
    """What a worker does first: bound its memory, and watch its parent, to end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it could not be blocked before
    if memory is not None:
        with contextlib.suppress(ImportError, ValueError):
            import resource

            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

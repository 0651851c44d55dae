"""Worker processes with one job each. If a process is killed, only its current job is affected."""

import contextlib
import math
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

from igps.failures import Failed, Limits, MachineError, attempt

# Each worker has one thread for linear algebra; otherwise, n workers on n cores would run n² threads. The thresholds
# make the allocator of glibc reuse freed memory for the next body, as the system clears each page that it hands out.
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(2**26),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
# A process that dies may have been ended by an administrator or by another program: a second attempt is worthwhile.
_MAX_ATTEMPTS = 2
_KILLED = "its process was killed twice. It may need more memory: use fewer workers, or set a memory limit to find out."
_NOT_STARTED = (
    "no worker process could be started. A script that uses several processes must do so under "
    "`if __name__ == '__main__':`. Otherwise, raise the memory_limit, check that there is enough free memory, "
    "or pass n_workers=1. Finished results are kept."
)


class Worker:
    """A process that is started at once, and then takes one job at a time."""

    def __init__(self, limits: Limits) -> None:
        self.job: int | None = None  # index of the job that it has
        self.is_ready = False  # its imports, which take seconds, are done
        self._seconds = math.inf if limits.seconds is None else limits.seconds
        context = multiprocessing.get_context("spawn")
        self.connection, other_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(other_end, limits), daemon=True)
        with workers_environment(), _interrupts_blocked():
            self._process.start()
        other_end.close()  # only the process has it now, so the connection ends with the process

    def give(self, index: int, message: bytes) -> None:
        """Give it a job, as a pickled function without arguments."""
        self.job = index
        self.deadline = time.monotonic() + self._seconds
        with contextlib.suppress(OSError):  # killed while it waited: `receive` will say so
            self.connection.send_bytes(message)

    def receive(self) -> bytes:
        """Return its next message; raise an EOFError or OSError if the process has ended."""
        return self.connection.recv_bytes()

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.join()
        self.connection.close()


class WorkerPool:
    """Workers for one function of many jobs."""

    def __init__(
        self,
        function: Callable[[Any], Any],
        jobs: Sequence[Any],
        n_workers: int,
        limits: Limits,
    ) -> None:
        self._function = function
        self._jobs = jobs
        self._n_workers = n_workers
        self._limits = limits
        self._waiting = deque(range(len(jobs)))
        self._workers: list[Worker] = []
        self._n_deaths: Counter[int] = Counter()
        self._n_failed_starts = 0

    def results(self) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result, or the failure, of each job as it finishes."""
        try:
            while n_unfinished := len(self._waiting) + len(self._busy()):
                while len(self._workers) < min(self._n_workers, n_unfinished):
                    self._workers.append(Worker(self._limits))
                yield from self._give_jobs()
                self._wait()
                for worker in list(self._workers):
                    yield from self._news(worker)
        finally:
            for worker in self._workers:
                worker.end()

    def _busy(self) -> list[Worker]:
        return [worker for worker in self._workers if worker.job is not None]

    def _give_jobs(self) -> Iterator[tuple[int, Failed]]:
        for worker in self._workers:
            while self._waiting and worker.is_ready and worker.job is None:
                i = self._waiting.popleft()
                call = partial(self._function, self._jobs[i])
                message = attempt(partial(_pickled, call))
                if isinstance(message, Failed):
                    yield i, message
                else:
                    worker.give(i, message)

    def _wait(self) -> None:
        """Wait until a worker is ready, has an answer, has ended, or takes too long."""
        awaited = [w for w in self._workers if w.job is not None or not w.is_ready]
        timeout = None
        if self._limits.seconds is not None and self._busy():
            next_deadline = min(worker.deadline for worker in self._busy())
            timeout = max(0.0, next_deadline - time.monotonic())
        wait([worker.connection for worker in awaited], timeout)

    def _news(self, worker: Worker) -> Iterator[tuple[int, Any]]:
        i = worker.job
        if worker.connection.poll():
            try:
                message = worker.receive()
            except (EOFError, OSError):
                self._dismiss(worker)
                yield from self._after_death(worker)
                return
            worker.job = None
            worker.is_ready = True
            if i is None:
                self._n_failed_starts = 0
            else:
                yield i, _unpickled(message)
        elif i is not None and time.monotonic() >= worker.deadline:
            self._dismiss(worker)
            yield i, Failed(f"it took longer than the time_limit of {self._limits.seconds:g} s.")

    def _dismiss(self, worker: Worker) -> None:
        self._workers.remove(worker)
        worker.end()

    def _after_death(self, worker: Worker) -> Iterator[tuple[int, Failed]]:
        if not worker.is_ready:
            self._n_failed_starts += 1
            if self._n_failed_starts == _MAX_ATTEMPTS:
                raise MachineError(_NOT_STARTED)
        elif worker.job is not None:
            self._n_deaths[worker.job] += 1
            if self._n_deaths[worker.job] < _MAX_ATTEMPTS:
                self._waiting.append(worker.job)
            else:
                yield worker.job, Failed(_KILLED)


def _serve(connection: Connection, limits: Limits) -> None:
    """Do jobs until the parent ends; the main function of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Windows, where it could not be blocked
    if limits.memory is not None:
        with contextlib.suppress(ImportError, ValueError):
            import resource

            resource.setrlimit(resource.RLIMIT_DATA, (limits.memory, limits.memory))
    _end_with_parent()  # fails under a limit that leaves no memory for a thread
    connection.send_bytes(b"")  # ready
    while True:
        message = connection.recv_bytes()
        connection.send_bytes(_answer(message, limits))


def _answer(message: bytes, limits: Limits) -> bytes:
    """Return the pickled result, Failed or MachineError of a pickled job."""

    def call() -> bytes:
        job = pickle.loads(message)
        return _pickled(job())

    try:
        answer = attempt(call, limits)
    except MachineError as error:
        return _pickled(error)
    return _pickled(answer) if isinstance(answer, Failed) else answer


def _pickled(value: Any) -> bytes:
    return bytes(ForkingPickler.dumps(value))


def _unpickled(message: bytes) -> Any:
    outcome = attempt(partial(pickle.loads, message))
    if isinstance(outcome, MachineError):
        raise outcome
    return outcome


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextlib.contextmanager
def workers_environment() -> Iterator[None]:
    """Set the environment variables of processes that are started in this context.

    Libraries read them while they are loaded, which in a spawned process is before any function of ours runs.
    """
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
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
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C, which reaches all processes, in those that are started in this context: the parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    resource_tracker.ensure_running()  # the start of this helper of multiprocessing would lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

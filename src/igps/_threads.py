"""Numbers of threads, chosen so that no threads wait for each other by spinning.

OpenMP and OpenBLAS split each small product over their threads, which spin while they wait for the slowest. If another
process occupies a core, or a container may use fewer cores than it sees, all threads wait at each product, and one body
takes twenty times as long as on a single thread. Therefore, every call of the library uses one thread of OpenMP and
OpenBLAS (`one_thread`). Large computations are divided into jobs for at most `n_threads` Python threads, which sleep
while they wait (`igps._parallel.on_threads`).
"""

import contextlib
import os
import sys
import threading
from _thread import start_new_thread
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache, partial
from queue import SimpleQueue
from typing import Any, Self, TypeVar

import joblib
import threadpoolctl
import torch

Job = TypeVar("Job")
Result = TypeVar("Result")


def n_cores() -> int:
    """Return the number of cores that the CPU affinity of this process and the quota of its container allow."""
    return joblib.cpu_count()


def n_threads() -> int:
    """Return the number of Python threads for a call: the cores, but at most torch's threads outside `one_thread`."""
    if _state.max_threads is not None:
        return _state.max_threads
    n_torch = _get_torch_threads()
    return (
        min(n_cores(), n_torch) if n_torch > 1 else n_torch
    )  # `n_cores` is slow, as it reads files


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Make torch, NumPy and SciPy use one thread in this thread, and restore their numbers of threads afterwards.

    Other Python threads, also those started meanwhile, keep their number of torch threads. NumPy and SciPy have one
    setting for the whole process, which the last thread that leaves the context restores.
    """
    outside = _state.max_threads
    _state.max_threads = n_threads()
    before = _get_torch_threads()
    try:
        with _blas_on_one_thread():
            if before > 1:
                _set_torch_threads(1)
            yield
    finally:
        if (
            before > 1
        ):  # do not check what torch reports: it may be MKL's number, while new Python threads get one
            _set_torch_threads(before)
        _state.max_threads = outside


def stay_on_one_thread() -> None:
    """Make torch use one thread in this Python thread until it ends, and let `n_threads` return 1 there."""
    _state.max_threads = 1
    if _get_torch_threads() > 1:
        _set_torch_threads(1)


class Team:
    """Threads for a computation of many short steps, each with a few jobs.

    The threads live as long as the context, because starting threads takes longer than a step. The thread that calls
    `each` takes jobs as well, and waits only for jobs that another thread has begun. So a thread that gets no core
    delays nothing. `max_threads` includes the calling thread; it is `n_threads()` if None.
    """

    def __init__(self, max_threads: int | None = None) -> None:
        self.n_threads = max(1, n_threads() if max_threads is None else max_threads)
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        if self.n_threads > 1:
            self._pool = ThreadPoolExecutor(self.n_threads - 1, initializer=stay_on_one_thread)
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def each(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
        """Return the result of every job, in order. Only functions that release the GIL become faster."""
        n_helpers = min(self.n_threads, len(jobs)) - 1
        if self._pool is None or n_helpers < 1:
            return [function(job) for job in jobs]
        results: list[Any] = [None] * len(jobs)
        waiting = iter(range(len(jobs)))
        # The mode is a setting of each thread. Tensors made in inference mode can only be changed in that mode
        inference = torch.is_inference_mode_enabled()

        def work() -> None:
            with torch.inference_mode(inference):
                for i in waiting:  # the GIL gives each index to one thread
                    results[i] = function(jobs[i])

        helpers = [self._pool.submit(work) for _ in range(n_helpers)]
        try:
            work()
        finally:
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
        for helper in begun:
            helper.result()
        return results


SERIAL = Team(1)  # runs all jobs on the calling thread


class _ThreadState(threading.local):
    max_threads: int | None = None  # result of `n_threads` inside `one_thread`; None outside


_state = _ThreadState()


def _at_fork(**hooks: Callable[[], object]) -> None:
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(**hooks)


def _fork_safe_lock() -> threading.Lock:
    """Return a lock for which a fork waits, because a lock that is held during a fork stays locked in the child."""
    lock = threading.Lock()
    _at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)
    return lock


class ProcessSetting:
    """Context that changes a setting of the whole process, and that many threads can use at the same time.

    The first thread that enters calls `change`. The last thread that leaves calls the function that `change` returned,
    which restores the setting. In a forked child, only the thread that forked exists, and only that thread counts.
    """

    def __init__(self, change: Callable[[], Callable[[], None]]) -> None:
        self._change = change
        self._lock = _fork_safe_lock()
        self._users: list[int] = []
        self._restore: Callable[[], None] | None = None
        _at_fork(after_in_child=lambda: self._forget_others(threading.get_ident()))

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        user = threading.get_ident()
        with self._lock:
            if not self._users:
                self._restore = self._change()
            self._users.append(user)
        try:
            yield
        finally:
            with self._lock:
                self._users.remove(user)
                self._restore_if_unused()

    def _forget_others(self, user: int) -> None:
        self._users = [ident for ident in self._users if ident == user]
        self._restore_if_unused()

    def _restore_if_unused(self) -> None:
        if not self._users and self._restore is not None:
            self._restore()
            self._restore = None


_torch_threads = _fork_safe_lock()


def _get_torch_threads() -> int:
    """Return the torch threads of this Python thread, but not while `_set_torch_threads` sets those of another."""
    with _torch_threads:
        return torch.get_num_threads()


def _set_torch_threads(n: int) -> None:
    """Set the number of torch threads of this Python thread only.

    `torch.set_num_threads` also sets the default for threads that have not computed yet. A new thread restores it.
    """
    with _torch_threads, contextlib.ExitStack() as afterwards:
        with contextlib.suppress(RuntimeError):  # the system starts no more threads
            default = _in_new_thread(torch.get_num_threads)
            afterwards.callback(_in_new_thread, partial(torch.set_num_threads, default))
        torch.set_num_threads(n)


def _in_new_thread(function: Callable[[], Result]) -> Result:
    results: SimpleQueue[Result] = SimpleQueue()
    start_new_thread(
        lambda: results.put(function()), ()
    )  # `Thread.start` would wait until the thread runs
    return results.get()


@lru_cache(maxsize=1)
def _libraries(n_modules: int) -> threadpoolctl.ThreadpoolController:
    """Return the loaded thread pools, cached until an import, as finding them takes as long as a small product."""
    return threadpoolctl.ThreadpoolController()


def _blas_to_one_thread() -> Callable[[], None]:
    """Limit the BLAS libraries of NumPy and SciPy to one thread, and return a function that lifts the limit."""
    limits = _libraries(len(sys.modules)).limit(limits=1, user_api="blas")
    _release_control()

    def restore() -> None:
        limits.restore_original_limits()
        _release_control()

    return restore


def _release_control() -> None:
    """Let other threads lift the limit. Since threadpoolctl 3.8, only the thread that set it may, while it is alive."""
    clear = getattr(
        getattr(threadpoolctl, "OpenBLASController", None), "clear_controlling_thread", None
    )
    if clear is not None:
        clear()


_blas_on_one_thread = ProcessSetting(_blas_to_one_thread)

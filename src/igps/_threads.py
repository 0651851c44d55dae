"""How many threads a call may use: few, and none that wait for each other by spinning.

The threads of OpenMP and of OpenBLAS divide each small product among them and spin while they wait for the slowest.
Where another process has the core of one, or a container has fewer cores granted than it sees, all wait for it each
time: one body then takes twenty times as long as on a single thread. So every call of the library computes on one
thread of theirs (`one_thread`). What is large is divided into jobs for threads of Python, which compute with one thread
each and sleep while they wait (`igps._parallel.on_threads`), at most `n_threads` of them.
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
    """Cores that this process may keep busy: by its affinity and by the quota of its container, at least 1."""
    return joblib.cpu_count()


def n_threads() -> int:
    """Threads of Python that this call may use: as many as cores, but no more than torch had before the call."""
    if _state.most is not None:
        return _state.most
    most = _get_torch_threads()
    return min(n_cores(), most) if most > 1 else most  # counting cores means reading files


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Torch, NumPy and SciPy on one thread in this thread, and afterwards on as many as before.

    Other threads of the process keep their torch threads, and those started meanwhile get what they would have got.
    NumPy and SciPy have one setting for all threads: the last thread to leave restores it.
    """
    outside = _state.most
    _state.most = n_threads()
    before = _get_torch_threads()
    try:
        with _blas_on_one_thread():
            if before > 1:
                _set_torch_threads(1)
            yield
    finally:
        if before > 1:  # torch may count those of MKL, which has its own again, while new threads would get one
            _set_torch_threads(before)
        _state.most = outside


def stay_on_one_thread() -> None:
    """As `one_thread`, but for the rest of this thread's life, and with no other beside it."""
    _state.most = 1
    if _get_torch_threads() > 1:
        _set_torch_threads(1)


class Team:
    """Threads that stay for a computation of many short steps, each of a few jobs.

    To start threads for every step would take longer than the step. The thread that calls `each` takes jobs as well,
    and waits only for jobs that another thread has begun. So a thread that gets no core delays nothing. There
    are at most so many threads, the calling one included; `n_threads` if None.
    """

    def __init__(self, most: int | None = None) -> None:
        self.n_threads = max(1, n_threads() if most is None else most)
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
        """The result of every job, in order; only functions that release the interpreter's lock get faster."""
        n_helpers = min(self.n_threads, len(jobs)) - 1
        if self._pool is None or n_helpers < 1:
            return [function(job) for job in jobs]
        results: list[Any] = [None] * len(jobs)
        waiting = iter(range(len(jobs)))

        # PyTorch keeps the mode of each thread, and lets no other mode change tensors made in inference mode
        inference = torch.is_inference_mode_enabled()

        def work() -> None:
            with torch.inference_mode(inference):
                for number in waiting:  # the interpreter's lock gives each number to one thread
                    results[number] = function(jobs[number])

        helpers = [self._pool.submit(work) for _ in range(n_helpers)]
        try:
            work()
        finally:
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
        for helper in begun:
            helper.result()
        return results


# Does all jobs on the calling thread
ALONE = Team(1)


class _ThreadState(threading.local):
    """Settings of one thread."""

    most: int | None = None  # `n_threads` inside `one_thread`; None outside


_state = _ThreadState()


def _at_fork(**hooks: Callable[[], object]) -> None:
    """`os.register_at_fork`, where a process can fork."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(**hooks)


def _fork_safe_lock() -> threading.Lock:
    """A lock that no thread holds while the process forks, else it would stay closed in the child: a fork waits."""
    lock = threading.Lock()
    _at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)
    return lock


class ProcessSetting:
    """A context in which a setting of the whole process is changed, for any number of threads at once.

    The first that enters changes it, the last that leaves restores it, by what `change` returned. In a forked child
    only the thread that forked lives on: the others no longer count.
    """

    def __init__(self, change: Callable[[], Callable[[], None]]) -> None:
        self._change = change
        self._lock = _fork_safe_lock()
        self._users: list[int] = []
        self._restore: Callable[[], None] | None = None
        _at_fork(after_in_child=lambda: self._keep_only(threading.get_ident()))

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

    def _keep_only(self, user: int) -> None:
        self._users = [one for one in self._users if one == user]
        self._restore_if_unused()

    def _restore_if_unused(self) -> None:
        if not self._users and self._restore is not None:
            self._restore()
            self._restore = None


_torch_threads = _fork_safe_lock()


def _get_torch_threads() -> int:
    """Of this thread. The lock keeps it from seeing, on a new thread, what `_set_torch_threads` sets for another."""
    with _torch_threads:
        return torch.get_num_threads()


def _set_torch_threads(n: int) -> None:
    """For this thread alone.

    `torch.set_num_threads` also sets the number for threads that have not computed yet. One of those sets it back.
    """
    with _torch_threads, contextlib.ExitStack() as afterwards:
        with contextlib.suppress(RuntimeError):  # the system starts no more threads
            of_new_threads = _in_new_thread(torch.get_num_threads)
            afterwards.callback(_in_new_thread, partial(torch.set_num_threads, of_new_threads))
        torch.set_num_threads(n)


def _in_new_thread(function: Callable[[], Result]) -> Result:
    """The result of a function in a thread that has not computed before."""
    answer: SimpleQueue[Result] = SimpleQueue()
    start_new_thread(lambda: answer.put(function()), ())  # `Thread.start` would wait until it runs
    return answer.get()


@lru_cache(maxsize=1)
def _libraries(n_modules: int) -> threadpoolctl.ThreadpoolController:
    """The loaded libraries. Finding them takes as long as a small product, and only an import adds to them."""
    return threadpoolctl.ThreadpoolController()


def _blas_to_one_thread() -> Callable[[], None]:
    """For NumPy's and SciPy's products; returns what restores their threads.

    As long as the thread that set a limit is alive, threadpoolctl lets no other lift it: so it gives up its claim.
    """
    limits = _libraries(len(sys.modules)).limit(limits=1, user_api="blas")
    _release_control()

    def restore() -> None:
        limits.restore_original_limits()
        _release_control()

    return restore


def _release_control() -> None:
    """Threadpoolctl before 3.8 lets every thread set and lift limits, and has no claim to give up."""
    clear = getattr(getattr(threadpoolctl, "OpenBLASController", None), "clear_controlling_thread", None)
    if clear is not None:
        clear()


_blas_on_one_thread = ProcessSetting(_blas_to_one_thread)

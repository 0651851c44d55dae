"""Numbers of threads, chosen so that no threads wait for each other by spinning.

OpenMP and OpenBLAS split each small product over their threads, which spin while they wait for the slowest. If another
process occupies a core, or a container may use fewer cores than it sees, all threads wait at each product, and one body
takes twenty times as long as on a single thread. Therefore, every call of the library uses one thread of OpenMP and
OpenBLAS (`one_thread`). Large computations are divided into jobs for at most `n_threads` Python threads, which sleep
while they wait (`igps._parallel.on_threads`).

Torch, which takes seconds to load, is not loaded here: a process that only reads and measures bodies does without it.
"""

import contextlib
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Self, TypeVar

import threadpoolctl

Job = TypeVar("Job")
Result = TypeVar("Result")

# Where Linux tells a container its share of the processor: microseconds of work in a period, and the period.
CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")


def n_cores() -> int:
    """Return the number of cores that the CPU affinity of this process and the quota of its container allow."""
    n_visible = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        n_visible = len(os.sched_getaffinity(0))
    with contextlib.suppress(OSError, ValueError):
        quota, period = CPU_QUOTA.read_text().split()
        if quota != "max":
            return min(n_visible, math.ceil(int(quota) / int(period)))
    return n_visible


def n_threads() -> int:
    """Return the number of Python threads for a call: the cores, but at most torch's threads outside `one_thread`."""
    if _state.max_threads is not None:
        return _state.max_threads
    return min(n_cores(), _n_torch_threads())


def _n_torch_threads() -> int:
    """Return torch's number of threads, or the one that it will have once it is loaded."""
    torch = _loaded_torch()
    if torch is not None:
        return int(torch.get_num_threads())
    set_by_user = os.environ.get("OMP_NUM_THREADS", "")
    return int(set_by_user) if set_by_user.isdecimal() else n_cores()


def _loaded_torch() -> Any:
    """Return torch, or None if it is not loaded, or not to its end by another thread."""
    torch = sys.modules.get("torch")
    return torch if hasattr(torch, "set_num_threads") else None


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Make torch, NumPy and SciPy use one thread in this thread, and restore their numbers of threads afterwards.

    Python threads that use torch for the first time meanwhile have one thread, too. NumPy and SciPy have one setting
    for the whole process, which the last thread that leaves the context restores.
    """
    outside = _state.max_threads
    torch = _loaded_torch()
    n_torch = 1 if torch is None else torch.get_num_threads()
    _state.max_threads = n_threads()
    try:
        with _blas_on_one_thread():
            if n_torch > 1:
                torch.set_num_threads(1)
            yield
    finally:
        if n_torch > 1:
            torch.set_num_threads(n_torch)
        _state.max_threads = outside


def stay_on_one_thread() -> None:
    """Let `n_threads` return 1 in this Python thread until it ends."""
    _state.max_threads = 1


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
            self._pool = ThreadPoolExecutor(self.n_threads - 1, initializer=_compute_on_one_thread)
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
        torch = _loaded_torch()
        mode: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext
        if torch is not None:
            mode = partial(torch.inference_mode, torch.is_inference_mode_enabled())

        def work() -> None:
            with mode():
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


def _compute_on_one_thread() -> None:
    stay_on_one_thread()
    torch = _loaded_torch()
    if torch is not None:
        torch.set_num_threads(1)


class ProcessSetting:
    """Context that changes a setting of the whole process, and that many threads can use at the same time.

    The first thread that enters calls `change`. The last thread that leaves calls the function that `change` returned,
    which restores the setting. A fork waits for the lock, because a lock that is held stays locked in the child.
    """

    def __init__(self, change: Callable[[], Callable[[], None]]) -> None:
        self._change = change
        self._lock = threading.Lock()
        self._n_users = 0
        self._restore: Callable[[], None] | None = None
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(
                before=self._lock.acquire,
                after_in_parent=self._lock.release,
                after_in_child=self._lock.release,
            )

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._n_users == 0:
                self._restore = self._change()
            self._n_users += 1
        try:
            yield
        finally:
            with self._lock:
                self._n_users -= 1
                if self._n_users == 0 and self._restore is not None:
                    self._restore()


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
    controller = getattr(threadpoolctl, "OpenBLASController", None)
    clear = getattr(controller, "clear_controlling_thread", None)
    if clear is not None:
        clear()


_blas_on_one_thread = ProcessSetting(_blas_to_one_thread)

"""How many threads a call may use, in one place: few, and none that wait for each other by spinning.

The threads of OpenMP and of OpenBLAS divide each small product among them and spin while they wait for the slowest.
Where another process has the core of one, or a container has fewer cores granted than it sees, all wait for it each
time: one body then takes twenty times as long as on a single thread. So every call of the library computes on one
thread of theirs (`one_thread`). What is large is divided into jobs for threads of Python, which compute with one thread
each and sleep while they wait (`igps._parallel.on_threads`), at most `n_threads` of them.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import threading
from _thread import start_new_thread
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

import threadpoolctl
import torch

Job = TypeVar("Job")
Result = TypeVar("Result")

_PROC = Path("/proc/self")


def n_cores() -> int:
    """Cores that this process may keep busy: by its affinity and by the quota of its container, at least 1."""
    seen = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota()
    return seen if quota is None else max(1, min(seen, math.ceil(quota)))


def n_threads() -> int:
    """Threads of Python that the present call may use: as many as cores, but no more than torch had before the call."""
    if _present.most is not None:
        return _present.most
    most = _get_torch_threads()
    return min(n_cores(), most) if most > 1 else most  # how many cores there are is asked of files


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Torch, NumPy and SciPy on one thread in this thread, and afterwards on as many as before.

    Other threads of the process keep their torch threads, and those started meanwhile get what they would have got.
    NumPy and SciPy have one setting for all threads: it is restored by whoever is the last to leave.
    """
    outside = _present.most
    _present.most = n_threads()
    before = _get_torch_threads()
    try:
        with _blas_on_one_thread():
            _set_torch_threads(1)
            yield
    finally:
        _set_torch_threads(before)
        _present.most = outside


def stay_on_one_thread() -> None:
    """As `one_thread`, but for the rest of this thread's life, and with no other beside it."""
    _present.most = 1
    _set_torch_threads(1)


class Team:
    """Threads that stay for a computation of many short steps, each of a few jobs.

    To start threads for every step would take longer than the step. Who asks works too, and waits only for jobs that
    another has begun: beside a busy process, whose core it is, a thread that is not let run delays nobody.

    Args:
        most: with the one that asks; as many as `n_threads` if None.
    """

    def __init__(self, most: int | None = None) -> None:
        self.n_threads = max(1, n_threads() if most is None else most)
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> Team:
        if self.n_threads > 1:
            self._pool = ThreadPoolExecutor(self.n_threads - 1, initializer=stay_on_one_thread)
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def each(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
        """The result of every job, in order; the function must release the interpreter's lock to gain from it."""
        n_helpers = min(self.n_threads, len(jobs)) - 1
        if self._pool is None or n_helpers < 1:
            return [function(job) for job in jobs]
        results: list[Any] = [None] * len(jobs)
        waiting = iter(range(len(jobs)))

        def work() -> None:
            for number in waiting:  # the interpreter's lock gives each number to one thread
                results[number] = function(jobs[number])

        helpers = [self._pool.submit(_in_mode, torch.is_inference_mode_enabled(), work) for _ in range(n_helpers)]
        try:
            work()
        finally:
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
        for helper in begun:
            helper.result()
        return results


def _in_mode(inference: bool, function: Callable[[], None]) -> None:
    """PyTorch keeps the mode of each thread, and lets no other mode change tensors that were made in inference mode."""
    with torch.inference_mode(inference):
        function()


# One thread, for whoever needs no other
ALONE = Team(1)


def cpu_quota(proc: Path = _PROC) -> float | None:
    """Cores that the control groups of this process grant it, cgroup v1 or v2; None without a limit.

    A group has at most what the groups around it have. What cannot be read is no limit.

    Args:
        proc: the folder of the process, with its `cgroup` and `mountinfo`.
    """
    try:
        memberships = (proc / "cgroup").read_text().splitlines()
        mounts = [mount for line in (proc / "mountinfo").read_text().splitlines() if (mount := _mount(line))]
    except (OSError, UnicodeDecodeError):
        return None
    quotas = []
    for membership in memberships:
        number, _, rest = membership.partition(":")
        controllers, _, group = rest.partition(":")
        if number == "0" and not controllers:
            kind, controller, read = "cgroup2", "", _unified_quota
        elif "cpu" in controllers.split(","):
            kind, controller, read = "cgroup", "cpu", _legacy_quota
        else:
            continue
        for mount in mounts:
            if mount.kind == kind and (not controller or controller in mount.options):
                quotas += [read(folder) for folder in _groups(mount, group)]
    return min((quota for quota in quotas if quota is not None), default=None)


class _Present(threading.local):
    """What holds for the calls of one thread.

    Attributes:
        most: `n_threads` inside `one_thread`; None outside.
    """

    most: int | None = None


_present = _Present()
_torch_threads = threading.Lock()


def _get_torch_threads() -> int:
    """Of this thread; where it has not computed yet, never what `_set_torch_threads` means for another."""
    with _torch_threads:
        return torch.get_num_threads()


def _set_torch_threads(n: int) -> None:
    """For this thread alone.

    `torch.set_num_threads` also sets with how many a thread starts that computes for the first time. Another such
    thread sets that back.
    """
    if _get_torch_threads() == n:
        return
    with _torch_threads, _new_threads.one() as ask:
        of_new_threads = ask(torch.get_num_threads)
        torch.set_num_threads(n)
        ask(lambda: torch.set_num_threads(of_new_threads))


_Questions = SimpleQueue[Callable[[], Any] | None]
_Answers = SimpleQueue[Any]


class _NewThreads:
    """Threads that have not computed yet, started ahead of their use.

    Beside busy processes a thread takes milliseconds until it runs for the first time, but hardly any time to wake.
    """

    _AHEAD = 2  # as many as `one_thread` takes

    def __init__(self) -> None:
        self._asleep: deque[tuple[_Questions, _Answers]] = deque()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._asleep.clear)  # of the threads, only the one that forks lives on

    @contextlib.contextmanager
    def one(self) -> Iterator[Callable[[Callable[[], Any]], Any]]:
        """Calls functions of the caller in one new thread, and gives their results."""
        try:
            questions, answers = self._asleep.popleft()
        except IndexError:
            questions, answers = self._started()

        def ask(function: Callable[[], Any]) -> Any:
            questions.put(function)
            return answers.get()

        try:
            yield ask
        finally:
            questions.put(None)
            with contextlib.suppress(RuntimeError):  # where the system gives no more, one is started when it is needed
                while len(self._asleep) < self._AHEAD:
                    self._asleep.append(self._started())

    @staticmethod
    def _started() -> tuple[_Questions, _Answers]:
        questions, answers = _Questions(), _Answers()

        def work() -> None:
            while (function := questions.get()) is not None:
                answers.put(function())

        start_new_thread(work, ())  # `Thread.start` would wait until it runs
        return questions, answers


_new_threads = _NewThreads()


@lru_cache(maxsize=1)
def _libraries(n_modules: int) -> threadpoolctl.ThreadpoolController:
    """Those that are loaded; to look for them takes as long as a small product, and only an import brings others."""
    return threadpoolctl.ThreadpoolController()


class _Blas:
    """The threads of NumPy's and SciPy's products: a setting of the process, so that those who need it are counted.

    As long as a thread is alive that has set a limit, threadpoolctl lets no other lift it; so who has set one lets go.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._restore: Callable[[], None] | None = None

    @contextlib.contextmanager
    def on_one_thread(self) -> Iterator[None]:
        with self._lock:
            if self._users == 0:
                limits = _libraries(len(sys.modules)).limit(limits=1, user_api="blas")
                self._restore = limits.restore_original_limits
                _let_go()
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0 and self._restore is not None:
                    self._restore()
                    _let_go()


def _let_go() -> None:
    """Threadpoolctl before 3.8 lets every thread set and lift limits, and has nothing to let go of."""
    clear = getattr(getattr(threadpoolctl, "OpenBLASController", None), "clear_controlling_thread", None)
    if clear is not None:
        clear()


_blas_on_one_thread = _Blas().on_one_thread


@dataclass(frozen=True)
class _Mount:
    """A mounted file system.

    Args:
        kind: of file system.
        options: of its superblock; of cgroup v1 with its controllers.
        root: the folder of it that is mounted; of a control group file system, which group.
        folder: where.
    """

    kind: str
    options: tuple[str, ...]
    root: str
    folder: Path


def _mount(line: str) -> _Mount | None:
    """A line of mountinfo, see proc_pid_mountinfo(5); None where it cannot be understood."""
    before, _, after = line.partition(" - ")
    fields, described = before.split(" "), after.split(" ")
    if len(fields) < 5 or len(described) < 3:
        return None
    root, folder = (re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), name) for name in fields[3:5])
    return _Mount(described[0], tuple(described[2].split(",")), root, Path(folder))


def _groups(mount: _Mount, group: str) -> list[Path]:
    """The folders of a group and of those around it, as far as they are mounted: in a container often one."""
    inside = os.path.relpath(group, mount.root)
    if inside.startswith(".."):  # as another namespace sees it: what is mounted is ours
        inside = "."
    innermost = mount.folder / inside
    return [one for one in (innermost, *innermost.parents) if one == mount.folder or mount.folder in one.parents]


def _unified_quota(folder: Path) -> float | None:
    quota, _, period = _read(folder / "cpu.max").partition(" ")
    return _ratio(quota, period)


def _legacy_quota(folder: Path) -> float | None:
    return _ratio(_read(folder / "cpu.cfs_quota_us"), _read(folder / "cpu.cfs_period_us"))


def _read(file: Path) -> str:
    try:
        return file.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _ratio(quota: str, period: str) -> float | None:
    try:
        granted = int(quota) / int(period)
    except (ValueError, ZeroDivisionError):
        return None  # "max", or nothing
    return granted if granted > 0 else None

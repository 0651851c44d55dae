import errno
import mmap
import multiprocessing
import os
import platform
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

import jobs
from igps._parallel import run
from igps.failures import Failed, Limits, MachineError

GIB = 2**30
LINUX = sys.platform == "linux"
# Bytes of a body that a worker keeps for the next
PAGES = 40 * 2**20
needs_proc = pytest.mark.skipif(
    not Path("/proc").is_dir(), reason="needs /proc to see whether a process lives"
)


def all_of(*arguments, **options):
    """Results by number; none comes twice."""
    results = list(run(*arguments, **options))
    assert len(dict(results)) == len(results)
    return dict(results)


def script_of(folder, text):
    """The command of a script that has the names of this module."""
    head = f"import os, signal, sys\nsys.path.append({str(Path(jobs.__file__).parent)!r})\n"
    head += "import jobs\nfrom igps.failures import Limits\nfrom igps._parallel import run\n"
    (folder / "script.py").write_text(head + text)
    return [sys.executable, str(folder / "script.py")]


def ended(pid):
    """Whether a process ends within ten seconds."""
    for _ in range(100):
        if not Path(f"/proc/{pid}").exists():
            return True
        time.sleep(0.1)
    return False


SQUARES = [partial(jobs.square, x) for x in (3, -1, 5, 13, 0, 8)]
OF_SQUARES = {
    0: 9,
    1: Failed("x: expected a natural number, got -1."),
    2: 25,
    3: Failed("KeyError: 'thirteen'"),
    4: 0,
    5: 64,
}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Of two workers, whose parent has other settings: squares, two that die, two that tell of themselves."""
    others = [
        partial(jobs.die_at_zero, 0),
        partial(jobs.die_once, tmp_path_factory.mktemp("marked") / "marker"),
        *2 * [partial(jobs.process, 0)],
        partial(jobs.interrupt, 7),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "3")
        patch.delenv("MKL_NUM_THREADS", raising=False)
        found = all_of(jobs.call, [*SQUARES, *others], n_workers=2)
        assert os.environ["OMP_NUM_THREADS"] == "3"
        assert "MKL_NUM_THREADS" not in os.environ
    return found


@pytest.fixture(scope="module")
def limited():
    """Of one worker with limits: two that tell of themselves, large and small, three of one size, slow and quick."""
    found = [partial(jobs.process, 0)] * 2
    found += [partial(jobs.allocate, size) for size in (1000, 2 * GIB, 2000)]
    found += [partial(jobs.pages_cleared, PAGES)] * 3
    found += [partial(jobs.sleep, seconds) for seconds in (0.1, 1000.0, 0.2)]
    limits = Limits(seconds=5, memory=GIB if LINUX else None)
    return all_of(jobs.call, found, n_workers=1, limits=limits)


def test_every_job_has_its_result_in_this_process_and_in_others(results):
    assert all_of(jobs.call, SQUARES, n_workers=1) == OF_SQUARES
    assert {number: results[number] for number in OF_SQUARES} == OF_SQUARES


def test_a_job_that_kills_its_process_is_named(results):
    killed = results[6]
    assert isinstance(killed, Failed)
    assert killed.reason.startswith("its process was killed twice. It may need more memory")


def test_a_job_that_is_killed_once_is_tried_again(results):
    assert results[7] == "marker"


def test_workers_leave_an_interruption_to_their_parent(results):
    """A terminal sends Ctrl-C to all processes; only the parent may report it."""
    assert results[10] == 7


@pytest.mark.skipif(os.name == "nt", reason="signals cannot be blocked")
def test_workers_leave_it_to_their_parent_while_they_start(tmp_path):
    """They import what the script does, for seconds."""
    command = script_of(
        tmp_path,
        "if __name__ == '__mp_main__':\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "if __name__ == '__main__':\n"
        "    print(*run(abs, [-7], limits=Limits(seconds=100)))\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in jobs in the background
        "    os.kill(os.getpid(), signal.SIGINT)\n",
    )
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout == "(0, 7)\n"
    assert done.stderr.count("Traceback") == 1  # the script's own
    assert "KeyboardInterrupt" in done.stderr


def test_workers_have_one_thread(results):
    assert {results[number][1] for number in (8, 9)} == {"1"}


def test_nothing_to_do():
    assert all_of(jobs.square, [], n_workers=4) == {}
    assert all_of(jobs.square, [], n_workers=4, limits=Limits(seconds=1)) == {}


def test_fewer_than_one_worker_is_refused():
    """0 took all cores, and -1, which elsewhere stands for all, took one."""
    for n_workers in (0, -1):
        words = rf"n_workers: expected at least 1, got {n_workers}\."
        with pytest.raises(ValueError, match=words):
            all_of(jobs.square, [1, 2], n_workers=n_workers)


def test_one_worker_is_this_process_unless_there_are_limits(limited):
    assert all_of(jobs.process, [0, 0], n_workers=1)[1][0] == os.getpid()
    assert limited[0][0] == limited[1][0] != os.getpid()


@pytest.mark.skipif(not LINUX, reason="Linux alone enforces a memory limit")
def test_a_job_that_needs_too_much_memory_is_named(limited):
    expected = [1000, Failed("it needs more than the memory_limit of 1024 MiB."), 2000]
    assert [limited[number] for number in (2, 3, 4)] == expected


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other allocators are left as they are"
)
@pytest.mark.skipif(
    "[always]" in jobs.huge_pages(),
    reason="the system hands out huge pages, of which there are few",
)
@pytest.mark.skipif(not LINUX, reason="Linux alone enforces a memory limit")
def test_a_limit_below_what_python_itself_takes_is_to_be_raised():
    with pytest.raises(MachineError, match="raise the memory_limit"):
        all_of(
            jobs.call,
            [len],
            n_workers=1,
            limits=Limits(memory=2**20),
        )


def test_a_worker_keeps_the_memory_of_one_body_for_the_next(limited):
    first, second, third = (limited[number] for number in (5, 6, 7))
    assert first > 0.9 * PAGES / mmap.PAGESIZE
    assert max(second, third) < first / 10


def test_a_job_that_takes_too_long_is_ended(limited):
    expected = [0.1, Failed("it took longer than the time_limit of 5 s."), 0.2]
    assert [limited[number] for number in (8, 9, 10)] == expected


@pytest.mark.parametrize("where", ["here", "workers", "executor"])
@pytest.mark.parametrize(
    ("job", "message"),
    [
        (partial(jobs.fail_with, errno.ENOSPC), "ENOSPC.*Free disk space.*run again"),
        (partial(jobs.fail_with, errno.EMFILE), "EMFILE.*Raise the limit of open files.*run again"),
        (partial(jobs.fail_with, 0), "out of memory. Use fewer workers"),
        (
            partial(jobs.need_library, "no_lib"),
            "No module named 'no_lib'.*Install it and run again",
        ),
    ],
    ids=["disk", "files", "memory", "library"],
)
def test_the_machine_is_not_the_jobs_fault(where, job, message):
    """It is told once, and not of every job."""
    limits = Limits(seconds=100) if where == "workers" else None
    with ThreadPoolExecutor(1) as pool:
        executor = pool if where == "executor" else None
        results = run(
            jobs.call,
            [job] * 3,
            n_workers=1,
            executor=executor,
            limits=limits,
        )
        with pytest.raises(MachineError, match=message):
            list(results)


def test_other_errors_of_the_system_are_those_of_a_job():
    failed = Failed("FileNotFoundError: [Errno 2] ENOENT")
    assert all_of(jobs.fail_with, [errno.ENOENT], n_workers=1) == {0: failed}


@pytest.mark.parametrize(
    "make",
    [
        lambda: ThreadPoolExecutor(2),
        lambda: ProcessPoolExecutor(1, multiprocessing.get_context("spawn")),
    ],
)
def test_another_executor_does_the_work(make):
    with make() as pool:
        results = all_of(jobs.square, [4, -2, 6], executor=pool)
    assert results == {0: 16, 1: Failed("x: expected a natural number, got -2."), 2: 36}


def test_an_executor_that_breaks_is_the_machine():
    with (
        ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool,
        pytest.raises(MachineError, match="the executor broke"),
    ):
        list(run(jobs.die_at_zero, [1, 0, 2], executor=pool))


def test_an_executor_has_limits_of_its_own():
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(ValueError, match="limits: expected None with an executor"),
    ):
        list(
            run(
                jobs.square,
                [1],
                executor=pool,
                limits=Limits(seconds=1),
            )
        )


def test_a_caller_that_takes_its_time_costs_no_job_its_result():
    found = []
    for number, result in run(
        jobs.sleep,
        [0.1, 0.6],
        n_workers=2,
        limits=Limits(seconds=1),
    ):
        found.append((number, result))
        time.sleep(1.5)
    assert found == [(0, 0.1), (1, 0.6)]


@pytest.mark.parametrize(
    ("name", "options"), [("time_limit", {"seconds": 0}), ("memory_limit", {"memory": -5})]
)
def test_impossible_limits_are_refused(name, options):
    with pytest.raises(ValueError, match=f"{name}: expected None or a positive number"):
        Limits(**options)


def test_a_script_without_a_main_guard_is_told(tmp_path):
    command = script_of(tmp_path, "list(run(abs, [1], limits=Limits(seconds=9)))\n")
    told = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert told.returncode != 0
    assert "MachineError: no worker process could be started" in told.stderr
    assert "under `if __name__ == '__main__':`" in told.stderr


@needs_proc
def test_no_process_is_left_when_the_caller_stops_early():
    results = run(jobs.process, [0] * 20, n_workers=2)
    _, (first, _) = next(results)
    results.close()
    assert ended(first)
    assert multiprocessing.active_children() == []


@needs_proc
def test_workers_end_with_a_killed_parent(tmp_path):
    command = script_of(
        tmp_path,
        "if __name__ == '__main__':\n"
        "    for _, (worker, _) in run(jobs.process, [0], limits=Limits(seconds=100)):\n"
        "        print(worker, flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n",
    )
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
    if not ended(worker):
        os.kill(worker, signal.SIGKILL)
        pytest.fail("the worker outlived its parent")

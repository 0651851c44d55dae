"""Processes are killed at random times; later runs compute the same results as an undisturbed run."""

import os
import shutil
import signal
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.random import default_rng
from outcome import Row
from retrieving import Command, is_python_worker, partials, table, write_shapes

SEED = 13
N_PROCESSES = 8
N_KILLED = 4
# Kills of workers in one run. Each one starts a new process, which takes as long as all computation of the run.
N_WORKER_KILLS = 3
_DAY = 24 * 3600
# Time limits for a run of twelve small shapes and for the end of a worker, seconds. The runs take some seconds and
# workers end at once, but not on a busy machine.
_RUN_TIMEOUT = 600.0
_WORKER_TIMEOUT = 120.0
_TARGET = "table equals the undisturbed one"


@contextmanager
def _workplace():
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        write_shapes(Path(folder) / "shapes")
        yield Path(folder)


def campaign(n_kills):
    """Kill workers and parents (a quarter of the kills each), and some of eight processes on one cache (half)."""
    with _workplace() as folder:
        seconds = {}
        for n_workers in (1, 2):
            undisturbed = _Run(folder, f"undisturbed-{n_workers}")
            start = time.monotonic()
            if undisturbed.command(n_workers).wait() != 0:
                raise RuntimeError(f"the undisturbed run failed: {undisturbed.log_end()}")
            seconds[n_workers] = time.monotonic() - start
        expected = undisturbed.table()
        quarter = max(n_kills // 4, 1)
        rows = [
            _workers(folder, expected, quarter, seconds[2]),
            _parents(folder, expected, quarter, seconds),
            _eight(folder, expected, max(n_kills - 2 * quarter, N_KILLED)),
        ]
        rows.append(_leftovers(folder, expected))
    return rows


class _Run:
    """A run with a separate cache and output folder."""

    def __init__(self, folder, name):
        self.shapes = folder / "shapes"
        self.cache = folder / "caches" / name
        self.out = folder / "out" / name

    def command(self, n_workers, out=None):
        return Command(self.shapes, self.cache, out or self.out, n_workers)

    def table(self):
        return table(self.out)

    def blames_mesh(self):
        """Whether a mesh was skipped because its worker was killed twice."""
        failures = self.out / "failures.csv"
        return failures.exists() and "killed twice" in failures.read_text()

    def has_message(self):
        """Whether the log ends with a message of the command, and without a traceback."""
        return "igps:" in self.log_end() and "Traceback" not in self.log_end()

    def log_end(self):
        return self.out.with_suffix(".log").read_text()[-300:]


def _check_rerun(run, expected, what):
    """Run once more without disturbance, and return what is wrong with the results."""
    shutil.rmtree(run.out, ignore_errors=True)
    status = run.command(1).wait()
    if status != 0:
        return [f"{what}: the run afterwards ends with status {status}: {run.log_end()}"]
    return [] if run.table() == expected else [f"{what}: the run afterwards leaves another table"]


def _workers(folder, expected, n_kills, seconds):
    start = time.monotonic()
    missed = []
    n_same = n_explained = n_killed = number = 0
    while n_killed < n_kills and number < 4 * n_kills:
        generator = default_rng([SEED, 0, number])
        run = _Run(folder, f"worker-{number}")
        command = run.command(2)
        run_start = time.monotonic()
        kill_times = np.sort(
            generator.uniform(0, seconds, min(N_WORKER_KILLS, n_kills - n_killed))
        ).tolist()
        while command.status() is None and time.monotonic() < run_start + seconds + _RUN_TIMEOUT:
            workers = [pid for pid in command.children() if is_python_worker(pid)]
            if kill_times and time.monotonic() >= run_start + kill_times[0] and workers:
                is_killed = _kill(int(generator.choice(workers)))
                kill_times = kill_times[is_killed:]
                n_killed += is_killed
            time.sleep(0.01)
        if command.status() is None:
            os.kill(command.pid, signal.SIGKILL)
            command.wait()
            missed.append(f"worker {number}: the run hangs after a worker was killed")
        elif command.status() == 0 and run.table() == expected:
            n_same += 1
        # If a worker is killed twice while it starts, the command blames the machine; if it is killed twice with the
        # same mesh, the command blames the mesh.
        elif run.blames_mesh() or (command.status() == 2 and run.has_message()):
            n_explained += 1
        else:
            missed.append(
                f"worker {number}: status {command.status()}, table the same: {run.table() == expected}; "
                f"{run.log_end()}"
            )
        missed += _check_rerun(run, expected, f"worker {number}")
        number += 1
    return Row(
        "kills",
        "a worker",
        n_killed,
        _TARGET,
        f"{n_same} runs went on to the same table, {n_explained} said what to do, {len(missed)} wrong",
        missed,
        seconds=time.monotonic() - start,
    )


def _parents(folder, expected, n_kills, seconds):
    """Kill up to three successive runs on each cache, followed by an undisturbed run."""
    start = time.monotonic()
    missed = []
    n_killed = n_orphans = n_caches = number = 0
    while n_killed < n_kills and number < 4 * n_kills:
        run = _Run(folder, f"parent-{n_caches}")
        for _ in range(3):
            generator = default_rng([SEED, 1, number])
            number += 1
            n_workers = 1 + number % 2
            command = run.command(n_workers)
            time.sleep(generator.uniform(0, 0.8 * seconds[n_workers]))
            workers = command.children()
            n_killed += command.status() is None and _kill(command.pid)
            command.wait()
            n_orphans += len(_alive_after(workers, _WORKER_TIMEOUT))
            if n_killed == n_kills:
                break
        missed += _check_rerun(run, expected, f"parent {n_caches}")
        n_caches += 1
    if n_orphans:
        missed.append(f"{n_orphans} workers outlived their parent by {_WORKER_TIMEOUT:.0f} s")
    return Row(
        "kills",
        "the parent",
        n_killed,
        _TARGET,
        f"{n_caches} caches after them: {n_caches - len(missed)} to the same table",
        missed,
        seconds=time.monotonic() - start,
    )


def _eight(folder, expected, n_kills):
    start = time.monotonic()
    missed = []
    n_killed = number = n_survivors = 0
    seconds = 1.0
    while n_killed < n_kills and number < 4 * n_kills:
        generator = default_rng([SEED, 2, number])
        run = _Run(folder, f"eight-{number}")
        run_start = time.monotonic()
        commands = [
            run.command(1, run.out.with_name(f"{run.out.name}-{i}")) for i in range(N_PROCESSES)
        ]
        kill_times = np.sort(generator.uniform(0, seconds, N_KILLED))
        for i, kill_time in enumerate(kill_times):
            time.sleep(max(0.0, run_start + kill_time - time.monotonic()))
            n_killed += commands[i].status() is None and _kill(commands[i].pid)
        for i, command in enumerate(commands):
            if command.wait() < 0:
                continue
            n_survivors += 1
            out = run.out.with_name(f"{run.out.name}-{i}")
            if command.wait() != 0 or table(out) != expected:
                log = out.with_suffix(".log").read_text()[-300:]
                missed.append(
                    f"eight {number}: process {i} ends with status {command.wait()} or another table: {log}"
                )
        seconds = 0.8 * (time.monotonic() - run_start)
        missed += _check_rerun(run, expected, f"eight {number}")
        number += 1
    return Row(
        "kills",
        "of eight processes on one cache",
        n_killed,
        _TARGET,
        f"{number} caches, {n_survivors} processes left alone: {len(missed)} with another table",
        missed,
        seconds=time.monotonic() - start,
    )


def _leftovers(folder, expected):
    """Partially written files of killed processes are removed by a run two days later."""
    start = time.monotonic()
    caches = sorted((folder / "caches").iterdir())
    # A kill during a write is rare. So such files are also planted, in the folder of each version of the library.
    for cache in caches[:2]:
        written = next(cache.rglob("*.safetensors"))
        written.with_name(f"{written.stem}.{2**22}-planted.partial").write_bytes(
            written.read_bytes()[:1000]
        )
    leftovers = [path for cache in caches for path in partials(cache)]
    for path in leftovers:
        os.utime(path, (time.time() - 2 * _DAY,) * 2)
    missed = []
    for cache in {path.parents[2] for path in leftovers}:
        missed += _check_rerun(_Run(folder, cache.name), expected, f"leftover in {cache.name}")
    remaining = [path for path in leftovers if path.exists()]
    if remaining:
        missed.append(
            f"{len(remaining)} files that a killed process left stay for ever, such as {remaining[0].name}"
        )
    return Row(
        "kills",
        "files half written, two days and one run later",
        len(leftovers),
        "none stays",
        f"{len(remaining)} stay",
        missed,
        seconds=time.monotonic() - start,
    )


def _kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def _alive_after(pids, seconds):
    deadline = time.monotonic() + seconds
    while (alive := [pid for pid in pids if _is_running(pid)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    return alive


def _is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False

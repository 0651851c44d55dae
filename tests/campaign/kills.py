"""Processes are killed at random moments; what is computed afterwards is what an undisturbed run computes."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from outcome import Row
from retrieving import Command, is_python_worker, partials, table, write_shapes

SEED = 13
N_PROCESSES = 8
N_KILLED = 4
# Kills of workers in one run: each costs the start of another process, as much as all that there is to compute.
N_STRUCK = 3
_DAY = 24 * 3600
# A run of twelve small shapes takes seconds, and a worker ends at once; on a machine that has much to do, longer.
_PATIENCE = 600.0
_ORPHAN = 120.0
_TARGET = "table equals the undisturbed one"


@contextmanager
def _workplace() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        write_shapes(Path(folder) / "shapes")
        yield Path(folder)


def campaign(n_kills: int) -> list[Row]:
    """A quarter of the kills for workers, a quarter for parents, half for eight processes on one cache."""
    with _workplace() as folder:
        seconds = {}
        for n_workers in (1, 2):
            undisturbed = _Run(folder, f"undisturbed-{n_workers}")
            start = time.monotonic()
            if undisturbed.command(n_workers).wait() != 0:
                raise RuntimeError(f"the undisturbed run failed: {undisturbed.said()}")
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
    """A cache of its own, and a folder for the table."""

    def __init__(self, folder: Path, name: str) -> None:
        self.shapes, self.cache, self.out = folder / "shapes", folder / "caches" / name, folder / "out" / name

    def command(self, n_workers: int, out: Path | None = None) -> Command:
        return Command(self.shapes, self.cache, out or self.out, n_workers)

    def table(self):  # type: ignore[no-untyped-def]
        return table(self.out)

    def blames_mesh(self) -> bool:
        """Whether a mesh was given up because its worker was killed twice."""
        failures = self.out / "failures.csv"
        return failures.exists() and "killed twice" in failures.read_text()

    def said(self) -> str:
        return self.out.with_suffix(".log").read_text()[-300:]


def _settled(run: _Run, expected: object, what: str) -> list[str]:
    """What is wrong after one more run that nobody disturbs."""
    shutil.rmtree(run.out, ignore_errors=True)
    status = run.command(1).wait()
    if status != 0:
        return [f"{what}: the run afterwards ends with status {status}: {run.said()}"]
    return [] if run.table() == expected else [f"{what}: the run afterwards leaves another table"]


def _workers(folder: Path, expected: object, n_kills: int, seconds: float) -> Row:
    start = time.monotonic()
    missed: list[str] = []
    same = asked = killed = 0
    number = 0
    while killed < n_kills and number < 4 * n_kills:
        generator = np.random.default_rng([SEED, 0, number])
        run = _Run(folder, f"worker-{number}")
        command = run.command(2)
        begun = time.monotonic()
        moments = np.sort(generator.uniform(0, seconds, min(N_STRUCK, n_kills - killed))).tolist()
        while command.status() is None and time.monotonic() < begun + seconds + _PATIENCE:
            workers = [pid for pid in command.children() if is_python_worker(pid)]
            if moments and time.monotonic() >= begun + moments[0] and workers:
                struck = _kill(int(generator.choice(workers)))
                moments = moments[struck:]
                killed += struck
            time.sleep(0.01)
        if command.status() is None:
            os.kill(command.pid, signal.SIGKILL)
            command.wait()
            missed.append(f"worker {number}: the run hangs after a worker was killed")
        elif command.status() == 0 and run.table() == expected:
            same += 1
        # Killed twice while it starts, a worker says nothing of a mesh, and the command blames the machine; killed
        # twice with one mesh, it blames the mesh.
        elif (command.status() == 2 and "igps:" in run.said() and "Traceback" not in run.said()) or run.blames_mesh():
            asked += 1
        else:
            missed.append(
                f"worker {number}: status {command.status()}, table the same: {run.table() == expected}; {run.said()}"
            )
        missed += _settled(run, expected, f"worker {number}")
        number += 1
    return Row(
        "kills",
        "a worker",
        killed,
        _TARGET,
        f"{same} runs went on to the same table, {asked} said what to do, {len(missed)} wrong",
        missed,
        seconds=time.monotonic() - start,
    )


def _parents(folder: Path, expected: object, n_kills: int, seconds: dict[int, float]) -> Row:
    """Up to three kills of one run after another on a cache, the last one left alone."""
    start = time.monotonic()
    missed: list[str] = []
    killed = orphans = chain = number = 0
    while killed < n_kills and number < 4 * n_kills:
        run = _Run(folder, f"parent-{chain}")
        for _ in range(3):
            generator = np.random.default_rng([SEED, 1, number])
            number += 1
            n_workers = 1 + number % 2
            command = run.command(n_workers)
            time.sleep(generator.uniform(0, 0.8 * seconds[n_workers]))
            workers = command.children()
            killed += command.status() is None and _kill(command.pid)
            command.wait()
            orphans += len(_alive_after(workers, _ORPHAN))
            if killed == n_kills:
                break
        missed += _settled(run, expected, f"parent {chain}")
        chain += 1
    if orphans:
        missed.append(f"{orphans} workers outlived their parent by {_ORPHAN:.0f} s")
    return Row(
        "kills",
        "the parent",
        killed,
        _TARGET,
        f"{chain} caches after them: {chain - len(missed)} to the same table",
        missed,
        seconds=time.monotonic() - start,
    )


def _eight(folder: Path, expected: object, n_kills: int) -> Row:
    start = time.monotonic()
    missed: list[str] = []
    killed = number = survivors = 0
    seconds = 1.0
    while killed < n_kills and number < 4 * n_kills:
        generator = np.random.default_rng([SEED, 2, number])
        run = _Run(folder, f"eight-{number}")
        begun = time.monotonic()
        commands = [run.command(1, run.out.with_name(f"{run.out.name}-{i}")) for i in range(N_PROCESSES)]
        moments = np.sort(generator.uniform(0, seconds, N_KILLED))
        for i, moment in enumerate(moments):
            time.sleep(max(0.0, begun + moment - time.monotonic()))
            killed += commands[i].status() is None and _kill(commands[i].pid)
        for i, command in enumerate(commands):
            if command.wait() < 0:
                continue
            survivors += 1
            out = run.out.with_name(f"{run.out.name}-{i}")
            if command.wait() != 0 or table(out) != expected:
                said = out.with_suffix(".log").read_text()[-300:]
                missed.append(f"eight {number}: process {i} ends with status {command.wait()} or another table: {said}")
        seconds = 0.8 * (time.monotonic() - begun)
        missed += _settled(run, expected, f"eight {number}")
        number += 1
    return Row(
        "kills",
        "of eight processes on one cache",
        killed,
        _TARGET,
        f"{number} caches, {survivors} processes left alone: {len(missed)} with another table",
        missed,
        seconds=time.monotonic() - start,
    )


def _leftovers(folder: Path, expected: object) -> Row:
    """What kills leave of files that were being written is gone two days and one run later."""
    start = time.monotonic()
    caches = sorted((folder / "caches").iterdir())
    # A kill in the midst of a write is rare: leave such a file where each version of the library looks for its own.
    for cache in caches[:2]:
        written = next(cache.rglob("*.safetensors"))
        written.with_name(f"{written.stem}.{2**22}-planted.partial").write_bytes(written.read_bytes()[:1000])
    left = [path for cache in caches for path in partials(cache)]
    for path in left:
        os.utime(path, (time.time() - 2 * _DAY,) * 2)
    missed = []
    for cache in {path.parents[1] for path in left}:
        missed += _settled(_Run(folder, cache.name), expected, f"leftover in {cache.name}")
    still = [path for path in left if path.exists()]
    if still:
        missed.append(f"{len(still)} files that a killed process left stay for ever, such as {still[0].name}")
    return Row(
        "kills",
        "files half written, two days and one run later",
        len(left),
        "none stays",
        f"{len(still)} stay",
        missed,
        seconds=time.monotonic() - start,
    )


def _kill(pid: int) -> bool:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def _alive_after(pids: list[int], seconds: float) -> list[int]:
    deadline = time.monotonic() + seconds
    while (alive := [pid for pid in pids if _runs(pid)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    return alive


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False

"""A fault of the machine is named, ends the command with status 2, and loses no finished work."""

import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from outcome import Row
from retrieving import Command, retrieve, table, write_shapes

_WITHOUT_OVERRIDE = (
    "setpriv",
    "--bounding-set=-dac_override,-dac_read_search",
    "--inh-caps=-dac_override",
)
Expected = Any
Attempt = Callable[[Path, Expected], tuple[list[str], str]]

_YEAR = 365 * 24 * 3600.0


def campaign():
    """Try each fault once."""
    resumes, same = "status 2, named, resumes", "status 0, same table"
    attempts = (
        ("disk full, in the cache", resumes, _disk_full),
        ("disk full, for the results", resumes, _results_full),
        ("cache on a file system to be read only", resumes, _read_only),
        ("cache that this user may not write", resumes, _another_user),
        ("no rename over an open file", same, _no_rename),
        ("clock set back by a year", same, _clock_back),
    )
    rows = []
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        shapes = Path(folder) / "shapes"
        write_shapes(shapes)
        undisturbed = retrieve(shapes, Path(folder) / "cache", Path(folder) / "expected")
        expected = table(Path(folder) / "expected")
        if undisturbed.returncode or expected is None:
            raise RuntimeError(f"the undisturbed run failed: {undisturbed.stderr[-500:]}")
        for number, (what, target, attempt) in enumerate(attempts):
            start = time.monotonic()
            place = Path(folder) / str(number)
            place.mkdir()
            (place / "shapes").symlink_to(shapes, target_is_directory=True)
            missed, how = attempt(place, expected)
            rows.append(
                Row("machine", what, 1, target, how, missed, seconds=time.monotonic() - start)
            )
    return rows


def _disk_full(place, expected):
    cache = place / "cache"
    cache.mkdir()
    with _tmpfs(cache, "size=100k") as mounted:
        fault = "" if mounted else "full 80000"
        run = retrieve(place / "shapes", cache, place / "out", n_workers=2, fault=fault)
        missed = _is_named(run, "No space left on device", str(cache))
        kept = _stamps(cache)
        if mounted:
            _mount("remount,size=4m", cache)
        missed += _resumes(place, cache, expected, kept)
    return missed, f"{len(kept)} of 12 signatures kept ({'tmpfs' if mounted else 'shim'})"


def _results_full(place, expected):
    out = place / "out"
    out.mkdir()
    with _tmpfs(out, "size=4k") as mounted:
        if not mounted:
            return [], "not tried: nothing can be mounted here"
        run = retrieve(place / "shapes", place / "cache", out)
        missed = _is_named(run, "No space left on device")
        _mount("remount,size=4m", out)
        missed += _resumes(place, place / "cache", expected, _stamps(place / "cache"))
    return missed, "tmpfs of one page"


def _read_only(place, expected):
    cache = place / "cache"
    cache.mkdir()
    with _tmpfs(cache, "size=4m,ro") as mounted:
        if not mounted:
            return [], "not tried: nothing can be mounted here"
        run = retrieve(place / "shapes", cache, place / "out")
        missed = _is_named(run, "Read-only file system", str(cache))
        _mount("remount,rw", cache)
        missed += _resumes(place, cache, expected, {})
    return missed, "tmpfs"


def _another_user(place, expected):
    """A folder without write permission. Root, which may write everywhere, gives up this capability first."""
    cache = place / "cache"
    out = place / "out"
    cache.mkdir()
    out.mkdir(mode=0o777)
    os.chmod(out, 0o777)
    os.chmod(cache, 0o555)
    root = os.geteuid() == 0
    if root and not _run(*_WITHOUT_OVERRIDE, "true"):
        return [], "not tried: root cannot give its rights away here"
    run = retrieve(place / "shapes", cache, out, under=_WITHOUT_OVERRIDE if root else ())
    missed = _is_named(run, "Permission denied", str(cache))
    os.chmod(cache, 0o777)
    missed += _resumes(place, cache, expected, {})
    return missed, "root without its right to write everywhere" if root else "this user"


def _no_rename(place, expected):
    """Four processes compute the same signatures; none can replace a file that another one wrote before."""
    cache = place / "cache"
    outs = [place / f"out-{i}" for i in range(4)]
    with ThreadPoolExecutor(len(outs)) as pool:
        runs = list(
            pool.map(lambda out: retrieve(place / "shapes", cache, out, fault="rename"), outs)
        )
    missed = [
        f"process {i} ends with status {run.returncode}: {run.stderr[-300:]}"
        for i, run in enumerate(runs)
        if run.returncode or table(place / f"out-{i}") != expected
    ]
    # A damaged file cannot be replaced either.
    damaged = next(cache.rglob("*.safetensors"))
    damaged.write_bytes(damaged.read_bytes()[:100])
    run = retrieve(place / "shapes", cache, place / "out", fault="rename")
    if run.returncode == 0 and table(place / "out") != expected:
        missed.append("with a damaged file that cannot be replaced, the table is another one")
    elif run.returncode:
        missed += _is_named(run, "cannot access the file", str(cache))
    missed += _resumes(place, cache, expected, {})
    return missed, f"{len(runs)} processes at once; with a damaged file status {run.returncode}"


def _clock_back(place, expected):
    cache = place / "cache"
    missed = []
    first = Command(place / "shapes", cache, place / "out", 1)
    while first.status() is None and len(list(cache.rglob("*.safetensors"))) < 3:
        time.sleep(0.01)
    if first.status() is None:
        os.kill(first.pid, 9)
        first.wait()
    # All files of the cache are one year in the future by the true clock, and two years by the clock that is set back.
    for path in cache.rglob("*"):
        os.utime(path, (time.time() + _YEAR,) * 2)
    kept = _stamps(cache)
    run = retrieve(place / "shapes", cache, place / "out", fault=f"clock {_YEAR}")
    if run.returncode or table(place / "out") != expected:
        missed.append(f"status {run.returncode} or another table: {run.stderr[-300:]}")
    missed += _resumes(place, cache, expected, kept)
    return missed, f"{len(kept)} signatures of the future kept"


def _is_named(run, *words):
    """What is wrong with the message about a fault of the machine."""
    output = run.stderr[-400:]
    missed = []
    if run.returncode != 2:
        missed.append(f"status {run.returncode}, expected 2: {output}")
    if "Traceback" in run.stderr:
        missed.append(f"a traceback: {output}")
    message = [line for line in run.stderr.splitlines() if line.startswith("igps:")]
    if not message or not all(word in message[-1] for word in words):
        missed.append(f"no message that says {' and '.join(words)}: {output}")
    return missed


def _resumes(place, cache, expected, kept):
    """What is wrong with a run after the fault: other results, or signatures of the cache that are computed again."""
    run = retrieve(place / "shapes", cache, place / "out")
    if run.returncode:
        return [f"the run afterwards ends with status {run.returncode}: {run.stderr[-300:]}"]
    missed = [] if table(place / "out") == expected else ["the run afterwards leaves another table"]
    recomputed = [
        path
        for path, stamp in kept.items()
        if not path.exists() or path.stat().st_mtime_ns != stamp
    ]
    if recomputed:
        missed.append(
            f"{len(recomputed)} of {len(kept)} signatures that were kept are computed again"
        )
    return missed


def _stamps(cache):
    return {path: path.stat().st_mtime_ns for path in cache.rglob("*.safetensors")}


@contextmanager
def _tmpfs(folder, options):
    """Mount a small file system on a folder, and yield whether that was possible."""
    mounted = _run("mount", "-t", "tmpfs", "-o", f"{options},mode=1777", "tmpfs", str(folder))
    try:
        yield mounted
    finally:
        if mounted:
            _run("umount", "-l", str(folder))


def _mount(options, folder):
    if not _run("mount", "-o", options, str(folder)):
        raise RuntimeError(f"{folder}: cannot be mounted again with {options}")


def _run(*command):
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False

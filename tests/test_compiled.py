import os
import subprocess
import sys

import numpy as np
import pytest

from igps._compiled import ALLOCATES, compiled


@compiled(**ALLOCATES)
def cumulative(values):
    total = 0.0
    sums = np.empty_like(values)
    for i in range(len(values)):
        total += values[i]
        sums[i] = total
    return sums


@compiled(**ALLOCATES)
def largest_sum(rows):
    largest = -np.inf
    for row in rows:
        largest = max(largest, cumulative(row)[-1])
    return largest


def test_a_compiled_loop_may_call_another():
    rows = np.random.default_rng(1).random((7, 40))
    assert largest_sum(rows) == pytest.approx(rows.sum(axis=1).max())


def test_a_compiled_loop_is_the_function_that_it_was_made_of():
    values = np.random.default_rng(0).random(1000)
    np.testing.assert_allclose(cumulative(values), np.cumsum(values), rtol=1e-12)
    assert cumulative.__name__ == "cumulative"


def test_importing_a_compiled_loop_imports_no_compiler():
    code = "import sys, igps, igps._compiled; igps._compiled.compiled()(lambda x: x); sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def started(folder, code):
    """A process that may import the loops of the folder, and keeps them there."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    environment["NUMBA_CACHE_DIR"] = str(folder)
    command = [sys.executable, "-c", code]
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("modules", [("kinds", "kinds"), ("kinds_before", "kinds")])
def test_loops_of_an_earlier_version_are_compiled_anew(modules, tmp_path):
    """Numba's index of what lies on disk names the types of arguments, and is read before it is found to be stale."""
    for module, name, factor in zip(modules, ("Old", "Newer"), (2, 3), strict=True):
        kinds = tmp_path / f"{module}.py"
        kinds.write_text(
            f"from typing import NamedTuple\nclass {name}(NamedTuple):\n    x: float\n"
        )
        (tmp_path / "loops.py").write_text(
            f"from igps._compiled import compiled\nfrom {module} import {name}\n"
            f"@compiled()\ndef times(pair):\n    return {factor} * pair.x\n"
        )
        process = started(tmp_path, f"import loops; print(loops.times(loops.{name}(5.0)))")
        found, _ = process.communicate()
        assert float(found) == 5 * factor
        kinds.unlink()


def test_of_several_processes_one_compiles(tmp_path):
    (tmp_path / "loops.py").write_text(
        "from igps._compiled import compiled\n@compiled()\ndef twice(x):\n    return 2 * x\n"
    )
    code = (
        "import loops; loops.twice(1.5)\n"
        "print(sum(loops.twice._entry.dispatcher.stats.cache_misses.values()))"
    )
    processes = [started(tmp_path, code) for _ in range(3)]
    n_compiled = sum(int(process.communicate()[0]) for process in processes)
    assert n_compiled == 1

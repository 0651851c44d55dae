import os
import subprocess
import sys

import numpy as np
import pytest

from igps._compiled import compiled


@compiled()
def cumulative(values):
    total = 0.0
    sums = np.empty_like(values)
    for i in range(len(values)):
        total += values[i]
        sums[i] = total
    return sums


@compiled()
def largest_sum(rows):
    largest = -np.inf
    for row in rows:
        largest = max(largest, cumulative(row)[-1])
    return largest


def test_a_compiled_loop_may_call_another():
    rows = np.random.default_rng(1).random((7, 40))
    expected = pytest.approx(rows.sum(axis=1).max())
    assert largest_sum(rows) == expected


def test_a_compiled_loop_is_the_function_that_it_was_made_of():
    values = np.random.default_rng(0).random(1000)
    expected = np.cumsum(values)
    np.testing.assert_allclose(cumulative(values), expected, rtol=1e-12)
    assert cumulative.__name__ == "cumulative"


def test_importing_a_compiled_loop_imports_no_compiler():
    code = "import sys, igps, igps._compiled; igps._compiled.compiled()(lambda x: x); sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_loops_of_an_earlier_version_are_compiled_anew(tmp_path):
    """Numba's index of what lies on disk names the types of arguments, and is read before it is found to be stale."""
    for name, factor in (("Old", 2), ("New", 3)):
        (tmp_path / "loops.py").write_text(
            "from typing import NamedTuple\nfrom igps._compiled import compiled\n"
            f"class {name}(NamedTuple):\n    x: float\n"
            f"@compiled()\ndef times(pair):\n    return {factor} * pair.x\n"
        )
        code = f"import loops, sys; sys.exit(loops.times(loops.{name}(5.0)) != {5 * factor})"
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(sys.path),
            "NUMBA_CACHE_DIR": str(tmp_path),
        }
        assert (
            subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment).returncode
            == 0
        )


def test_of_several_processes_one_compiles(tmp_path):
    (tmp_path / "loops.py").write_text(
        "from igps._compiled import compiled\n@compiled()\ndef twice(x):\n    return 2 * x\n"
    )
    code = (
        "import loops; loops.twice(1.5)\n"
        "print(sum(loops.twice._entry.dispatcher.stats.cache_misses.values()))"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "NUMBA_CACHE_DIR": str(tmp_path),
    }
    command = [sys.executable, "-c", code]
    processes = [
        subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    found = sum(int(process.communicate()[0]) for process in processes)
    assert found == 1

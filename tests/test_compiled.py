import subprocess
import sys

import numpy as np
import pytest
import torch

from igps._compiled import beats_blas, compiled, is_available


@compiled()
def cumulative(values: np.ndarray) -> np.ndarray:
    total = 0.0
    sums = np.empty_like(values)
    for i in range(len(values)):
        total += values[i]
        sums[i] = total
    return sums


@compiled()
def largest_sum(rows: np.ndarray) -> float:
    largest = -np.inf
    for row in rows:
        largest = max(largest, cumulative(row)[-1])
    return largest


@pytest.mark.skipif(not is_available(), reason="needs numba, the extra [fast]")
def test_a_compiled_loop_may_call_another():
    rows = np.random.default_rng(1).random((7, 40))
    assert largest_sum(rows) == pytest.approx(rows.sum(axis=1).max())


@pytest.mark.skipif(not is_available(), reason="needs numba, the extra [fast]")
def test_a_compiled_loop_is_the_function_that_it_was_made_of():
    values = np.random.default_rng(0).random(1000)
    np.testing.assert_allclose(cumulative(values), np.cumsum(values), rtol=1e-12)
    assert cumulative.__name__ == "cumulative"


def test_importing_a_compiled_loop_imports_no_compiler():
    code = "import sys, igps, igps._compiled; igps._compiled.compiled()(lambda x: x); sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize(("value", "expected"), [("1", False), ("0", None)])
def test_numbas_own_switch_turns_it_off(value, expected, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", value)
    is_available.cache_clear()
    try:
        assert is_available() is (pytest.importorskip("numba") is not None if expected is None else expected)
    finally:
        is_available.cache_clear()


@pytest.mark.parametrize(
    ("processor", "has_avx512", "has_mkl", "expected"),
    [
        ("emeraldrapids", True, True, False),
        ("emeraldrapids", True, False, True),
        ("haswell", False, True, True),
        ("znver4", True, True, True),
        ("neoverse-n1", False, False, True),
    ],
)
def test_only_where_mkl_is_at_home_it_goes_before_compiled_loops(processor, has_avx512, has_mkl, expected, monkeypatch):
    binding = pytest.importorskip("llvmlite.binding")
    monkeypatch.setattr(binding, "get_host_cpu_name", lambda: processor)
    monkeypatch.setattr(binding, "get_host_cpu_features", lambda: {"avx512f": has_avx512})
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: has_mkl)
    assert beats_blas.__wrapped__() is expected

"""A plugin of pytest that records which functions of the library each test calls, and how long it takes.

The environment variable IGPS_CAMPAIGN_CALLED names the report, a JSON file. For each test that passes, it holds the
seconds of processor time, child processes included, and the functions, each as "module.py:line" of its first line. It
also lists the functions that are called by fixtures of more than one test.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

_SOURCES = str(Path("src").resolve())
_tests: dict[str, dict[str, Any]] = {}
_failed: list[str] = []
_shared: set[CodeType] = set()
_own: set[CodeType] = set()
_called = _own


def _record(frame: FrameType, event: str, argument: object) -> None:
    if event == "call":
        _called.add(frame.f_code)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    global _own, _called
    _own = _called = set()
    start = os.times()
    if "compiled" not in item.name:  # torch.compile cannot trace code while a profiler is active
        threading.setprofile(_record)
        sys.setprofile(_record)
    try:
        return (yield)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
        _tests[item.nodeid] = {
            "seconds": sum(os.times()[:4]) - sum(start[:4]),
            "functions": _names(_own),
        }


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any, request: pytest.FixtureRequest) -> Iterator[object]:
    global _called
    outer = _called
    if fixturedef.scope != "function":
        _called = _shared
    try:
        return (yield)
    finally:
        _called = outer


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.failed:
        _failed.append(report.nodeid)


def pytest_sessionfinish() -> None:
    tests = {name: test for name, test in _tests.items() if name not in _failed}
    report = json.dumps({"tests": tests, "shared": _names(_shared), "failed": _failed})
    Path(os.environ["IGPS_CAMPAIGN_CALLED"]).write_text(report)


def _names(codes: set[CodeType]) -> list[str]:
    ours = (code for code in codes if code.co_filename.startswith(_SOURCES))
    return sorted({f"{os.path.relpath(code.co_filename)}:{code.co_firstlineno}" for code in ours})

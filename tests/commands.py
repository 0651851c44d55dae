"""Run the command line of igps in the process of the test."""

from __future__ import annotations

import sys

import pytest

from igps.cli import main


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    """Run `igps` with arguments."""
    monkeypatch.setattr(sys, "argv", ["igps", *map(str, arguments)])
    main()


def error_of(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> str:
    """Return the line of the error with which `igps` ends for these arguments."""
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch, *arguments)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("igps: ")]
    return line
